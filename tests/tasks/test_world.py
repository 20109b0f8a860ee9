"""Worlds of many environments against single ones: every environment plays as it would alone, without a simulator."""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.episode_list import load_episodes
from maniskill_tomato.plants.organs import with_fruit_at
from maniskill_tomato.tasks.making import make_world
from maniskill_tomato.tasks.vector_env import VectorEnv, make_vector_env
from maniskill_tomato.tasks.world import World

GUIDED, SPARSE = "TomatoViewpointGuided-v1", "TomatoViewpointSparse-v1"
GENERAL, ROW = "TomatoViewpoint-v1", "TomatoViewpointRow-v1"

POOL: dict[str, Any] = {"plant": {"pool": 3}}
NOISE: dict[str, float] = {
    "depth_noise": 1.0,
    "dropout": 0.1,
    "false_target": 0.05,
    "missed_target": 0.2,
    "target_position": 0.02,
}

CASES: list[tuple[str, dict[str, Any]]] = [
    (GUIDED, {"plant_pose_noise": (0.02, 0.05, 0.2)}),
    (SPARSE, {"other_targets": 2, "plant": {"seed": "train", "pool": 3}}),
    (GENERAL, POOL),
    (GENERAL, {**POOL, "sensor_noise": NOISE}),
    (GENERAL, {**POOL, "layout": ("viewpoint", "target", "map"), "contact_penalty": 0.5}),
    (GENERAL, {"episodes": [replace(e) for e in load_episodes("validation")[:3]]}),
    (GENERAL, {**POOL, "perception": "occlusion_model"}),
    (ROW, {**POOL, "transits": "both"}),
    (ROW, {**POOL, "transits": "none", "sensor_noise": NOISE}),
]
NAMES = [
    *(
        "pose noise",
        "other targets",
        "general",
        "sensor noise",
        "layout and contact",
        "episode list",
        "camera",
    ),
    *("row with transits", "row with noise"),
]

ROUNDING = 2e-5
"""Torch rounds some sums otherwise in a batch than alone: 7e-6 at most was seen in numbers of about 1."""


def actions(world: World, steps: int, seed: int = 0) -> Tensor:
    """Random moves, wide enough that some are refused. Shape (steps, N, A)."""
    size = 6 if world.moves.control == "viewpoint" else 3
    generator = torch.Generator().manual_seed(seed)
    return (0.15 if size == 6 else 0.8) * torch.randn(steps, world.num_envs, size, generator=generator)


def outcome(world: World) -> dict[str, Tensor]:
    return {"observation": world.observation(), "reward": world.reward(), **world.info()}


def assert_same(world: World, singles: Sequence[World], exact_share: float = 1.0) -> None:
    """Every environment of `world` tells what a world of its own tells, at least in this share of each entry."""
    told = outcome(world)
    for i, single in enumerate(singles):
        for name, value in outcome(single).items():
            same = (told[name][i].double() - value[0].double()).abs() <= ROUNDING
            assert float(same.double().mean()) >= exact_share, f"{name} of {i}"


@pytest.mark.parametrize("num_envs", [2, 7])
@pytest.mark.parametrize(("env_id", "options"), CASES, ids=NAMES)
def test_every_environment_plays_as_it_would_alone(
    env_id: str, options: dict[str, Any], num_envs: int
) -> None:
    play_beside_single_worlds(env_id, options, num_envs)


def test_rows_with_cameras_play_as_they_would_alone() -> None:
    play_beside_single_worlds(ROW, {**POOL, "perception": "simulated_segmenter"}, 2)


def play_beside_single_worlds(env_id: str, options: dict[str, Any], num_envs: int) -> None:
    """Plays the same moves in one world and in a world for each environment, some of which begin anew on the way."""
    # Rounding moves a ray at the edge of a pixel or of a voxel to the next one.
    exact_share = 0.98 if options.keys() & {"perception", "sensor_noise"} else 1.0
    if "perception" in options:
        num_envs = min(num_envs, 3)  # Each view of a camera takes 0.2 s.
    world = make_world(env_id, num_envs, **options)
    singles = [make_world(env_id, **options) for _ in range(num_envs)]
    world.reset([5 + i for i in range(num_envs)])
    for i, single in enumerate(singles):
        single.reset(5 + i)
    assert_same(world, singles, exact_share)
    moves = actions(world, 6)
    for step, move in enumerate(moves):
        world.step(move)
        for single, own in zip(singles, move, strict=True):
            single.step(own)
        if step == 3:
            # Some begin anew, with a seed of their own or with what their generators draw next.
            world.reset(77, [1])
            singles[1].reset(77)
            world.reset(env_idx=[0])
            singles[0].reset()
        assert_same(world, singles, exact_share)


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize(("env_id", "options"), CASES, ids=NAMES)
def test_a_saved_world_goes_on_exactly(env_id: str, options: dict[str, Any], num_envs: int) -> None:
    world, other = make_world(env_id, num_envs, **options), make_world(env_id, num_envs, **options)
    world.reset(11)
    moves = actions(world, 5 if "perception" in options else 8)
    for move in moves[:-3]:
        world.step(move)
    saved = world.save()
    other.reset(3)
    other.restore(saved)
    for move in moves[-3:]:
        for w in (world, other):
            w.step(move)
        one, two = outcome(world), outcome(other)
        assert all(torch.equal(one[name], two[name]) for name in one)
    for w in (world, other):
        w.reset()
    assert torch.equal(world.observation(), other.observation())


def test_an_environment_that_is_reset_leaves_the_others_untouched() -> None:
    world = make_world(GENERAL, 3, **POOL, sensor_noise=NOISE)
    world.reset(0)
    world.step(actions(world, 1)[0])
    before, memory = outcome(world), world.belief.memory.state()
    world.reset(9, env_idx=[1])
    after = outcome(world)
    for name in before.keys() - {"reward"}:
        assert torch.equal(before[name][[0, 2]], after[name][[0, 2]]), name
    assert not torch.equal(before["observation"][1], after["observation"][1])
    for name, tensor in world.belief.memory.state().items():
        torch.testing.assert_close(tensor[[0, 2]], memory[name][[0, 2]], atol=0, rtol=0, equal_nan=True)


def test_errors_of_one_environment_do_not_depend_on_what_others_do() -> None:
    busy, calm = (make_world(GENERAL, 2, **POOL, sensor_noise=NOISE) for _ in range(2))
    moves = actions(busy, 4)
    for world in (busy, calm):
        world.reset([4, 5])
    for move in moves:
        busy.reset(8, env_idx=[1])
        for world in (busy, calm):
            world.step(move)
        assert torch.equal(busy.belief.rays.label[0], calm.belief.rays.label[0])
        assert torch.equal(busy.belief.rays.distance[0], calm.belief.rays.distance[0])


def test_a_view_that_is_taken_up_again_has_the_same_errors() -> None:
    world = make_world(GENERAL, 1, **POOL, sensor_noise=NOISE)
    world.reset(2)
    for move in actions(world, 3):
        world.step(move)
    rows, qpos, belief = world.saved_rows(), world.qpos, world.belief
    label, hits, target = belief.rays.label.clone(), belief.memory.hits.clone(), belief.target_position
    for move in actions(world, 3, seed=1):
        world.step(move)
    world.take_up(torch.tensor([0]), rows, qpos)
    assert torch.equal(world.belief.rays.label, label) and torch.equal(world.belief.memory.hits, hits)
    assert torch.equal(world.belief.target_position, target)


def test_a_camera_measures_every_view_once() -> None:
    world = make_world(GENERAL, 1, plant={"seed": 3}, perception="occlusion_model")
    game: Any = world.game
    taken: list[Tensor] = []
    camera = game._senses._camera
    take = camera.take

    def counted(T_w_camera: Tensor, *rest: Any) -> Any:
        taken.append(T_w_camera)
        return take(T_w_camera, *rest)

    camera.take = counted
    located = 0
    for seed in range(5):
        taken.clear()
        world.reset(seed)
        offset = world.belief.target_position - world.target_position_w
        for move in actions(world, 6, seed):
            world.step(move)
            now = world.belief.target_position - world.target_position_w
            located += not torch.allclose(now, offset, atol=1e-6)
            offset = now
        # Also where the target's position changed, and with it all that the earlier views mean.
        assert len(taken) == 7
    assert located > 0


@pytest.mark.parametrize("env_id", [GUIDED, GENERAL, ROW])
def test_finished_environments_begin_anew_and_hand_out_what_the_step_gave(env_id: str) -> None:
    options: dict[str, Any] = {} if env_id == GUIDED else POOL
    kind: Any = {"max_steps": 4, "arrays": "torch"}
    same_step, disabled = AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
    env = VectorEnv(make_world(env_id, 3, **options), **kind, autoreset_mode=same_step)
    alone = VectorEnv(make_world(env_id, 3, **options), **kind, autoreset_mode=disabled)
    observation, _ = env.reset(seed=[1, 2, 3])
    alone.reset(seed=[1, 2, 3])
    assert observation.shape == (3, *env.single_observation_space.shape)  # type: ignore[misc]
    moves = actions(env.world, 9)
    ends = 0
    for move in moves:
        observation, reward, terminated, truncated, info = env.step(move)
        expected, reward_alone, *flags, info_alone = alone.step(move)
        assert torch.equal(reward, reward_alone)
        assert torch.equal(terminated, flags[0]) and torch.equal(truncated, flags[1])
        done = (terminated | truncated).nonzero()[:, 0]
        if not len(done):
            assert torch.equal(observation, expected) and "final_info" not in info
            continue
        ends += len(done)
        assert torch.equal(info["final_obs"], expected)
        assert torch.equal(info["final_info"]["visible_fraction"], info_alone["visible_fraction"])
        again, _ = alone.reset(options={"env_idx": done})
        assert torch.equal(observation, again)
        assert torch.equal(info["_final_obs"].nonzero()[:, 0], done)
        assert bool((info["elapsed_steps"][done] == 0).all())
    assert ends >= 6


def test_one_seed_begins_other_episodes_in_other_environments_and_the_same_ones_again() -> None:
    env = make_vector_env(SPARSE, 4, arrays="torch")
    first, _ = env.reset(seed=6)
    assert len({tuple(row) for row in first.tolist()}) == 4
    assert torch.equal(env.reset(seed=6)[0], first)
    torch.testing.assert_close(
        make_vector_env(SPARSE, arrays="torch").reset(seed=6)[0], first[:1], atol=ROUNDING, rtol=0
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_world("TomatoViewpoint-v9"), "TomatoViewpoint-v1"),
        (lambda: make_world(GENERAL, motion="dynamic"), "an option of TomatoViewpoint-v1"),
        (lambda: make_world(GENERAL, 0), "1 or more"),
        (lambda: make_world(GENERAL, perception="segmenter"), "gymnasium.make"),
        (lambda: make_world(GENERAL, perception="occlusion_model", sensor_noise=NOISE), "noise of its own"),
        (lambda: make_world(ROW, episodes="held_out"), "no episode lists"),
        (lambda: make_world(GUIDED, 2).reset([1, 2, 3]), "one number or 2"),
        (lambda: make_world(GUIDED, 2).reset(0, env_idx=[2]), "from 0 to 1"),
        (lambda: make_world(GUIDED, 2).reset(0, env_idx=[0, 0]), "each once"),
        (lambda: make_world(GUIDED, 2).step(torch.zeros(1, 6)), r"shape \(2, 6\)"),
    ],
)
def test_what_cannot_be_is_refused_in_words(make: Any, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make()


def test_a_world_and_its_vector_shell_load_no_simulator() -> None:
    code = (
        "import sys, torch\n"
        "from maniskill_tomato.tasks.vector_env import make_vector_env\n"
        "for env_id, size in (('TomatoViewpointSparse-v1', 6), ('TomatoViewpointRow-v1', 3)):\n"
        "    env = make_vector_env(env_id, 2)\n"
        "    env.reset(seed=0)\n"
        "    env.step(torch.zeros(2, size))\n"
        "print(sorted({name.partition('.')[0] for name in sys.modules} & {'sapien', 'mani_skill'}))\n"
    )
    root = Path(__file__).resolve().parents[2]
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=root, timeout=300
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"


def test_an_altered_plant_is_seen_again_and_so_is_the_one_before() -> None:
    world = make_world("TomatoViewpoint-v1", episodes="validation")
    world.reset(0)
    own, before = world.plant_batch.plants[0], world.observation()
    target = int(world.target_fruit[0])
    T = world.plant_batch.T_world_plant[0]
    between = 0.5 * (world.target_position_w[0] + world.T_w_camera[0, :3, 3])
    centre = T[:3, :3].T @ (between - T[:3, 3])
    world.exchange_plants({0: with_fruit_at(own, target, centre.numpy())})
    torch.testing.assert_close(world.target_position_w[0], between, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(world.belief.target_position[0].float(), between, atol=1e-5, rtol=0.0)
    seen = world.ground_truth.visible_fraction(world.T_w_camera, qpos=world.qpos)
    assert float(seen) > 0.9 > float(world.info()["visible_fraction"])
    assert not torch.allclose(world.observation(), before)
    world.exchange_plants({0: own})
    torch.testing.assert_close(world.observation(), before)


def test_an_altered_plant_with_other_fruits_is_refused() -> None:
    world = make_world("TomatoViewpointGuided-v1")
    world.reset(0)
    plant = world.plant_batch.plants[0]
    with pytest.raises(InvalidInputError, match=f"must have {len(plant.fruits)} fruits, got 0"):
        world.exchange_plants({0: replace(plant, fruits=())})
