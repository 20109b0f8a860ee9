"""The training loop on a toy task that needs no simulator."""

import csv
import importlib
import itertools
import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.errors import CheckpointError, InvalidInputError, TrainingDivergedError
from maniskill_tomato.learning.rl.history import TrainingHistory, load_history
from maniskill_tomato.learning.rl.presets import PRESETS, TrainConfig, default_preset, get_preset
from maniskill_tomato.learning.rl.rewards import potential_reward
from maniskill_tomato.learning.rl.trainer import Trainer
from maniskill_tomato.policies.trained_actor import load_actor, load_checkpoint

HORIZON = 30


class ReachTask:
    """A point in a box must come near the target: nine observed values and six actions, as the real tasks."""

    def __init__(self, num_envs: int = 1) -> None:
        self.num_envs = num_envs
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (9,), np.float32)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.reward_override: float | None = None
        self.signal_at_step: int | None = None
        self.actions: list[Tensor] = []
        self._steps = 0

    def reset(self, *, seed: int | list[int] | None = None) -> tuple[Tensor, dict[str, Any]]:
        assert seed is not None
        self._generator = torch.Generator().manual_seed(seed if isinstance(seed, int) else seed[0])
        self._observation = torch.zeros(self.num_envs, 9)
        self._elapsed = torch.zeros(self.num_envs, dtype=torch.long)
        self._begin(torch.ones(self.num_envs, dtype=torch.bool))
        return self._observation.clone(), self._info()

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        assert actions.shape == (self.num_envs, 6)
        self.actions.append(actions.clone())
        self._steps += 1
        if self._steps == self.signal_at_step:
            os.kill(os.getpid(), signal.SIGINT)
        self._observation[:, :6] = (self._observation[:, :6] + actions).clamp(-1.0, 1.0)
        self._elapsed += 1
        info = self._info()
        terminated = info["success"]
        truncated = (self._elapsed >= HORIZON) & ~terminated
        reward = terminated.float() - 0.1 * (1.0 - info["visible_fraction"])
        if self.reward_override is not None:
            reward = torch.full_like(reward, self.reward_override)
        done = terminated | truncated
        if done.any():
            final, final_info = self._observation.clone(), info
            self._begin(done)
            info = self._info() | {"final_obs": final, "final_info": final_info}
        return self._observation.clone(), reward, terminated, truncated, info

    def close(self) -> None:
        pass

    def _begin(self, rows: Tensor) -> None:
        drawn = 2.0 * torch.rand(self.num_envs, 9, generator=self._generator) - 1.0
        self._observation[rows] = 0.5 * drawn[rows]
        self._elapsed[rows] = 0

    def _info(self) -> dict[str, Any]:
        distance = (self._observation[:, :3] - self._observation[:, 6:]).norm(dim=-1)
        visible = torch.exp(-distance)
        return {
            "visible_fraction": visible,
            "success": visible > 0.75,
            "reward_penalty": torch.zeros(self.num_envs),
        }


def small_config(**changes: Any) -> TrainConfig:
    """The default preset, shrunk to a few seconds."""
    base = replace(
        get_preset("td3"),
        total_timesteps=300,
        learning_starts=100,
        batch_size=32,
        tau=0.02,
        actor_learning_rate=1e-3,
        gamma=0.95,
        actor_hidden=(64, 64),
        critic_hidden=(64, 64),
        normalize_observations="none",
        exploration_steps=1000,
        action_scale=(0.25, 0.25, 0.25, 0.35, 0.35, 0.35),
        updates_per_step=1.0,
        num_envs=1,
        step_cost=0.02,
    )
    return replace(base, **changes)


def train(env: ReachTask, config: TrainConfig, run_dir: Path, seed: int = 0) -> Any:
    return Trainer(env, "Reach-v0", config, run_dir, seed=seed, show_progress=False).run()


def success_rate(policy: Any, episodes: int) -> float:
    """Share of episodes in which the policy reaches the target."""
    env = ReachTask(episodes)
    observation, _ = env.reset(seed=12345)
    solved = torch.zeros(episodes, dtype=torch.bool)
    for _ in range(HORIZON - 1):  # One less, so that no episode starts anew.
        observation, _, terminated, _, _ = env.step(policy.act(observation))
        solved |= terminated
    return float(solved.float().mean())


def test_training_solves_the_toy_task_that_an_untrained_policy_does_not(tmp_path: Path) -> None:
    untrained = train(
        ReachTask(), small_config(total_timesteps=1, learning_starts=10), tmp_path / "untrained"
    )
    trained = train(
        ReachTask(), small_config(total_timesteps=4000, exploration_steps=2000), tmp_path / "trained"
    )
    assert success_rate(load_actor(untrained.policy_path), 100) < 0.3
    assert success_rate(load_actor(trained.policy_path), 100) > 0.7


@pytest.mark.slow
def test_fast_td3_in_small_solves_the_toy_task(tmp_path: Path) -> None:
    """Running normalisation, categorical critics and a noise level for each environment together."""
    config = replace(
        get_preset("fast-td3"),
        total_timesteps=8000,
        num_envs=8,
        learning_starts=400,
        batch_size=128,
        buffer_size=20_000,
        updates_per_step=0.25,
        tau=0.02,
        actor_learning_rate=1e-3,
        critic_learning_rate=1e-3,
        actor_hidden=(64, 64),
        critic_hidden=(64, 64),
        exploration_steps=2000,
        action_scale=(0.25, 0.25, 0.25, 0.35, 0.35, 0.35),
        step_cost=0.02,
    )
    trained = train(ReachTask(8), config, tmp_path / "run")
    assert success_rate(load_actor(trained.policy_path), 100) > 0.7


def test_one_seed_gives_one_policy_and_another_seed_another(tmp_path: Path) -> None:
    weights = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        result = train(ReachTask(2), small_config(num_envs=2), tmp_path / name, seed=seed)
        weights.append(load_checkpoint(result.policy_path)["actor"]["output.weight"])
    torch.testing.assert_close(weights[0], weights[1], rtol=0.0, atol=0.0)
    assert not torch.allclose(weights[0], weights[2])


def test_a_run_ends_after_its_episodes_and_counts_them(tmp_path: Path) -> None:
    config = small_config(total_timesteps=None, total_episodes=5)
    result = train(ReachTask(), config, tmp_path / "run")
    rows = list(csv.DictReader((tmp_path / "run/episodes.csv").open()))
    assert result.stop_reason == "finished"
    assert result.episodes == 5 == len(rows)
    assert result.steps == sum(int(row["steps"]) for row in rows) == int(rows[-1]["end_step"])


def test_the_history_holds_every_step_and_every_episode(tmp_path: Path) -> None:
    env = ReachTask()
    train(env, small_config(total_timesteps=400), tmp_path / "run")
    curves = load_history(tmp_path / "run")
    assert curves.step_reward.shape == curves.step_visible_fraction.shape == (400,)
    end = 0
    for steps, total, largest in zip(
        curves.episodes["steps"],
        curves.episodes["episodic_return"],
        curves.episodes["max_visible_fraction"],
        strict=True,
    ):
        start, end = end, end + int(steps)
        assert total == pytest.approx(curves.step_reward[start:end].sum(), abs=1e-4)
        assert largest == pytest.approx(curves.step_visible_fraction[start:end].max(), abs=1e-6)
    assert end > 300


def test_algorithm_2_updates_once_per_step_as_soon_as_a_batch_is_there(tmp_path: Path) -> None:
    config = replace(get_preset("thesis-guided"), total_episodes=None, total_timesteps=100)
    result = train(ReachTask(), config, tmp_path / "run")
    assert result.updates == 100 - 31  # The first update follows the 32nd step.


def test_updates_per_step_below_one_are_owed_until_they_make_one(tmp_path: Path) -> None:
    config = small_config(total_timesteps=200, learning_starts=100, updates_per_step=0.25)
    assert train(ReachTask(), config, tmp_path / "run").updates == 25  # floor(101 * 0.25)


def test_actions_reach_the_environment_in_its_own_units(tmp_path: Path) -> None:
    env = ReachTask()
    scale = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    train(env, small_config(action_scale=scale, exploration_noise=3.0, total_timesteps=200), tmp_path / "run")
    largest = torch.cat(env.actions).abs().amax(dim=0)
    torch.testing.assert_close(
        largest, torch.tensor(scale)
    )  # Noise this strong reaches both ends on every axis.


def test_the_replay_sees_the_end_of_an_episode_and_not_the_start_of_the_next(tmp_path: Path) -> None:
    env = ReachTask()
    trainer = Trainer(
        env, "Reach-v0", small_config(total_timesteps=200), tmp_path / "run", show_progress=False
    )
    trainer.run()
    stored = trainer._state.replay.state_dict()
    moved = stored["next_observations"][:200, :6] - stored["observations"][:200, :6]
    inside = stored["next_observations"][:200, :6].abs() < 1.0
    torch.testing.assert_close(moved[inside], torch.cat(env.actions)[inside], rtol=0.0, atol=1e-6)
    curves = load_history(tmp_path / "run")
    ends = curves.episodes["end_step"].astype(int) - 1
    terminal = stored["terminations"][:200].nonzero().flatten().tolist()
    assert terminal == [e for e, s in zip(ends, curves.episodes["success"], strict=True) if s]
    assert len(terminal) < len(ends)  # At least one episode ran out of time, which is no termination.


def test_ctrl_c_ends_the_run_with_everything_saved(tmp_path: Path) -> None:
    env = ReachTask()
    env.signal_at_step = 150
    before = signal.getsignal(signal.SIGINT)
    result = train(env, small_config(total_timesteps=100_000), tmp_path / "run")
    assert (result.stop_reason, result.steps) == ("SIGINT", 150)
    assert load_checkpoint(result.policy_path)["counters"]["steps"] == 150
    assert len(load_history(tmp_path / "run").step_reward) == 150
    assert signal.getsignal(signal.SIGINT) is before


def test_a_time_budget_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moments = itertools.count(step=0.25)  # A clock of which every reading is a quarter of a second later.
    monkeypatch.setattr("maniskill_tomato.learning.rl.trainer.time.perf_counter", lambda: next(moments))
    result = train(ReachTask(), small_config(total_timesteps=None, max_minutes=0.2), tmp_path / "run")
    assert result.stop_reason == "time budget"
    # 12 s; the end of the run reads the clock a few times more.
    assert 12.0 <= result.seconds < 15.0 and 0 < result.steps <= 48


def test_a_diverging_loss_is_an_error_and_the_last_good_checkpoint_stays(tmp_path: Path) -> None:
    class BreaksLater(ReachTask):
        def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
            if len(self.actions) == 160:
                self.reward_override = float("nan")
            return super().step(actions)

    config = replace(small_config(reward="task", checkpoint_every=120), learning_starts=32)
    with pytest.raises(TrainingDivergedError, match=r"diverged at step 1\d\d: .*nan.*learning rate"):
        train(BreaksLater(), config, tmp_path / "run")
    kept = sorted((tmp_path / "run/checkpoints").iterdir())
    assert [path.name for path in kept] == ["step_000000120.pt"]
    assert all(torch.isfinite(w).all() for w in load_checkpoint(kept[0])["actor"].values())
    assert not (tmp_path / "run/policy.pt").exists()


def test_only_the_newest_checkpoints_are_kept(tmp_path: Path) -> None:
    train(ReachTask(), small_config(total_timesteps=300, checkpoint_every=50), tmp_path / "run")
    names = sorted(path.name for path in (tmp_path / "run/checkpoints").iterdir())
    assert names == ["step_000000200.pt", "step_000000250.pt", "step_000000300.pt"]


def test_the_configuration_is_saved_with_the_run(tmp_path: Path) -> None:
    config = small_config()
    train(ReachTask(), config, tmp_path / "run", seed=7)
    saved = json.loads((tmp_path / "run/config.json").read_text())
    assert (saved["env_id"], saved["seed"]) == ("Reach-v0", 7)
    assert TrainConfig.from_dict(saved["config"]) == config


@pytest.mark.parametrize(
    ("changes", "learns"),
    [
        ({"total_timesteps": 31, "learning_starts": 1, "batch_size": 32}, False),
        ({"total_timesteps": 32, "learning_starts": 1, "batch_size": 32}, True),
        ({"total_timesteps": 32, "learning_starts": 33, "batch_size": 32}, False),
        (
            {"total_timesteps": None, "total_episodes": 2, "batch_size": 512},
            True,
        ),  # As long as they may take.
    ],
)
def test_a_training_too_short_for_its_first_update_is_named(
    changes: dict[str, Any], learns: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Trainer(ReachTask(), "Reach-v0", small_config(**changes), tmp_path / "run", show_progress=False)
    assert ("nothing will be learned" in caplog.text) != learns


def test_a_folder_that_holds_a_run_is_not_overwritten(tmp_path: Path) -> None:
    train(ReachTask(), small_config(total_timesteps=10), tmp_path / "run")
    with pytest.raises(InvalidInputError, match="already holds a run"):
        train(ReachTask(), small_config(total_timesteps=10), tmp_path / "run")


def test_an_environment_without_what_an_option_needs_is_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    with pytest.raises(InvalidInputError, match="needs an environment made with other_targets=1"):
        train(ReachTask(), small_config(hindsight_targets=1), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_auxiliary_losses_are_logged(tmp_path: Path) -> None:
    config = small_config(aux_distance_weight=0.1, aux_visibility_weight=0.1)
    train(ReachTask(), config, tmp_path / "run")
    accumulators = importlib.import_module("tensorboard.backend.event_processing.event_accumulator")
    events = accumulators.EventAccumulator(str(tmp_path / "run/tensorboard"))
    events.Reload()
    for name in ("aux_distance_loss", "aux_visibility_loss"):
        values = [event.value for event in events.Scalars(f"losses/{name}")]
        assert len(values) > 1 and values[-1] < values[0]


def test_tensorboard_gets_the_documented_metrics(tmp_path: Path) -> None:
    train(ReachTask(), small_config(), tmp_path / "run")
    accumulators = importlib.import_module("tensorboard.backend.event_processing.event_accumulator")
    events = accumulators.EventAccumulator(str(tmp_path / "run/tensorboard"))
    events.Reload()
    names = set(events.Tags()["scalars"])
    charts = (
        *("episodic_return", "episodic_length", "episodic_loss", "visible_fraction", "max_visible_fraction"),
        *("success", "exploration", "SPS"),
    )
    losses = ("qf_loss", "qf1_loss", "qf2_loss", "qf1_values", "qf2_values", "actor_loss")
    assert names == {f"charts/{name}" for name in charts} | {f"losses/{name}" for name in losses}
    curves = load_history(tmp_path / "run")
    logged = [event.value for event in events.Scalars("charts/episodic_return")]
    np.testing.assert_allclose(logged, curves.episodes["episodic_return"], rtol=1e-5)


def test_the_history_separates_parallel_episodes() -> None:
    history = TrainingHistory(2)
    history.add_loss(0.5)
    assert history.add_step(2, [1.0, 2.0], [0.1, 0.2], [False, False], [False, False]) == []
    history.add_loss(0.25)
    (ended,) = history.add_step(4, [3.0, 4.0], [0.05, 0.9], [False, True], [False, True])
    assert (ended.episode, ended.end_step, ended.steps) == (0, 4, 2)
    assert (ended.episodic_return, ended.loss_sum) == (6.0, 0.75)
    assert (ended.max_visible_fraction, ended.final_visible_fraction, ended.success) == (0.9, 0.9, True)
    (ended,) = history.add_step(6, [5.0, 7.0], [0.02, 0.3], [False, False], [True, False])
    assert (ended.episode, ended.steps, ended.episodic_return) == (1, 3, 9.0)
    assert (ended.max_visible_fraction, ended.final_visible_fraction, ended.success) == (0.1, 0.02, False)
    assert history.recent_mean("success") == 0.5


def test_the_potential_reward_of_a_whole_episode_depends_on_its_end_and_its_length_only() -> None:
    gamma, cost, v = 0.9, 0.02, [0.3, 0.8, 0.1, 0.9]
    total = 0.0
    for step in range(3):
        last = step == 2
        reward = potential_reward(
            torch.tensor([v[step + 1]]),
            torch.tensor([v[step]]),
            torch.tensor([last]),
            torch.tensor([last]),
            torch.zeros(1),
            gamma=gamma,
            step_cost=cost,
        )
        assert reward.shape == (1,)
        total += gamma**step * float(reward)
    by_hand = gamma**2 * 1.0 - v[0] - cost * (1 + gamma + gamma**2)
    assert total == pytest.approx(by_hand, abs=1e-6)


def test_the_potential_reward_passes_penalties_on() -> None:
    still = potential_reward(
        torch.tensor([0.5, 0.5]),
        torch.tensor([0.5, 0.5]),
        torch.tensor([False, False]),
        torch.tensor([False, True]),
        torch.tensor([0.0, -1.5]),
        gamma=1.0,
        step_cost=0.0,
    )
    torch.testing.assert_close(still, torch.tensor([0.0, -2.0]))


def test_a_run_begins_with_a_given_actor_which_waits_for_the_critics(tmp_path: Path) -> None:
    first = train(ReachTask(), small_config(total_timesteps=60), tmp_path / "first")
    config = small_config(
        total_timesteps=60, initial_policy=str(first.policy_path), actor_starts=10_000, learning_starts=10
    )
    second = train(ReachTask(), config, tmp_path / "second", seed=1)
    assert second.updates > 20
    before, after = load_actor(first.policy_path), load_actor(second.policy_path)
    for a, b in zip(before.actor.parameters(), after.actor.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=0.0)
    moving = replace(config, actor_starts=0)
    third = load_actor(train(ReachTask(), moving, tmp_path / "third", seed=1).policy_path)
    assert not torch.equal(next(third.actor.parameters()), next(before.actor.parameters()))


def test_a_given_actor_of_another_shape_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    first = train(ReachTask(), small_config(total_timesteps=60), tmp_path / "first")
    config = small_config(actor_hidden=(7,), initial_policy=str(first.policy_path))
    with pytest.raises(CheckpointError, match="actor_hidden"):
        train(ReachTask(), config, tmp_path / "second")
    assert not (tmp_path / "second").exists()


def test_every_task_has_a_preset_that_fits_its_actions() -> None:
    assert default_preset("TomatoViewpointGuided-v1") == "td3" and default_preset(None) == "td3"
    for env_id in ("TomatoViewpoint-v1", "TomatoViewpointRow-v1"):
        assert default_preset(env_id) == "general-td3"
    for name, config in PRESETS.items():
        assert len(config.action_scale) == (3 if name.startswith("general-") else 6)
