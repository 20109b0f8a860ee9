"""What the tasks refuse, what they accept, and how plants are chosen and placed."""

import math
import os
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError, RenderingUnavailableError
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.plants.spec import PlantPose, PlantSpec
from maniskill_tomato.tasks import TASK_IDS

GUIDED, SPARSE = TASK_IDS[:2]


def make(**kwargs: Any) -> Any:
    options: dict[str, Any] = {"num_envs": 1, "obs_mode": "state", "render_backend": "none"} | kwargs
    return gym.make(GUIDED, **options)


@pytest.mark.parametrize("env_id", TASK_IDS)
def test_the_normalised_reward_is_the_reward_over_the_largest_that_a_move_can_have(env_id: str) -> None:
    """The largest are Eq. 5-1's and Eq. 5-7's bounds, and in the other tasks a gain of 1 with the success reward."""
    largest = {GUIDED: 1.5, SPARSE: 1.0}.get(env_id, 0.0)
    rewards = []
    for mode in ("dense", "normalized_dense"):
        env: Any = gym.make(env_id, obs_mode="state", render_backend="none", reward_mode=mode)
        env.reset(seed=3)
        actions = [torch.full(env.action_space.shape, size) for size in (0.05, 1.0)]
        rewards.append([float(env.step(action)[1]) for action in actions])
        largest = largest or 1.0 + env.unwrapped.task.success_reward
        env.close()
    assert any(abs(reward) > 0.01 for reward in rewards[0])
    np.testing.assert_allclose(np.multiply(rewards[1], largest), rewards[0], rtol=1e-5)


@pytest.mark.parametrize(
    ("option", "allowed"),
    [
        ({"obs_mode": "xray"}, "state_dict"),
        ({"obs_mode": "rgb+smell"}, "segmentation"),
        ({"reward_mode": "huge"}, "normalized_dense"),
        ({"render_mode": "ascii"}, "rgb_array"),
        ({"control_mode": "pd_magic"}, "pd_viewpoint"),
        ({"robot_uids": "panda"}, "iiwa14_d435"),
        ({"motion": "teleport"}, "kinematic"),
        ({"plant": "cactus"}, "three_tomatoes"),
        ({"plant": {"preset": "cactus"}}, "three_tomatoes"),
        ({"plant": {"sort": 3}}, "leaf_density"),
        ({"plant": {"seed": "moon"}}, "held_out"),
        ({"plant": {"seed": -1}}, "from 0 to"),
        ({"plant": {"seed": 3, "pool": 4}}, "needs a split"),
        ({"plant": {"seed": "train", "pool": 0}}, "from 1 to"),
        ({"plant": {"leaf_density": float("nan")}}, "0 or more"),
        ({"plant": 3}, "one_tomato"),
        ({"plant_pose": (0.8, 0.0)}, "three numbers"),
        ({"plant_pose": (float("inf"), 0.0, 0.0)}, "finite"),
        ({"plant_pose": (0.05, 0.0, 0.0)}, "0.3 to 3 m"),
        ({"plant_pose_noise": (0.1, -0.1, 0.0)}, "0 or more"),
        ({"rays_per_side": 0}, "4 to 256"),
        ({"num_envs": 0}, "1 or more"),
        ({"num_envs": 4, "sim_backend": "physx_cpu"}, "AsyncVectorEnv"),
    ],
)
def test_bad_options_are_refused_with_what_is_allowed(option: dict[str, Any], allowed: str) -> None:
    with pytest.raises(InvalidInputError, match=allowed):
        make(**option)


@pytest.fixture(scope="module")
def env() -> Any:
    env = make()
    yield env
    env.close()


@pytest.mark.parametrize(
    "action",
    [
        np.full(6, np.nan, dtype=np.float32),
        np.array([0, 0, np.inf, 0, 0, 0], dtype=np.float32),
        torch.full((1, 6), torch.nan),
        np.zeros(5, dtype=np.float32),
        np.zeros((2, 6), dtype=np.float32),
        np.zeros((1, 7), dtype=np.float32),
        "up",
        {"action": np.zeros(6)},
    ],
)
def test_bad_actions_raise_value_error_and_change_nothing(env: Any, action: Any) -> None:
    env.reset(seed=0)
    before = env.unwrapped.get_state().clone()
    with pytest.raises(ValueError):
        env.unwrapped.step(action)
    assert torch.equal(env.unwrapped.get_state(), before)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target": 99}, "ripe fruit"),
        ({"target": "red"}, "ripe fruit"),
        ({"viewpoint": [0, 0, 0]}, "six finite numbers"),
        ({"viewpoint": [math.nan] * 6}, "six finite numbers"),
        ({"viewpoint": [3.0, 0, 1, 0, 1.5, 0]}, "cannot reach"),
    ],
)
def test_bad_reset_options_are_refused(env: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        env.reset(options=options)


def test_plant_pose_moves_the_target_with_the_plant() -> None:
    positions = []
    for pose in ((0.85, 0.2, 0.0), (0.80, -0.1, 0.0), (0.85, 0.2, math.pi / 2)):
        env = make(plant_pose=pose)
        obs, _ = env.reset(seed=0)
        positions.append(obs[0, 6:].double())
        env.close()
    torch.testing.assert_close(
        positions[1] - positions[0], torch.tensor([-0.05, -0.3, 0.0]).double(), atol=1e-6, rtol=0
    )
    stem = torch.tensor([0.85, 0.2, 0.0]).double()
    x, y, z = positions[0] - stem
    torch.testing.assert_close(positions[2] - stem, torch.stack([-y, x, z]), atol=1e-6, rtol=0)


def test_plant_pose_noise_stays_in_its_range_and_follows_the_seed() -> None:
    env = make(plant_pose_noise=(0.05, 0.1, 0.3))
    drawn = []
    for seed in list(range(40)) + [0]:
        env.reset(seed=seed)
        plant_batch = env.unwrapped.plant_batch
        drawn.append([*plant_batch.position_w[0, :2].tolist(), float(plant_batch.yaw[0])])
    env.close()
    poses = np.array(drawn)
    base = env.unwrapped.task.plant_pose
    offset = np.abs(poses - [base.x, base.y, base.yaw])
    assert (offset <= np.array([0.05, 0.1, 0.3]) + 1e-6).all() and (offset.max(0) > [0.03, 0.07, 0.2]).all()
    np.testing.assert_array_equal(poses[0], poses[-1])


def test_a_split_gives_a_new_plant_at_every_reset_and_the_same_for_the_same_seed() -> None:
    env = make(plant={"preset": "one_tomato", "seed": "held_out"})
    seeds = []
    for seed in (0, 1, 2, 0):
        env.reset(seed=seed)
        seeds.append(env.unwrapped.plant_batch.seeds[0])
    env.close()
    low, high = SEED_SPLITS["held_out"]
    assert all(low <= s < high for s in seeds)
    assert len(set(seeds[:3])) == 3 and seeds[0] == seeds[3]


def test_a_pool_limits_the_plants_that_are_drawn() -> None:
    env = make(plant={"seed": "train", "pool": 3})
    seeds = set()
    for seed in range(30):
        env.reset(seed=seed)
        seeds.add(env.unwrapped.plant_batch.seeds[0])
    env.close()
    assert seeds == {0, 1, 2}


def test_a_changed_plant_is_what_the_camera_sees() -> None:
    changing = make(plant={"preset": "full", "seed": "train"})
    for seed in range(3):
        obs, info = changing.reset(seed=seed)
        plant_seed = changing.unwrapped.plant_batch.seeds[0]
        fixed = make(plant={"preset": "full", "seed": plant_seed})
        options = {"target": int(changing.unwrapped.target_fruit[0]), "viewpoint": obs[0, :6].numpy()}
        obs_2, info_2 = fixed.reset(seed=seed, options=options)
        torch.testing.assert_close(obs_2, obs, atol=1e-6, rtol=0)
        assert torch.equal(info["target_id"], info_2["target_id"])
        torch.testing.assert_close(info["visible_fraction"], info_2["visible_fraction"], atol=1e-2, rtol=0)
        assert fixed.unwrapped.semantic_classes() == changing.unwrapped.semantic_classes()
        fixed.close()
    changing.close()


def test_seed_splits_are_disjoint() -> None:
    ranges = sorted(SEED_SPLITS.values())
    assert all(a[1] <= b[0] for a, b in zip(ranges, ranges[1:], strict=False))


def test_full_plants_offer_only_ripe_fruits_as_targets() -> None:
    env = make(plant="full")
    plant_batch = env.unwrapped.plant_batch
    plant = plant_batch.plants[0]
    ripe = {j for j, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe"}
    assert 0 < len(ripe) < len(plant.fruits)
    for seed in range(20):
        env.reset(seed=seed)
        assert int(env.unwrapped.target_fruit[0]) in ripe
    env.close()


def test_plant_choice_fields_replace_those_of_the_default() -> None:
    default = PlantSpec(preset="one_tomato", seed=5)
    assert PlantSpec.parse(None, default) is default
    assert PlantSpec.parse("full", default) == PlantSpec(preset="full", seed=5)
    assert PlantSpec.parse({"leaf_density": 0.5}, default) == PlantSpec(
        preset="one_tomato", seed=5, leaf_density=0.5
    )


def test_plant_pose_parses_three_numbers() -> None:
    assert PlantPose.parse([1, 0, 0.5], PlantPose(x=0.9, y=0.0)) == PlantPose(x=1.0, y=0.0, yaw=0.5)


def test_pictures_without_vulkan_are_refused_with_the_command_that_installs_it() -> None:
    script = (
        "import gymnasium as gym, maniskill_tomato\n"
        "from maniskill_tomato.errors import RenderingUnavailableError\n"
        "state = gym.make('TomatoViewpointGuided-v1', num_envs=1, obs_mode='state')\n"
        "assert state.reset(seed=0)[0].shape == (1, 9)\n"
        "try:\n"
        "    gym.make('TomatoViewpointGuided-v1', num_envs=1, obs_mode='rgb')\n"
        "except RenderingUnavailableError as error:\n"
        "    assert 'make vulkan' in str(error)\n"
        "    print('refused')\n"
    )
    hidden = {"VK_DRIVER_FILES": "/nonexistent", "VK_ICD_FILENAMES": "/nonexistent"}
    result = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | hidden, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
    assert "refused" in result.stdout


@pytest.mark.parametrize(
    ("wrong", "near"),
    [
        ({"percption": "occlusion_model"}, "perception"),
        ({"obs_mod": "state"}, "obs_mode"),
        ({"moton": "x"}, "motion"),
    ],
)
def test_a_mistyped_option_of_the_shell_names_the_nearest(wrong: dict[str, Any], near: str) -> None:
    (name,) = wrong
    with pytest.raises(InvalidInputError, match=f"has no option '{name}'; did you mean '{near}'"):
        gym.make("TomatoViewpoint-v1", **wrong)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
@pytest.mark.parametrize(
    ("backend", "what"), [("gpu", "'cuda', which needs an NVIDIA GPU"), ("typo", "'typo'")]
)
def test_a_device_that_is_missing_is_not_said_to_be_vulkan(backend: str, what: str) -> None:
    option: dict[str, Any] = {"sim_backend" if backend == "gpu" else "render_backend": backend}
    with pytest.raises(RenderingUnavailableError, match=what) as refused:
        gym.make("TomatoViewpointGuided-v1", num_envs=1, obs_mode="rgb", **option)
    assert "make vulkan" not in str(refused.value)


@pytest.mark.render
def test_a_window_without_a_display_is_refused_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RenderingUnavailableError, match="rgb_array") as refused:
        gym.make("TomatoViewpointGuided-v1", num_envs=1, render_mode="human")
    assert "display" in str(refused.value)
