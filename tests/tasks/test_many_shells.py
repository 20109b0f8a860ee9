"""What ManiSkill's own GPU tests ask of N environments at once; on a CPU of N single ones, which is all that it has."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import gymnasium as gym
import pytest
import torch
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from torch import Tensor

from benchmarking.shells import Shells
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.task_registry import find_task
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.arm_moves import CONTROL_MODES

GUIDED, SPARSE, GENERAL, ROW = TASK_IDS
COUNTS = {"cpu": 3, "cuda": 16}
ON_CUDA = pytest.param("cuda", marks=pytest.mark.gpu)
ONE_PLANT: dict[str, Any] = {"plant": {"seed": 3}}
SIZE = {"width": 40, "height": 30}


@pytest.fixture(scope="module", params=["cpu", ON_CUDA])
def shells(request: pytest.FixtureRequest) -> Iterator[Shells]:
    """The guided task with state observations."""
    with closing(make(GUIDED, request.param)) as made:
        yield made


def make(env_id: str, device: str, **options: Any) -> Shells:
    return Shells(
        env_id, COUNTS[device], device, **{"obs_mode": "state", "render_backend": "none", **options}
    )


def moves(shells: Shells, count: int) -> list[Tensor]:
    """Random moves that seldom leave the workspace, each of shape (N, A)."""
    size = shells.envs[0].unwrapped.single_action_space.shape[0]  # type: ignore[attr-defined]
    drawn = 0.05 * torch.randn(count, shells.num_envs, size, generator=torch.Generator().manual_seed(0))
    return list(drawn.to(shells.device))


@pytest.mark.parametrize("device", ["cpu", ON_CUDA])
@pytest.mark.parametrize("env_id", TASK_IDS)
def test_observations_rewards_and_flags_are_batches_on_the_device(env_id: str, device: str) -> None:
    options = ONE_PLANT if env_id in (GENERAL, ROW) else {}
    with closing(make(env_id, device, **options)) as shells:
        n = shells.num_envs
        observation = shells.reset(seed=0)
        told = shells.step_all(moves(shells, 1)[0])
        for tensor, dtype in zip((observation, *told), (torch.float32,) * 3 + (torch.bool,) * 2, strict=True):
            assert len(tensor) == n and tensor.dtype == dtype and tensor.device.type == device
        assert bool(observation.isfinite().all())
        # Each environment has an episode of its own.
        assert len(torch.unique(observation, dim=0)) == n


@pytest.mark.render
@pytest.mark.parametrize("device", ["cpu", ON_CUDA])
@pytest.mark.parametrize("obs_mode", ["rgb+depth+segmentation", "rgbd", "pointcloud", "state_dict"])
def test_every_environment_shows_its_own_picture(obs_mode: str, device: str) -> None:
    backend = "gpu" if device == "cuda" else "cpu"
    with closing(
        make(GUIDED, device, obs_mode=obs_mode, sensor_configs=SIZE, render_backend=backend)
    ) as shells:
        n = shells.num_envs
        shells.reset(seed=0)
        observation = shells.step(moves(shells, 1)[0])
        if obs_mode == "state_dict":
            assert all(len(part) == n for part in observation["extra"].values())
        elif obs_mode == "pointcloud":
            assert observation["pointcloud"]["xyzw"].shape == (n, 30 * 40, 4)
        else:
            pictures = observation["sensor_data"]["d435"]
            assert pictures["rgb"].shape == (n, 30, 40, 3) and pictures["rgb"].dtype == torch.uint8
            assert pictures["depth"].shape == (n, 30, 40, 1) and pictures["depth"].dtype == torch.int16
            assert len(torch.unique(pictures["depth"].flatten(1), dim=0)) == n
            assert ("segmentation" in pictures) == (obs_mode != "rgbd")


def test_a_reset_of_some_leaves_the_others_as_they_were(shells: Shells) -> None:
    before = shells.reset(seed=0)
    for move in moves(shells, 4):
        before = shells.step(move)
    rows = [i for i in (1, 3, 4, 13) if i < shells.num_envs]
    others = [i for i in range(shells.num_envs) if i not in rows]
    after = shells.reset(seed=50, rows=rows)
    torch.testing.assert_close(after[others], before[others], rtol=0, atol=1e-4)
    assert bool((after[rows] - before[rows]).abs().amax(dim=1).gt(1e-3).all())
    assert shells.elapsed_steps()[rows].tolist() == [0] * len(rows)
    assert shells.elapsed_steps()[others].tolist() == [4] * len(others)
    # And these go on: the same moves lead them on from where they were.
    assert bool(shells.step(moves(shells, 1)[0]).isfinite().all())


def test_a_state_that_was_kept_is_taken_back_after_other_moves(shells: Shells) -> None:
    shells.reset(seed=3)
    shells.step(moves(shells, 1)[0])
    kept, seen = shells.state(), shells.observation()
    expected = shells.step(moves(shells, 2)[1])
    for move in moves(shells, 3):
        shells.step(2.0 * move)
    shells.take_back(kept)
    torch.testing.assert_close(shells.observation(), seen, rtol=0, atol=1e-4)
    torch.testing.assert_close(shells.step(moves(shells, 2)[1]), expected, rtol=0, atol=1e-4)


def test_seeds_begin_the_same_episodes_again(shells: Shells) -> None:
    first = shells.reset(seed=7)
    shells.step(moves(shells, 1)[0])
    torch.testing.assert_close(shells.reset(seed=7), first, rtol=0, atol=1e-5)
    assert not torch.allclose(shells.reset(seed=8), first, atol=1e-3)


def test_all_episodes_are_cut_off_at_the_tasks_length(shells: Shells) -> None:
    shells.reset(seed=0)
    still = torch.zeros_like(moves(shells, 1)[0])
    cut = []
    for _ in range(find_task(GUIDED).max_episode_steps):
        cut.append(shells.step_all(still)[3])
    assert not bool(torch.stack(cut[:-1]).any())
    assert bool(cut[-1].all())


def test_an_action_that_is_not_finite_is_refused_and_moves_nothing(shells: Shells) -> None:
    before = shells.reset(seed=0)
    for bad in (torch.nan, torch.inf):
        with pytest.raises(InvalidInputError, match="an action must be finite"):
            shells.step(torch.full_like(moves(shells, 1)[0], bad))
    assert torch.equal(shells.observation(), before)


@pytest.mark.parametrize("device", ["cpu", ON_CUDA])
def test_every_control_mode_moves_every_environment(device: str) -> None:
    for mode in (*CONTROL_MODES, "pd_joint_pos", "pd_joint_delta_pos", "pd_ee_delta_pos"):
        with closing(make(GUIDED, device, control_mode=mode)) as shells:
            before = shells.reset(seed=0)
            after = shells.step(moves(shells, 1)[0])
            assert bool(((after - before).abs().amax(dim=1) > 1e-4).all()), mode


@pytest.mark.gpu
@pytest.mark.render
def test_pictures_of_a_plant_an_episode_cannot_be_reset_in_part() -> None:
    """With one environment, as on a CPU, there is no part of them."""
    env: Any = gym.make(GENERAL, num_envs=4, obs_mode="rgb", sensor_configs=SIZE)
    assert env.unwrapped.reconfiguration_freq == 1
    with pytest.raises(AssertionError, match="cannot be reconfigured"):
        ManiSkillVectorEnv(env)
    env.reset(seed=0)
    with pytest.raises(InvalidInputError, match="1 of 4 environments would build the scenes of all anew"):
        env.reset(options={"env_idx": [2]})
    env.close()
