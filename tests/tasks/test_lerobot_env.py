"""The tasks in LeRobot's words. `tests/integrations` runs its own evaluation on them."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.lerobot_env import COLOURS, LeRobotVectorEnv, make_env, painted
from maniskill_tomato.tasks.vector_env import make_vector_env

GUIDED, SPARSE, GENERAL, ROW = TASK_IDS


def small_actions(env: gym.vector.VectorEnv[Any, Any, Any], seed: int, count: int) -> list[NDArray[Any]]:
    env.action_space.seed(seed)
    return [np.float32(0.1) * env.action_space.sample() for _ in range(count)]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_observations_rewards_and_ends_are_those_of_the_task(mode: str) -> None:
    env = make_env(
        2, True, task=GUIDED, obs_type="state", autoreset_mode=mode, max_episode_steps=8, scene="thesis"
    )
    plain = make_vector_env(GUIDED, 2, autoreset_mode=mode, max_episode_steps=8, scene="thesis")
    observation, info = env.reset(seed=[3, 4], options={"lerobot_new_rollout": True})
    expected, _ = plain.reset(seed=[3, 4])
    assert list(observation) == ["agent_pos"] and np.array_equal(observation["agent_pos"], expected)
    assert env.observation_space.contains(observation)
    assert np.array_equal(info["is_success"], info["success"])
    ends = successes = shown_at_once = 0
    began = np.zeros(2, bool)
    for action in small_actions(env, 0, 40):
        observation, reward, terminated, truncated, info = env.step(action)
        expected, *rest, plain_info = plain.step(action)
        assert np.array_equal(observation["agent_pos"], expected)
        for one, other in zip((reward, terminated, truncated), rest, strict=True):
            assert isinstance(one, np.ndarray) and np.array_equal(one, other)
        done = terminated | truncated
        if mode == "NextStep":
            assert np.array_equal(info["is_success"], terminated)
            shown_at_once += int((plain_info["success"] & began).sum())
            began = done
        elif done.any():
            assert np.array_equal(info["final_info"]["is_success"], terminated)
            for row in np.flatnonzero(done):
                assert np.array_equal(info["final_obs"][row]["agent_pos"], plain_info["final_obs"][row])
        else:
            assert "final_info" not in info and not info["is_success"].any()
        ends += int(done.sum())
        successes += int(terminated.sum())
    assert ends >= 8 and successes >= 1 and (mode == "SameStep" or shown_at_once >= 1)


def test_pictures_show_roles_darker_with_their_distance() -> None:
    env = make_env(2, image_size=(40, 32), episodes="held_out")
    observation, _ = env.reset(seed=[0, 1])
    assert env.observation_space.contains(observation)
    plain = make_vector_env(
        GENERAL, 2, obs_mode="depth+segmentation", image_size=(40, 32), episodes="held_out"
    )
    seen, _ = plain.reset(seed=[0, 1])
    assert np.array_equal(observation["agent_pos"], seen["state"])
    picture = observation["pixels"]["wrist"]
    assert picture.shape == (2, 32, 40, 3) and picture.dtype == np.uint8
    for i, row, column in ((0, 16, 20), (1, 3, 5), (1, 31, 39)):
        role = Role(int(seen["segmentation"][i, row, column, 0]))
        shade = max(0.3, 1.0 - float(seen["depth"][i, row, column, 0]) / 2000.0)
        assert np.abs(picture[i, row, column] - shade * np.array(COLOURS[role])).max() <= 1.0
    rendered = env.call("render")
    assert len(rendered) == 2 and np.array_equal(np.stack(rendered), picture)
    observation, *_ = env.step(np.full((2, 3), 0.4, np.float32))
    assert not np.array_equal(observation["pixels"]["wrist"], picture)
    assert np.array_equal(np.stack(env.render()), observation["pixels"]["wrist"])


def test_a_pixel_without_depth_counts_as_near() -> None:
    role = np.array([[[int(Role.TARGET)], [int(Role.LEAF)]]])
    shown = painted(role, np.array([[[0], [1000]]], np.int16))
    assert shown[0, 0].tolist() == list(COLOURS[Role.TARGET])
    assert shown[0, 1].tolist() == [35, 80, 35]  # Half as bright at half of 2 m.


@pytest.mark.parametrize("task", TASK_IDS)
def test_what_lerobot_asks_an_environment_is_answered(task: str) -> None:
    env = make_env(3, cfg=SimpleNamespace(task=task, obs_type="state", fps=30))
    assert env.call("_max_episode_steps") == (gym.spec(task).max_episode_steps,) * 3
    assert env.call("task") == (task,) * 3
    words = env.get_attr("task_description")
    assert len(words) == 3 and ("row" in words[0]) == (task == ROW)
    assert env.unwrapped.metadata["render_fps"] > 0
    observation, _ = env.reset(seed=0)
    assert torch.from_numpy(observation["agent_pos"]).shape[0] == 3
    with pytest.raises(AttributeError):
        env.call("no_such_thing")
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "TomatoViewpoint-v2"}, "did you mean 'TomatoViewpoint-v1'"),
        ({"n_envs": 0}, "n_envs must be an integer of 1 or more"),
        ({"obs_type": "pixel"}, "obs_type must be one of 'state', 'pixels_agent_pos'"),
        ({"autoreset_mode": "Disabled"}, "autoreset_mode must be one of 'NextStep', 'SameStep'"),
        ({"obs_mode": "state"}, "obs_mode is chosen by obs_type"),
        ({"image_size": (4, 4)}, "from 28 to 640"),
        ({"epsiodes": "held_out"}, "did you mean 'episodes'"),
    ],
)
def test_options_that_cannot_be_used_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make_env(**options)


def test_the_class_says_what_it_is() -> None:
    env = LeRobotVectorEnv(GENERAL, 1, obs_type="state")
    assert env.spec is not None and env.spec.id == GENERAL and env.render_mode == "rgb_array"
