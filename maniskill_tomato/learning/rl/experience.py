"""From what the environments do to transitions in the replay buffer, of other targets too."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.replay import Batch, ReplayBuffer
from maniskill_tomato.learning.rl.rewards import training_reward
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.policies.layout import TARGET_POSITION

_OTHER_KEYS = ("other_visible_fraction", "other_success", "other_reward", "other_exists", "other_position")


REPLAY_FOLDER = "replay"
"""Where a run keeps its replay buffer with `replay_on_disk`."""


def make_replay(
    config: TrainConfig,
    observation_space: gym.Space[Any],
    action_dim: int,
    device: torch.device | str = "cpu",
    run_dir: Path | None = None,
) -> ReplayBuffer:
    """A replay buffer with the columns that the configuration needs.

    Args:
        config: How to learn.
        observation_space: Of one environment.
        action_dim: Number of actions.
        device: Where it is kept.
        run_dir: Folder of the run, for a buffer on the disk.
    """
    on_disk = config.replay_on_disk and run_dir is not None
    # A run may go on from any checkpoint that is kept; the last one may lie a whole step of all environments later.
    spare = config.checkpoints_kept * (config.checkpoint_every + config.num_envs)
    return ReplayBuffer(
        config.buffer_size,
        observation_space,
        action_dim,
        device,
        visible_fractions=config.aux_visibility_weight > 0.0,
        largest_gb=config.replay_memory_gb,
        folder=run_dir / REPLAY_FOLDER if on_disk and run_dir is not None else None,
        spare=spare,
    )


class Experience:
    """Stores every step once as it was and, with `hindsight_targets` K, once for each of K other tomatoes.

    Hindsight (Andrychowicz et al., 2017): the same movement, had another tomato been the target. The environment
    itself says what it would have given (`other_targets` of the tasks), so that nothing is guessed: the position of
    the other tomato stands in both observations, its V_f decides about reward and termination, and where the real
    episode ends first, the other's is cut off as by a time limit. All of these transitions are kept, the ones that
    see nothing too: to keep successes only would teach that views succeed more often than they do.
    """

    def __init__(
        self,
        config: TrainConfig,
        replay: ReplayBuffer,
        observation_dim: int,
    ) -> None:
        """Stores nothing yet.

        Args:
            config: How to learn.
            replay: Where transitions go.
            observation_dim: Number of observed values.

        Raises:
            InvalidInputError: Hindsight targets are wanted, and no target is part of the observation.
        """
        if config.hindsight_targets and observation_dim < TARGET_POSITION.stop:
            raise InvalidInputError(
                f"hindsight_targets needs the target's position at {TARGET_POSITION.start} ... "
                f"{TARGET_POSITION.stop - 1} of the observation, which has {observation_dim} values; set it to 0"
            )
        self._config = config
        self._replay = replay
        self._before: dict[str, Tensor] = {}

    def begin(self, info: Mapping[str, Tensor]) -> None:
        """Takes what the reset at the start of a run said beside the observations.

        Raises:
            InvalidInputError: Hindsight targets are wanted, and the environment does not judge as many.
        """
        count = self._config.hindsight_targets
        if count and (any(key not in info for key in _OTHER_KEYS) or info["other_exists"].shape[-1] != count):
            raise InvalidInputError(
                f"hindsight_targets {count} needs an environment made with other_targets={count}, which tells "
                f"{', '.join(_OTHER_KEYS)}; make it so, or set hindsight_targets to 0"
            )
        self._remember(info)

    def add(self, batch: Batch, step_info: Mapping[str, Tensor], next_info: Mapping[str, Tensor]) -> None:
        """Stores one step of every environment.

        Args:
            batch: The step as it was, with the learned rewards. Shapes (num_envs, ...).
            step_info: What the step told.
            next_info: The same, but of the new episode's start where one ended.
        """
        self._replay.add(batch._replace(visible_fractions=step_info["visible_fraction"]))
        if self._config.hindsight_targets:
            self._replay.add(self._of_others(batch, step_info))
        self._remember(next_info)

    def _of_others(self, batch: Batch, info: Mapping[str, Tensor]) -> Batch:
        """The step had another tomato been the target, once for each that exists."""
        count = self._config.hindsight_targets
        before = self._before
        success = info["other_success"]
        terminations = success | info["fail"][:, None]
        visible = info["other_visible_fraction"].flatten()
        rewards = training_reward(
            self._config,
            info["other_reward"].flatten(),
            terminations.flatten(),
            before["other_visible_fraction"].flatten(),
            {
                "visible_fraction": visible,
                "success": success.flatten(),
                "reward_penalty": info["reward_penalty"].repeat_interleave(count),
            },
        )
        position = before["other_position"].flatten(0, 1)
        exists = before["other_exists"].flatten()
        assert isinstance(batch.observations, Tensor) and isinstance(batch.next_observations, Tensor)
        relabelled = Batch(
            _with_target(batch.observations.repeat_interleave(count, dim=0), position),
            batch.actions.repeat_interleave(count, dim=0),
            rewards,
            _with_target(batch.next_observations.repeat_interleave(count, dim=0), position),
            terminations.float().flatten(),
            visible,
        )
        return Batch(*(column[exists] for column in relabelled if isinstance(column, Tensor)))

    def _remember(self, info: Mapping[str, Tensor]) -> None:
        if self._config.hindsight_targets:
            self._before = {key: info[key].clone() for key in _OTHER_KEYS}

    def state_dict(self) -> dict[str, Any]:
        """What the last step told of the other tomatoes, for `load_state_dict`."""
        return {"before": {key: value.cpu() for key, value in self._before.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes back what `state_dict` gave."""
        self._before = {key: value.to(self._before[key].device) for key, value in state["before"].items()}


def _with_target(observations: Tensor, position: Tensor) -> Tensor:
    """The observations, a fresh tensor, with another target position written into them."""
    observations[:, TARGET_POSITION] = position
    return observations
