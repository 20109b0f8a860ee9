"""Hindsight: what the learner is told about other tomatoes and other thresholds is what the task would have said."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.envs import LearnerEnv, make_learner_env
from maniskill_tomato.learning.rl.experience import Experience, make_replay
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.replay import Batch
from maniskill_tomato.learning.rl.rewards import potential_reward, training_reward

SPARSE = "TomatoViewpointSparse-v1"


@pytest.fixture(scope="module")
def judge() -> Iterator[Any]:
    """A plain environment of the sparse task, which is asked for the truth."""
    env = gym.make(SPARSE, num_envs=1, obs_mode="state", render_backend="none")
    env.reset(seed=0)
    yield env
    env.close()


@pytest.fixture(scope="module")
def learner_env() -> Iterator[LearnerEnv]:
    env = make_learner_env(SPARSE, other_targets=2)
    yield env
    env.close()


def vectors(size: int) -> gym.Space[Any]:
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def walk(env: LearnerEnv, config: TrainConfig, steps: int) -> tuple[Any, list[dict[str, Any]]]:
    """Random steps through `Experience`; the replay buffer and, for every step, the state and action it began with."""
    world: Any = env.unwrapped  # type: ignore[attr-defined]
    replay = make_replay(config, vectors(9), 6)
    experience = Experience(config, replay, 9)
    generator = torch.Generator().manual_seed(4)
    observations, info = env.reset(seed=11)
    experience.begin(info)
    visible, moves = info["visible_fraction"], []
    scale = torch.tensor(config.action_scale)
    for _ in range(steps):
        # Towards the plant and wide enough that fruits come into view, episodes end and some poses are out of reach.
        actions = (torch.randn(1, 6, generator=generator) * 0.25 + torch.tensor([0.1, 0, 0, 0, 0, 0])).clamp(
            -1, 1
        )
        before, own = (world.saved_rows(), world.qpos), int(world.target_fruit)
        next_observations, rewards, terminations, _, next_info = env.step(actions * scale)
        step_info = next_info.get("final_info", next_info)
        reached = next_info.get("final_obs", next_observations)
        learned = training_reward(config, rewards, terminations, visible, step_info)
        experience.add(
            Batch(observations, actions, learned, reached, terminations.float()),
            step_info,
            next_info,
        )
        moves.append({"state": before, "own": own, "action": actions * scale, "info": step_info})
        observations, visible = next_observations, next_info["visible_fraction"]
    return replay, moves


def rows(replay: Any) -> Batch:
    """Everything in the buffer in the order in which it came."""
    state = replay.state_dict()
    return Batch(*(state[name] for name in Batch._fields[:5]))


@pytest.mark.parametrize("reward", ["task", "potential"])
def test_a_relabelled_transition_is_what_the_task_gives_with_that_target(
    learner_env: LearnerEnv, judge: Any, reward: Any
) -> None:
    config = replace(get_preset("td3"), hindsight_targets=2, reward=reward)
    replay, moves = walk(learner_env, config, 70)
    stored = rows(replay)
    assert len(replay) == 3 * len(moves)
    base = judge.unwrapped
    seen, ended = 0, 0
    for number, move in enumerate(moves):
        for place in (1, 2):
            other = (move["own"] + place) % 3
            saved, qpos = move["state"]
            judge.reset(seed=0)
            base.world.take_up(torch.tensor([0]), {**saved, "target": torch.tensor([[float(other)]])}, qpos)
            before = base.evaluate()["visible_fraction"]
            start = base.get_obs(base.get_info())
            reached, task_reward, terminated, _, info = judge.step(move["action"])
            row = 3 * number + place
            wanted = task_reward if reward == "task" else None
            if wanted is None:
                wanted = potential_reward(
                    info["visible_fraction"], before, info["success"], terminated, info["reward_penalty"],
                    gamma=config.gamma, step_cost=config.step_cost,
                )  # fmt: skip
            assert torch.equal(stored.observations[row], start[0])
            assert torch.equal(stored.next_observations[row], reached[0])
            torch.testing.assert_close(stored.rewards[row], wanted[0])
            assert bool(stored.terminations[row]) == bool(terminated[0])
            assert torch.equal(
                move["info"]["other_visible_fraction"][0, place - 1], info["visible_fraction"][0]
            )
            seen += int(info["visible_fraction"][0] > 0.0)
            ended += int(terminated[0])
    assert seen > 5 and ended > 0


def test_the_environment_tells_the_same_when_reset_with_that_target_at_that_viewpoint(judge: Any) -> None:
    env: Any = gym.make(SPARSE, num_envs=1, obs_mode="state", render_backend="none", other_targets=2)
    different = 0
    for seed in range(12):
        _, info = env.reset(seed=seed)
        base = env.unwrapped
        viewpoint, own = base.world.state.viewpoint[0].tolist(), int(base.target_fruit)
        for place in (1, 2):
            options = {"target": (own + place) % 3, "viewpoint": viewpoint}
            observation, truth = judge.reset(seed=seed, options=options)
            index = place - 1
            # The arm may stand otherwise for the same viewpoint, and hide a ray more or less.
            assert float(info["other_visible_fraction"][0, index]) == pytest.approx(
                float(truth["visible_fraction"]), abs=0.02
            )
            torch.testing.assert_close(info["other_position"][0, index], observation[0, 6:9])
            different += int(info["other_visible_fraction"][0, index] != info["visible_fraction"][0])
        assert info["other_exists"].tolist() == [[True, True]]
    assert different > 4
    env.close()


def test_other_targets_leave_the_task_itself_as_it_is() -> None:
    one, two = (
        gym.make(SPARSE, num_envs=1, obs_mode="state", render_backend="none", other_targets=k) for k in (0, 2)
    )
    for seed in range(3):
        first, second = one.reset(seed=seed), two.reset(seed=seed)
        assert torch.equal(first[0], second[0])
        for _ in range(4):
            action = 0.1 * torch.randn(1, 6, generator=torch.Generator().manual_seed(seed))
            a, b = one.step(action), two.step(action)
            for x, y in zip(a[:4], b[:4], strict=True):
                assert torch.equal(torch.as_tensor(x), torch.as_tensor(y))
            assert all(torch.equal(value, b[4][name]) for name, value in a[4].items())
    one.close()
    two.close()


def test_a_plant_with_fewer_fruits_gives_fewer_transitions() -> None:
    config = replace(get_preset("td3"), hindsight_targets=2)
    env = make_learner_env("TomatoViewpointGuided-v1", other_targets=2)  # One tomato.
    replay, moves = walk(env, config, 8)
    assert len(replay) == len(moves)
    assert all(not move["info"]["other_exists"].any() for move in moves)
    env.close()
    with pytest.raises(InvalidInputError, match="other_targets must be an integer of 0 or more"):
        gym.make(SPARSE, obs_mode="state", render_backend="none", other_targets=-1)


class FourTomatoes:
    """One step at a time of four environments with two other targets each, all numbers drawn."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.positions = torch.randn(4, 2, 3, generator=self.generator)

    def info(self) -> dict[str, Tensor]:
        visible = torch.rand(4, 2, generator=self.generator)
        fail = torch.rand(4, generator=self.generator) < 0.1
        return {
            "visible_fraction": torch.rand(4, generator=self.generator),
            "success": torch.zeros(4, dtype=torch.bool),
            "fail": fail,
            "reward_penalty": -torch.rand(4, generator=self.generator),
            "other_visible_fraction": visible,
            "other_success": (visible > 0.8) & ~fail[:, None],
            "other_reward": torch.randn(4, 2, generator=self.generator),
            "other_exists": torch.tensor([[True, True], [True, False], [True, True], [False, False]]),
            "other_position": self.positions,
        }


def test_steps_of_other_targets_against_a_plain_loop() -> None:
    """Every other tomato that exists gets the step once, with its own reward and end."""
    config = replace(get_preset("td3"), hindsight_targets=2, reward="task", aux_visibility_weight=0.1)
    replay = make_replay(config, vectors(9), 6)
    experience = Experience(config, replay, 9)
    task = FourTomatoes(0)
    info = task.info()
    experience.begin(info)
    wanted = []
    for number in range(30):
        info = task.info()
        seen = torch.full((4, 9), float(number))
        actions = torch.rand(4, 6, generator=task.generator)
        batch = Batch(seen, actions, torch.zeros(4), seen + 0.5, info["fail"].float())
        experience.add(batch, info, info)
        for env in range(4):
            for other in range(2):
                if info["other_exists"][env, other]:
                    position = task.positions[env, other].tolist()
                    ended = bool(info["other_success"][env, other] | info["fail"][env])
                    wanted.append(
                        [
                            *([float(number)] * 6 + position),
                            *([number + 0.5] * 6 + position),
                            *actions[env].tolist(),
                            *(float(info["other_reward"][env, other]), float(ended)),
                            float(info["other_visible_fraction"][env, other]),
                        ]
                    )
    state = replay.state_dict()
    names = ("observations", "next_observations", "actions", "rewards", "terminations", "visible_fractions")
    stored = torch.cat([state[name].reshape(len(replay), -1) for name in names], dim=1)
    others = torch.arange(len(replay)) % (4 + 5) >= 4
    torch.testing.assert_close(stored[others], torch.tensor(wanted))


def test_an_environment_that_does_not_judge_other_targets_is_refused() -> None:
    config = replace(get_preset("td3"), hindsight_targets=2)
    experience = Experience(config, make_replay(config, vectors(9), 6), 9)
    info = FourTomatoes(0).info()
    del info["other_reward"]
    with pytest.raises(InvalidInputError, match="needs an environment made with other_targets=2"):
        experience.begin(info)
    with pytest.raises(InvalidInputError, match="needs the target's position at 6 ... 8"):
        Experience(config, make_replay(config, vectors(4), 6), 4)
