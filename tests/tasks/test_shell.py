"""ManiSkill's shell plays what the world plays, and says what it cannot do."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.maniskill.shell_options import check_partial_reset, pick_reconfiguration_freq
from maniskill_tomato.tasks.numpy_streams import seed_some
from maniskill_tomato.tasks.vector_env import make_vector_env

OPTIONS: dict[str, dict[str, Any]] = {
    "TomatoViewpointGuided-v1": {"plant_pose_noise": (0.02, 0.02, 0.1)},
    "TomatoViewpointSparse-v1": {"other_targets": 2, "plant": {"seed": "train", "pool": 2}},
    "TomatoViewpoint-v1": {
        "plant": {"pool": 2},
        "sensor_noise": {"depth_noise": 1.0, "target_position": 0.01},
    },
    "TomatoViewpointRow-v1": {"plant": {"pool": 2}},
}


@pytest.mark.parametrize("env_id", TASK_IDS)
def test_the_shell_and_the_world_give_the_same_for_the_same_seeds_and_actions(env_id: str) -> None:
    shell: Any = gym.make(env_id, obs_mode="state", render_backend="none", **OPTIONS[env_id])
    world = make_vector_env(env_id, arrays="torch", autoreset_mode="Disabled", **OPTIONS[env_id])
    size = shell.action_space.shape[0]
    generator = torch.Generator().manual_seed(0)
    for seed in (3, 4, None):
        (seen, info), (expected, wanted) = shell.reset(seed=seed), world.reset(seed=seed)
        assert torch.equal(seen, expected)
        for _ in range(8):
            action = (0.15 if size == 6 else 0.8) * torch.randn(1, size, generator=generator)
            *seen_all, info = shell.step(action)
            *expected_all, wanted = world.step(action)
            for one, two in zip(seen_all, expected_all, strict=True):
                assert torch.equal(one, two)
            assert info.keys() == wanted.keys()
            for name in info:
                assert torch.equal(info[name], wanted[name]), name
            if bool(seen_all[2] | seen_all[3]):
                break
    shell.close()


def test_environments_to_reset_may_be_given_as_a_list() -> None:
    env: Any = gym.make("TomatoViewpointGuided-v1", obs_mode="state", render_backend="none")
    env.reset(seed=1)
    env.step(torch.full((1, 6), 0.02))
    (observation, info), _ = env.reset(options={"env_idx": [0]}), None
    assert int(info["elapsed_steps"][0]) == 0 and observation.shape == (1, 9)
    with pytest.raises(InvalidInputError, match="env_idx"):
        env.reset(options={"env_idx": [1]})
    env.close()


def test_plants_that_would_never_be_shown_are_refused_with_what_to_do() -> None:
    for freq in (0, 3):
        with pytest.raises(InvalidInputError, match="leave it out or set it to 1"):
            pick_reconfiguration_freq(freq, new_actors=True, follows_list=True)
    with pytest.raises(InvalidInputError, match="same plant"):
        pick_reconfiguration_freq(0, new_actors=True, follows_list=False)
    assert pick_reconfiguration_freq(5, new_actors=True, follows_list=False) == 5
    assert pick_reconfiguration_freq(None, new_actors=True, follows_list=True) == 1
    assert pick_reconfiguration_freq(None, new_actors=False, follows_list=True) == 0
    with pytest.raises(InvalidInputError, match="leave it out or set it to 1"):
        gym.make(
            "TomatoViewpoint-v1", obs_mode="rgb", episodes="validation", reconfiguration_freq=0, num_envs=1
        )


def test_a_reset_of_some_that_would_build_the_scenes_of_all_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="3 of 16 environments would build the scenes of all anew"):
        check_partial_reset(3, 16, builds_anew=True)
    check_partial_reset(16, 16, builds_anew=True)
    check_partial_reset(3, 16, builds_anew=False)


def test_seeds_for_some_environments_leave_the_generators_of_the_others_alone() -> None:
    generators, seeds = BatchedRNG.from_seeds([10, 11, 12, 13]), np.array([10, 11, 12, 13])
    seed_some(generators.rngs, seeds, [1, 3], [50, 51])
    assert seeds.tolist() == [10, 50, 12, 51]
    expected = [np.random.RandomState(seed).randint(10**6) for seed in (10, 50, 12, 51)]
    drawn: Any = generators.randint(10**6)
    assert drawn.tolist() == expected


def test_an_option_of_another_task_is_refused_with_the_tasks_that_take_it() -> None:
    with pytest.raises(
        InvalidInputError, match=r"has no target=.*TomatoViewpoint-v1.*it takes.*perception.*plant"
    ):
        gym.make(
            "TomatoViewpointGuided-v1", perception="occlusion_model", target="map", render_backend="none"
        )
