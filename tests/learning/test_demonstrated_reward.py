"""A reward learned from demonstrations: its parts by hand, files of demonstrations, and what a learner makes of it."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.learning.imitation.demonstrations import record_demonstrations
from maniskill_tomato.learning.imitation.trajectory_file import DemonstratedMoves, read_demonstrations
from maniskill_tomato.learning.rl.demonstrated_reward import (
    DemonstratedReward,
    DemonstratedTransitions,
    gradient_penalty,
)
from maniskill_tomato.learning.rl.envs import make_simulated_env
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.replay import Batch
from maniskill_tomato.learning.rl.trainer import Trainer, train
from maniskill_tomato.policies.actor import ObservationNormalizer
from maniskill_tomato.policies.opening import open_policy, shipped_policy
from maniskill_tomato.policies.trained_actor import load_actor, load_checkpoint

GUIDED = "TomatoViewpointGuided-v1"
TOY = "Approach-v0"
HORIZON = 10
NEAR = 0.8
SIZE = 2.5
TARGET = (0.8, -0.5, 1.0)


class Approach:
    """A point is to come near the target by steps of up to 1 along three of its six axes.

    Nine observed values and six actions, as the real tasks. What it pays and calls a success is up to the test; that an
    episode ends near the target is not.
    """

    single_observation_space: gym.Space[Any] = gym.spaces.Box(-np.inf, np.inf, (9,), np.float32)
    single_action_space: gym.Space[Any] = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def __init__(self, num_envs: int = 1, pay: float = 0.0) -> None:
        self.num_envs = num_envs
        self._pay = pay

    def reset(self, *, seed: int | list[int] | None = None) -> tuple[Tensor, dict[str, Any]]:
        assert seed is not None
        self._generator = torch.Generator().manual_seed(seed if isinstance(seed, int) else seed[0])
        self._place = torch.zeros(self.num_envs, 9)
        self._elapsed = torch.zeros(self.num_envs, dtype=torch.long)
        self._begin(torch.ones(self.num_envs, dtype=torch.bool))
        return self._place.clone(), self._info(torch.zeros(self.num_envs, dtype=torch.bool))

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        self._place[:, :6] = (self._place[:, :6] + actions).clamp(-SIZE, SIZE)
        self._elapsed += 1
        terminated = (self._place[:, :3] - self._place[:, 6:]).norm(dim=-1) < NEAR
        truncated = (self._elapsed >= HORIZON) & ~terminated
        info = self._info(terminated)
        reward = self._pay * self._place.sum(dim=-1)
        done = terminated | truncated
        if bool(done.any()):
            final = self._place.clone()
            self._begin(done)
            info = self._info(terminated) | {"final_obs": final, "final_info": info}
        return self._place.clone(), reward, terminated, truncated, info

    def close(self) -> None:
        pass

    def get_run_state(self) -> dict[str, Any]:
        return {"place": self._place, "elapsed": self._elapsed, "generator": self._generator.get_state()}

    def set_run_state(self, state: dict[str, Any]) -> None:
        self._place, self._elapsed = state["place"].clone(), state["elapsed"].clone()
        self._generator.set_state(state["generator"])

    def _begin(self, rows: Tensor) -> None:
        drawn = 2.0 * torch.rand(self.num_envs, 9, generator=self._generator) - 1.0
        self._place[rows] = 0.9 * SIZE * drawn[rows]
        self._place[rows, 6:] = torch.tensor(TARGET)
        self._elapsed[rows] = 0

    def _info(self, terminated: Tensor) -> dict[str, Any]:
        tells = terminated & (self._pay == 0.0)
        return {
            "visible_fraction": torch.full((self.num_envs,), self._pay),
            "success": tells,
            "fail": terminated & ~tells,
            "reward_penalty": torch.zeros(self.num_envs),
        }


def shown(count: int = 200) -> DemonstratedMoves:
    """Someone walks straight to the target, from random places, and stops where it is near."""
    generator = torch.Generator().manual_seed(7)
    places, moves, views, ends = [], [], [], []
    for _ in range(count):
        place = 0.9 * SIZE * (2.0 * torch.rand(9, generator=generator) - 1.0)
        place[6:] = torch.tensor(TARGET)
        for _ in range(HORIZON):
            move = torch.zeros(6)
            move[:3] = (place[6:] - place[:3]).clamp(-1.0, 1.0)
            places.append(place)
            moves.append(move)
            place = place.clone()
            place[:6] += move
            views.append(place)
            ends.append(bool((place[:3] - place[6:]).norm() < NEAR))
            if ends[-1]:
                break
    return DemonstratedMoves(
        observations=torch.stack(places),
        actions=torch.stack(moves),
        views=torch.stack(views),
        terminations=torch.tensor(ends).float(),
        episodes=count,
    )


def write(path: Path, demonstrations: DemonstratedMoves, env_id: str = TOY) -> Path:
    """A file as ManiSkill's recorder writes it, with one move in every episode."""
    with h5py.File(path, "w") as file:
        moves = zip(
            demonstrations.observations,
            demonstrations.actions,
            demonstrations.views,
            demonstrations.terminations,
            strict=True,
        )
        for i, (before, action, view, ended) in enumerate(moves):
            episode = file.create_group(f"traj_{i}")
            episode["obs"] = np.stack((before.numpy(), view.numpy()))
            episode["actions"] = action.numpy()[None]
            episode["terminated"] = np.array([bool(ended)])
    path.with_suffix(".json").write_text(json.dumps({"env_info": {"env_id": env_id}, "episodes": []}))
    return path


def toy_config(**changes: Any) -> TrainConfig:
    """The default preset, shrunk to seconds."""
    return replace(
        get_preset("td3"),
        **{
            "total_timesteps": 3000,
            "num_envs": 1,
            "updates_per_step": 0.5,
            "learning_starts": 200,
            "batch_size": 64,
            "tau": 0.02,
            "actor_hidden": (64, 64),
            "critic_hidden": (64, 64),
            "normalize_observations": "none",
            "action_scale": (1.0,) * 6,
            "exploration": "decaying-gaussian",
            "exploration_steps": 2000,
            "exploration_noise": 0.8,
            "exploration_noise_end": 0.1,
            "checkpoint_seconds": None,
            **changes,
        },
    )


def learn(run_dir: Path, config: TrainConfig, resume: bool = False, pay: float = 0.0, seed: int = 0) -> Path:
    env = Approach(config.num_envs, pay)
    return Trainer(env, TOY, config, run_dir, seed, show_progress=False, resume=resume).run().policy_path


def arrivals(policy: Path) -> float:
    """Share of 100 episodes that end near the target."""
    actor, env = load_actor(policy), Approach(100)
    observations, _ = env.reset(seed=99)
    arrived = torch.zeros(100, dtype=torch.bool)
    for _ in range(HORIZON):
        observations, _, terminated, truncated, _ = env.step(actor.act(observations))
        arrived |= terminated
        if bool(truncated.any()):
            break
    return float(arrived.float().mean())


def transitions(views: Tensor, terminations: Tensor | None = None) -> Batch:
    count = len(views)
    ended = torch.zeros(count) if terminations is None else terminations
    return Batch(torch.zeros(count, 9), torch.zeros(count, 6), torch.full((count,), 5.0), views, ended)


def identity() -> ObservationNormalizer:
    return ObservationNormalizer.identity(9)


def test_the_gradient_penalty_and_its_slope_are_those_of_finite_differences() -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 6), nn.Tanh(), nn.Linear(6, 1)).double()
    some, others = torch.randn(2, 5, 4, dtype=torch.float64)
    mix = torch.rand(5, 1, dtype=torch.float64)

    def by_differences() -> float:
        step, total = 1e-5, 0.0
        for a, b, m in zip(some, others, mix, strict=True):
            at = m * a + (1.0 - m) * b
            slopes = [
                (float(network(at + step * axis)) - float(network(at - step * axis))) / (2.0 * step)
                for axis in torch.eye(4, dtype=torch.float64)
            ]
            total += (float(np.linalg.norm(slopes)) - 1.0) ** 2
        return total / len(some)

    penalty = gradient_penalty(network, some, others, mix)
    assert penalty.item() == pytest.approx(by_differences(), rel=1e-6)
    penalty.backward()  # type: ignore[no-untyped-call]
    weight = network[0].weight
    assert isinstance(weight, nn.Parameter) and weight.grad is not None
    with torch.no_grad():
        weight[2, 1] += 1e-4
        above = by_differences()
        weight[2, 1] -= 2e-4
        below = by_differences()
    assert float(weight.grad[2, 1]) == pytest.approx((above - below) / 2e-4, rel=1e-3)


def test_demonstrated_views_come_to_be_worth_more_than_others() -> None:
    demonstrations = shown()
    model = DemonstratedReward(demonstrations, toy_config(critic_learning_rate=5e-3), seed=0)
    generator = torch.Generator().manual_seed(0)
    others = SIZE * (2.0 * torch.rand(4000, 9, generator=generator) - 1.0)
    others[:, 6:] = torch.tensor(TARGET)
    last = shown(260)
    held_out = last.views[-200:][last.terminations[-200:] > 0.0]
    before = model.judge(transitions(held_out), identity()).rewards
    for _ in range(400):
        drawn = torch.randint(3000, (64,), generator=generator)
        model.update(transitions(others[drawn]), identity(), generator)
    # The same transitions are judged anew by what has been learned since.
    after = model.judge(transitions(held_out), identity()).rewards
    assert not torch.allclose(before, after)
    own = model.judge(transitions(others[3000:]), identity()).rewards
    # A pair drawn at random is in the right order with this probability; 0.5 is chance.
    assert float((after[:, None] > own).float().mean()) > 0.9


def test_a_view_with_which_an_episode_ended_counts_as_if_it_stayed_for_ever() -> None:
    config = toy_config(gamma=0.9)
    model = DemonstratedReward(shown(), config, seed=1)
    views = shown(3).views[:4]
    once = model.judge(transitions(views), identity()).rewards
    ended = model.judge(transitions(views, torch.ones(4)), identity()).rewards
    for_ever = sum(config.gamma**k * once for k in range(400))
    torch.testing.assert_close(ended, for_ever)
    with torch.no_grad():  # All views alike.
        for parameter in model.network.parameters():
            parameter.zero_()
        model.network[-1].bias.fill_(2.0)  # type: ignore[operator]
    rewards = model.judge(transitions(views, torch.tensor([1.0, 0.0, 0.0, 1.0])), identity()).rewards
    terminations = torch.tensor([1.0, 0.0, 0.0, 1.0])
    # Ending is worth exactly as much as going on among such views: 2 in units of the logit.
    torch.testing.assert_close(rewards + config.gamma * (1.0 - terminations) * 2.0, torch.full((4,), 2.0))


def test_a_batch_gets_demonstrated_moves_in_units_of_the_action_scale() -> None:
    demonstrations, config = shown(5), toy_config(action_scale=(0.8, 0.8, 0.5, 1.0, 1.0, 1.0))
    own = transitions(torch.arange(36.0).reshape(4, 9))
    mixed = DemonstratedTransitions(demonstrations, config).beside(own, torch.Generator().manual_seed(3))
    assert len(mixed.rewards) == 5 and mixed.visible_fractions is None
    for name, part in own._asdict().items():
        if part is not None:
            torch.testing.assert_close(getattr(mixed, name)[:4], part)
    (row,) = [
        i for i, view in enumerate(demonstrations.views) if torch.equal(view, mixed.next_observations[4])
    ]
    assert torch.equal(mixed.observations[4], demonstrations.observations[row])
    assert float(mixed.terminations[4]) == float(demonstrations.terminations[row])
    move = demonstrations.actions[row]
    expected = [*(move[:2] / 0.8).clamp(-1.0, 1.0), (2.0 * move[2]).clamp(-1.0, 1.0), 0.0, 0.0, 0.0]
    torch.testing.assert_close(mixed.actions[4], torch.tensor(expected))


def test_what_the_task_pays_and_calls_a_success_changes_nothing(tmp_path: Path) -> None:
    config = toy_config(reward_from=str(write(tmp_path / "shown.h5", shown(20))), total_timesteps=600)
    policies = [
        load_checkpoint(learn(tmp_path / name, config, pay=pay))["actor"]
        for name, pay in (("a", 0.0), ("b", -300.0))
    ]
    for name, weights in policies[0].items():
        torch.testing.assert_close(weights, policies[1][name], rtol=0.0, atol=0.0)
    without = load_checkpoint(learn(tmp_path / "c", replace(config, reward_from=None)))["actor"]
    assert not torch.allclose(without["output.weight"], policies[0]["output.weight"])


@pytest.mark.slow
def test_demonstrations_alone_teach_the_way_to_the_target(tmp_path: Path) -> None:
    """Trainings with a learned reward differ much by their seed, so that the mean of two is judged."""
    config = toy_config(reward_from=str(write(tmp_path / "shown.h5", shown())), critic_learning_rate=2e-3)
    untrained = learn(tmp_path / "untrained", replace(config, total_timesteps=300, learning_starts=300))
    assert arrivals(untrained) < 0.4
    reached = [arrivals(learn(tmp_path / f"run-{seed}", config, seed=seed)) for seed in (0, 1)]
    assert sum(reached) / 2 > 0.6


def test_a_run_that_was_stopped_goes_on_bit_for_bit(tmp_path: Path) -> None:
    file = write(tmp_path / "shown.h5", shown(20))
    config = toy_config(
        reward_from=str(file), total_timesteps=500, checkpoint_every=50, num_envs=2, batch_size=32
    )
    learn(tmp_path / "a", config)
    learn(tmp_path / "b", replace(config, total_timesteps=310))
    learn(tmp_path / "b", config, resume=True)
    first, second = (
        load_checkpoint(sorted((tmp_path / name / "checkpoints").iterdir())[-1]) for name in "ab"
    )
    pairs = [(first["actor"], second["actor"]), (first["critics"], second["critics"])]
    learned = [run["run"]["reward_model"] for run in (first, second)]
    pairs.append((learned[0]["network"], learned[1]["network"]))
    for key, state in learned[0]["optimizer"]["state"].items():
        pairs.append((state, learned[1]["optimizer"]["state"][key]))
    for one, other in pairs:
        assert one.keys() == other.keys() and one
        assert all(torch.equal(one[name], other[name]) for name in one)
    assert torch.equal(first["run"]["generator"], second["run"]["generator"])
    write(file, shown(21))
    with pytest.raises(CheckpointError, match="not those that this run began with"):
        learn(tmp_path / "b", replace(config, total_timesteps=600), resume=True)


def test_recorded_episodes_of_a_thesis_task_are_read_with_their_last_views(tmp_path: Path) -> None:
    env: Any = make_simulated_env(GUIDED)
    policy = open_policy(shipped_policy(GUIDED), env_id=GUIDED)
    recorded = record_demonstrations(env, policy, range(3), tmp_path)
    demonstrations = read_demonstrations(recorded.path, GUIDED)
    assert recorded.recorded == demonstrations.episodes == 3
    assert demonstrations.views.shape == (recorded.moves, 9)
    assert float(demonstrations.terminations.sum()) == 3.0 and bool(demonstrations.terminations[-1])
    again: Any = make_simulated_env(GUIDED)
    for view in demonstrations.views[demonstrations.terminations > 0.0]:
        _, info = again.reset(seed=0, options={"viewpoint": view[:6].tolist()})
        assert float(info["visible_fraction"][0]) > 0.85
    again.close()


def damaged(path: Path) -> None:
    path.write_bytes(b"nothing")


def without_description(path: Path) -> None:
    path.with_suffix(".json").unlink()


def empty(path: Path) -> None:
    with h5py.File(path, "w"):
        pass


def with_images(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["traj_1/obs"]
        file["traj_1/obs/rgb"] = np.zeros((2, 4, 4, 3), np.uint8)


def a_view_short(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["traj_1/obs"]
        file["traj_1/obs"] = np.zeros((1, 9), np.float32)


def without_actions(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["traj_1/actions"]


def an_action_short(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["traj_1/actions"]
        file["traj_1/actions"] = np.zeros((0, 6), np.float32)


def not_finite(path: Path) -> None:
    with h5py.File(path, "a") as file:
        observations: Any = file["traj_1/obs"]
        observations[1, 3] = np.nan


def elsewhere(path: Path) -> None:
    write(path.with_name("other.h5"), shown(1))
    with h5py.File(path, "a") as file:
        del file["traj_1"]
        file["traj_1"] = h5py.ExternalLink("other.h5", "/traj_0")


def views_elsewhere(path: Path) -> None:
    write(path.with_name("other.h5"), shown(1))
    with h5py.File(path, "a") as file:
        del file["traj_1/obs"]
        file["traj_1/obs"] = h5py.ExternalLink("other.h5", "/traj_0/obs")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (Path.unlink, "there is no file"),
        (without_description, "there is no file .*json"),
        (damaged, "cannot be read as demonstrations"),
        (empty, f"holds no episode; record some with `maniskill-tomato demonstrations {TOY}`"),
        (with_images, "must hold obs as an array; record with obs_mode 'state'"),
        (without_actions, "must hold actions as an array"),
        (an_action_short, r"actions of shape \(T, A\)"),
        (a_view_short, r"shape \(T \+ 1, D\)"),
        (not_finite, "not finite"),
        (elsewhere, "must lie in the file itself"),
        (views_elsewhere, "traj_1/obs must lie in the file itself"),
    ],
)
def test_files_that_cannot_be_used_are_refused_in_words(tmp_path: Path, change: Any, message: str) -> None:
    path = write(tmp_path / "shown.h5", shown(5))
    read_demonstrations(path, TOY)
    change(path)
    with pytest.raises(InvalidInputError, match=message):
        read_demonstrations(path, TOY)


def test_demonstrations_of_something_else_are_refused_before_the_training(tmp_path: Path) -> None:
    path = write(tmp_path / "shown.h5", shown(5))
    with pytest.raises(InvalidInputError, match=f"demonstrations of {TOY}, not of {GUIDED}"):
        train(GUIDED, toy_config(reward_from=str(path)), tmp_path / "run", 0, {}, show_progress=False)
    short = replace(shown(5), observations=shown(5).observations[:, :7], views=shown(5).views[:, :7])
    write(path, short)
    with pytest.raises(InvalidInputError, match="observations of 7 values, and the task has 9"):
        learn(tmp_path / "run", toy_config(reward_from=str(path)))
    write(path, replace(shown(5), actions=shown(5).actions[:, :3]))
    with pytest.raises(InvalidInputError, match="actions of 3 values, and the task has 6"):
        learn(tmp_path / "run", toy_config(reward_from=str(path)))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hindsight_targets": 2}, "hindsight_targets must be 0 beside reward_from"),
        ({"aux_visibility_weight": 0.1}, "aux_visibility_weight must be 0 beside reward_from"),
        ({"obs_mode": "depth"}, "reward_from judges state vectors"),
    ],
)
def test_options_that_need_the_tasks_word_do_not_go_with_a_learned_reward(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(InvalidInputError, match=message):
        toy_config(reward_from="shown.h5", **changes)
