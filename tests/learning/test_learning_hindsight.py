"""Hindsight: what the learner is told about other tomatoes and other thresholds is what the task would have said."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium as gym
import pytest
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.envs import LearnerEnv, make_learner_env
from maniskill_tomato.learning.rl.experience import Experience, make_replay
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.replay import Batch
from maniskill_tomato.learning.rl.rewards import learned_reward, potential_reward
from maniskill_tomato.learning.rl.threshold import label_successes, success_threshold

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


def walk(env: LearnerEnv, config: TrainConfig, steps: int) -> tuple[Any, list[dict[str, Any]]]:
    """Random steps through `Experience`; the replay buffer and, for every step, the state and action it began with."""
    world: Any = env.unwrapped  # type: ignore[attr-defined]
    replay = make_replay(config, 9, 6)
    experience = Experience(config, replay, 1, (9, 6))
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
        next_observations, rewards, terminations, truncations, next_info = env.step(actions * scale)
        step_info = next_info.get("final_info", next_info)
        reached = next_info.get("final_observation", next_observations)
        learned = learned_reward(config, rewards, terminations, visible, step_info)
        experience.add(
            Batch(observations, actions, learned, reached, terminations.float()),
            terminations | truncations,
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


def test_returns_over_several_steps_of_other_targets_against_a_plain_loop() -> None:
    """Each other target has episodes of its own, which end when it is seen, and when the real one ends."""
    config = replace(get_preset("td3"), hindsight_targets=2, n_step=3, reward="task", gamma=0.9)
    replay = make_replay(config, 9, 6)
    experience = Experience(config, replay, 4, (9, 6))
    task = FourTomatoes(0)
    experience.begin(task.info())
    steps = []
    for number in range(40):
        info = task.info()
        dones = (torch.rand(4, generator=task.generator) < 0.1) | info["fail"]
        seen = torch.full((4, 9), float(number))
        seen[:, 0] = torch.arange(4)
        batch = Batch(
            seen, torch.rand(4, 6, generator=task.generator), torch.zeros(4), seen + 0.5, info["fail"].float()
        )
        experience.add(batch, dones, info, info)
        steps.append((info, dones))
    state = replay.state_dict()
    stored = {}
    for i in range(len(replay)):
        key = (*state["observations"][i, :2].tolist(), *state["observations"][i, 6:].tolist())
        stored[key] = [float(state[name][i]) for name in ("rewards", "terminations", "discounts")]
    checked = 0
    for env in range(3):
        for other in range(2):
            if not steps[0][0]["other_exists"][env, other]:
                continue
            for start in range(30):
                total, k = 0.0, 0
                while True:
                    info, dones = steps[start + k]
                    total += 0.9**k * float(info["other_reward"][env, other])
                    terminated = bool(info["other_success"][env, other] | info["fail"][env])
                    k += 1
                    if k == 3 or terminated or bool(dones[env]):
                        break
                key = (float(env), float(start), *task.positions[env, other].tolist())
                assert stored[key] == pytest.approx([total, float(terminated), 0.9**k], abs=1e-5)
                checked += 1
    assert checked == 5 * 30
    assert not any(key[0] == 3.0 and key[2:] != (key[1],) * 3 for key in stored)


def test_an_environment_that_does_not_judge_other_targets_is_refused() -> None:
    config = replace(get_preset("td3"), hindsight_targets=2)
    experience = Experience(config, make_replay(config, 9, 6), 4, (9, 6))
    info = FourTomatoes(0).info()
    del info["other_reward"]
    with pytest.raises(InvalidInputError, match="needs an environment made with other_targets=2"):
        experience.begin(info)
    with pytest.raises(InvalidInputError, match="needs the target's position at 6 ... 8"):
        Experience(config, make_replay(config, 4, 6), 4, (4, 6))


# ------------------------------------------------------------------------------------------- the threshold


def test_the_threshold_rises_linearly_to_one() -> None:
    assert [success_threshold(0.4, step, 1000) for step in (0, 500, 1000, 9000)] == pytest.approx(
        [0.4, 0.7, 1.0, 1.0]
    )


def test_labels_are_those_of_a_task_with_the_lower_threshold() -> None:
    """Each transition's reward is computed once more from V_f, with the threshold of the task and with the lower."""
    generator = torch.Generator().manual_seed(0)
    before, after = torch.rand(200, generator=generator), torch.rand(200, generator=generator)
    failed = torch.rand(200, generator=generator) < 0.2
    penalty = -torch.rand(200, generator=generator)

    def rewards(threshold: float) -> tuple[Tensor, Tensor]:
        success = (after > threshold) & ~failed
        ended = success | failed
        return potential_reward(after, before, success, ended, penalty, gamma=0.9, step_cost=0.05), ended

    stored, ended = rewards(0.8)
    nothing = torch.zeros(200, 9)
    batch = Batch(nothing, nothing[:, :6], stored, nothing, ended.float(), None, after)
    for threshold in (0.3, 0.6, 0.79):
        labelled = label_successes(batch, threshold, 0.9)
        wanted, ends = rewards(threshold)
        torch.testing.assert_close(labelled.rewards, wanted)
        assert torch.equal(labelled.terminations.bool(), ends)
        assert int(ends.sum()) > int(ended.sum())
    for threshold in (0.8, 0.9, 1.0):
        assert torch.equal(label_successes(batch, threshold, 0.9).rewards, stored)


def test_a_rising_threshold_needs_labels_that_can_be_made_anew() -> None:
    td3 = get_preset("td3")
    replace(td3, success_threshold_start=0.4)
    for changes in ({"reward": "task"}, {"n_step": 3}):
        with pytest.raises(InvalidInputError, match="needs reward 'potential' and n_step 1"):
            replace(td3, success_threshold_start=0.4, **changes)
    with pytest.raises(InvalidInputError, match=r"in \(0, 1\), got 1.5"):
        replace(td3, success_threshold_start=1.5)
