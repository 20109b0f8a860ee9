"""The general task and the row: episodes, rewards, what is observed, contact, saved states."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.episode_list import (
    EPISODE_LISTS,
    Episode,
    load_episodes,
    read_episodes,
    write_episodes,
)
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.iiwa14 import NUM_JOINTS
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.look_at import flange_to_camera
from maniskill_tomato.sensing.observation import ObservationLayout
from maniskill_tomato.tasks.row.episode_sampling import draw_episodes, extend_episodes

GENERAL, ROW = "TomatoViewpoint-v1", "TomatoViewpointRow-v1"


def make(env_id: str = GENERAL, **kwargs: Any) -> Any:
    options: dict[str, Any] = {
        "num_envs": 1,
        "obs_mode": "state",
        "reward_mode": "dense",
        "render_backend": "none",
        "plant": {"pool": 4},
    }
    return gym.make(env_id, **(options | kwargs))


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = make()
    yield env
    env.close()


@pytest.fixture(scope="module")
def row() -> Iterator[Any]:
    env = make(ROW, transits="none")
    yield env
    env.close()


def action(rng: np.random.Generator) -> np.ndarray[Any, Any]:
    return rng.normal(size=3).astype(np.float32)


def test_starts_are_hidden_free_of_contact_and_look_at_a_ripe_fruit_of_the_middle_plant(env: Any) -> None:
    base = env.unwrapped
    for seed in range(12):
        _, info = env.reset(seed=seed)
        plant, target = base.plant_batch.plants[0], int(base.target_fruit[0])
        assert target < plant.middle_fruits and plant.fruits[target].ripeness == "ripe"
        assert 0.0 <= float(info["visible_fraction"]) < 0.3
        assert float(info["clearance"]) > 0.0 and not bool(info["plant_contact"])
        T = flange_to_camera(forward_kinematics(base.agent.robot.get_qpos().double()))[0]
        away = base.target_position_w[0].double() - T[:3, 3]
        torch.testing.assert_close(T[:3, 2], away / away.norm(), atol=1e-5, rtol=0)
        stem = base.plant_batch.position_w[0].double()
        low, high = torch.tensor(base.task.start_box, dtype=torch.float64).unbind(-1)
        place = T[:3, 3] - torch.tensor([float(stem[0]), float(stem[1]), 0.0])
        assert bool((place >= low - 1e-5).all()) and bool((place <= high + 1e-5).all())
    assert base.soft_starts == 0


def test_visible_fraction_is_that_of_another_scene(env: Any) -> None:
    base, rng = env.unwrapped, np.random.default_rng(0)
    for seed in range(3):
        env.reset(seed=seed)
        scene = RayScene(base.plant_batch.plants, base.camera_intrinsics)
        for _ in range(4):
            *_, info = env.step(action(rng))
            T = flange_to_camera(forward_kinematics(base.agent.robot.get_qpos()))
            seen = scene.visibility(T, base.target_fruit, base.plant_batch.T_world_plant)
            # The other scene knows no robot, which can only hide more.
            assert float(info["visible_fraction"]) <= float(seen.visible_fraction) + 1e-6
            truth = base.ground_truth.visible_fraction(T)
            torch.testing.assert_close(truth, seen.visible_fraction)
            with_arm = base.ground_truth.visible_fraction(T, 0, base.agent.robot.get_qpos())
            torch.testing.assert_close(with_arm, info["visible_fraction"])


def test_a_step_tells_gain_path_moves_and_contact(env: Any) -> None:
    base, rng = env.unwrapped, np.random.default_rng(5)
    contacts = 0
    for seed in range(6):
        _, info = env.reset(seed=seed)
        before, path = float(info["visible_fraction"]), 0.0
        for k in range(1, 8):
            qpos = base.agent.robot.get_qpos().clone()
            place = base.belief.camera_position[0].clone()
            _, reward, terminated, _, info = env.step(action(rng))
            now = float(info["visible_fraction"])
            path += float((base.belief.camera_position[0] - place).norm())
            assert float(info["visible_fraction_gain"]) == pytest.approx(now - before, abs=1e-6)
            assert float(info["path_length"]) == pytest.approx(path, abs=1e-5)
            assert int(info["moves"]) == k
            truth = base.ground_truth.clearance(qpos, base.agent.robot.get_qpos())
            assert float(info["clearance"]) == pytest.approx(float(truth[0]), abs=1e-6)
            assert bool(info["plant_contact"]) == (float(info["clearance"]) <= 0.0)
            contacts += bool(info["plant_contact"])
            expected = now - before - 0.02 + (1.0 if now > 0.8 else 0.0)
            assert float(reward) == pytest.approx(expected, abs=1e-6)
            assert bool(terminated) == bool(info["success"]) == (now > 0.8)
            before = now
            if bool(terminated):
                break
    assert contacts > 0


def test_contact_costs_what_the_option_says() -> None:
    free, dear = make(), make(contact_penalty=0.5)
    touched = 0
    for seed in range(4):
        free.reset(seed=seed)
        dear.reset(seed=seed)
        for _ in range(5):
            a = np.array([0.2, 0.0, 1.0], dtype=np.float32)  # Towards the plant.
            _, cheap, *_, info = free.step(a)
            _, priced, *_ = dear.step(a)
            touched += bool(info["plant_contact"])
            assert float(cheap - priced) == pytest.approx(0.5 * float(info["plant_contact"]), abs=1e-6)
    assert touched > 0
    free.close()
    dear.close()


def test_an_episode_ends_after_twenty_moves(env: Any) -> None:
    env.reset(seed=1)
    for k in range(20):
        _, _, terminated, truncated, _ = env.step(np.zeros(3, dtype=np.float32))
        assert not bool(terminated) and bool(truncated) == (k == 19)
    assert int(env.unwrapped.belief.moves_left[0]) == 0


def test_the_observation_is_the_observers_vector_and_its_parts_have_names() -> None:
    env, named = make(), make(obs_mode="state_dict")
    obs, _ = env.reset(seed=2)
    parts, _ = named.reset(seed=2)
    layout = ObservationLayout()
    assert obs.shape == (1, layout.size) == env.observation_space.shape
    assert torch.equal(torch.cat(list(parts["extra"].values()), dim=-1), obs)
    assert list(parts["extra"]) == list(layout.slices)
    assert torch.equal(env.unwrapped.belief.observation, obs)
    assert bool(obs.isfinite().all()) and float(obs.abs().max()) < 4.0
    blind = make(layout=("viewpoint", "target"))
    assert blind.reset(seed=2)[0].shape == (1, 9)
    for e in (env, named, blind):
        e.close()


def test_looking_twice_at_the_observation_changes_nothing(env: Any) -> None:
    obs, _ = env.reset(seed=3)
    base = env.unwrapped
    visits = base.belief.memory.visits.clone()
    assert torch.equal(base.get_obs(base.get_info()), obs)
    assert torch.equal(base.belief.memory.visits, visits) and int(visits[0]) == 1
    env.step(np.zeros(3, dtype=np.float32))
    assert int(base.belief.memory.visits[0]) == 2


@pytest.mark.parametrize("env_id", [GENERAL, ROW])
@pytest.mark.parametrize("flat", [True, False])
def test_restored_state_continues_exactly(env_id: str, flat: bool) -> None:
    env: Any = make(env_id, plant={"seed": 3})
    base, rng = env.unwrapped, np.random.default_rng(1)
    obs, _ = env.reset(seed=5)
    for _ in range(4):
        obs, *_ = env.step(action(rng))
    saved = base.get_state().clone() if flat else base.get_state_dict()
    grid = base.belief.memory.state()
    actions = [action(rng) for _ in range(5)]
    expected = [env.step(a) for a in actions]
    env.reset(seed=17)
    env.step(action(rng))
    (base.set_state if flat else base.set_state_dict)(saved)
    for name, tensor in base.belief.memory.state().items():
        torch.testing.assert_close(tensor, grid[name], atol=0, rtol=0, equal_nan=True)
    assert torch.equal(base.get_obs(base.get_info()), obs)
    for a, (obs_1, reward_1, terminated_1, _, info_1) in zip(actions, expected, strict=True):
        obs_2, reward_2, terminated_2, _, info_2 = env.step(a)
        assert torch.equal(obs_1, obs_2) and torch.equal(reward_1, reward_2)
        assert torch.equal(terminated_1, terminated_2)
        for name in ("visible_fraction", "clearance", "path_length", "moves"):
            assert torch.equal(info_1[name], info_2[name])
    env.close()


def test_one_seed_gives_one_episode_whatever_was_before() -> None:
    first, second = make(), make()
    second.reset(seed=99)
    for seed in (0, 1):
        a, b = first.reset(seed=seed)[0], second.reset(seed=seed)[0]
        assert torch.equal(a, b)
        step = np.array([0.5, -0.5, 0.2], dtype=np.float32)
        assert torch.equal(first.step(step)[0], second.step(step)[0])
    first.close()
    second.close()


def test_episodes_of_a_list_come_by_seed_and_by_index(tmp_path: Path) -> None:
    drawn = draw_episodes("validation", 3, first_seed=5)
    path = tmp_path / "list.json"
    write_episodes(path, drawn)
    episodes = read_episodes(path)
    assert list(episodes) == drawn
    env: Any = make(episodes=episodes, plant=None)
    base = env.unwrapped
    for seed, options in ((1, {}), (4, {}), (None, {"episode": 1})):
        _, info = env.reset(seed=seed, options=options)
        episode = episodes[1]
        assert base.plant_batch.seeds[0] == episode.plant_seed
        assert int(base.target_fruit[0]) == episode.target
        assert float(info["visible_fraction"]) == pytest.approx(episode.start_visibility, abs=1e-4)
        torch.testing.assert_close(
            base.belief.camera_position[0], torch.tensor(episode.camera_position), atol=1e-5, rtol=0
        )
        pose = torch.cat([base.plant_batch.position_w[0, :2], base.plant_batch.yaw])
        torch.testing.assert_close(pose, torch.tensor(episode.plant_pose), atol=1e-5, rtol=0)
    env.close()
    of_file: Any = make(episodes=str(path), plant=None)
    of_file.reset(seed=2)
    assert of_file.unwrapped.plant_batch.seeds[0] == episodes[2].plant_seed
    of_file.close()
    with pytest.raises(InvalidInputError, match="held_out"):
        make(episodes=str(tmp_path / "missing.json"))


def test_a_list_grows_by_the_same_episodes_whether_at_once_or_in_parts() -> None:
    at_once = extend_episodes("validation", [], 3)
    in_parts = extend_episodes("validation", extend_episodes("validation", [], 2), 3)
    assert at_once == in_parts
    assert len({episode.plant_seed for episode in at_once}) == 3


@pytest.mark.parametrize("name", EPISODE_LISTS)
def test_the_lists_of_the_package_hold_plants_of_their_split_only(name: str) -> None:
    episodes = load_episodes(name)
    low, high = SEED_SPLITS[name]
    assert len(episodes) == len({e.plant_seed for e in episodes}) >= 200
    for episode in episodes:
        assert low <= episode.plant_seed < high
        assert 0.0 <= episode.start_visibility < 0.31
        assert all(math.isfinite(v) for v in (*episode.plant_pose, *episode.camera_position))


def test_bad_options_are_refused(env: Any, tmp_path: Path) -> None:
    bad: list[tuple[dict[str, Any], str]] = [
        ({"episodes": "test"}, "held_out"),
        ({"episodes": []}, "one or more"),
        ({"start_visibility": (0.5, 0.2)}, "low, high"),
        ({"start_visibility": (0.5, 1.2)}, "0 <= low"),
        ({"contact_penalty": -1.0}, "contact_penalty"),
        ({"layout": ("everything",)}, "everything"),
    ]
    for options, message in bad:
        with pytest.raises(InvalidInputError, match=message):
            make(**options)
    for reset, message in (
        ({"episode": 3}, "episodes="),
        ({"camera_position": [0.3, 0.0]}, "three finite"),
        ({"camera_position": [0.0, 0.0, 3.0]}, "workspace"),
        ({"target": 999}, "ripe fruit"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            env.reset(seed=0, options=reset)
    with pytest.raises(InvalidInputError, match="no episode lists"):
        make(ROW, episodes="held_out")
    (tmp_path / "bad.json").write_text('{"episodes": [{"plant": 3}]}')
    with pytest.raises(InvalidInputError, match="fields of Episode"):
        read_episodes(tmp_path / "bad.json")
    with pytest.raises(InvalidInputError, match="certified"):
        Episode(
            plant_seed=1,
            leaf_density=1.0,
            plant_pose=(0.9, 0.0, 0.0),
            target=0,
            camera_position=(0.3, 0.0, 0.7),
            start_visibility=0.0,
            oracle_moves=3,
        )


def test_a_row_is_searched_fruit_by_fruit(row: Any) -> None:
    base, rng = row.unwrapped, np.random.default_rng(0)
    _, info = row.reset(seed=0)
    ripe = set(base.plant_batch.ripe_fruits[0])
    assert 1 <= int(info["target_count"]) <= len(ripe) and int(info["seen_count"]) == 0
    visited, seen, since = [int(base.target_fruit[0])], 0, 0
    for _ in range(36):
        _, reward, terminated, _, info = row.step(action(rng))
        since += 1
        done = bool(info["target_done"])
        seen += done
        expected = float(info["visible_fraction_gain"]) - 0.02 + float(done)
        assert float(reward) == pytest.approx(expected, abs=1e-6)
        assert int(info["seen_count"]) == seen
        assert done == (float(info["visible_fraction"]) > 0.8)
        target = int(base.target_fruit[0])
        if bool(terminated):
            break
        if done or since == 20:
            # The next target is new, and nothing is remembered but the look from where the camera stands.
            assert target not in visited and target in ripe
            assert int(base.belief.memory.visits[0]) == 1
            left = [j for j in ripe if j not in visited and j in base.open_targets(0)]
            positions = base.plant_batch.fruit_positions_w(0, left)
            nearest = left[int((positions - base.belief.camera_position[0]).norm(dim=-1).argmin())]
            assert target == nearest
            visited.append(target)
            since = 0
        else:
            assert target == visited[-1]
            assert int(base.belief.memory.visits[0]) == since + 1
    assert seen >= 2 and len(visited) >= 3


def test_states_have_one_row_of_joints_for_every_view(env: Any) -> None:
    env.reset(seed=0)
    base, rng = env.unwrapped, np.random.default_rng(0)
    joints = [base.agent.robot.get_qpos()[0].clone()]
    for _ in range(3):
        env.step(action(rng))
        joints.append(base.agent.robot.get_qpos()[0].clone())
    views = base.get_state_dict()["task"]["views"].view(-1, NUM_JOINTS)
    assert torch.equal(views[:4], torch.stack(joints)) and not bool(views[4:].any())
