"""From what the environments do to transitions in the replay buffer: over n steps, and of other targets too."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.n_step import NStepReturns
from maniskill_tomato.learning.rl.replay import Batch, ReplayBuffer
from maniskill_tomato.learning.rl.rewards import learned_reward
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.policies.layout import TARGET_POSITION

_OTHER_KEYS = ("other_visible_fraction", "other_success", "other_reward", "other_exists", "other_position")


def make_replay(
    config: TrainConfig, observation_dim: int, action_dim: int, device: torch.device | str = "cpu"
) -> ReplayBuffer:
    """A replay buffer with the columns that the configuration needs."""
    return ReplayBuffer(
        config.buffer_size,
        observation_dim,
        action_dim,
        device,
        discounts=config.n_step > 1,
        visible_fractions=config.needs_visible_fractions,
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
        num_envs: int,
        dims: tuple[int, int],
        device: torch.device | str = "cpu",
    ) -> None:
        """Prepares the windows.

        Args:
            config: How to learn.
            replay: Where transitions go.
            num_envs: Parallel environments.
            dims: Number of observed values and of actions.
            device: Where the transitions are.

        Raises:
            InvalidInputError: Hindsight targets are wanted, and no target is part of the observation.
        """
        if config.hindsight_targets and dims[0] < TARGET_POSITION.stop:
            raise InvalidInputError(
                f"hindsight_targets needs the target's position at {TARGET_POSITION.start} ... "
                f"{TARGET_POSITION.stop - 1} of the observation, which has {dims[0]} values; set it to 0"
            )
        self._config = config
        self._replay = replay
        windows = (config.n_step, config.gamma)
        self._own = NStepReturns(*windows, num_envs, *dims, device) if config.n_step > 1 else None
        rows = num_envs * config.hindsight_targets
        self._others = NStepReturns(*windows, rows, *dims, device) if rows else None
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

    def add(
        self,
        batch: Batch,
        dones: Tensor,
        step_info: Mapping[str, Tensor],
        next_info: Mapping[str, Tensor],
    ) -> None:
        """Stores one step of every environment.

        Args:
            batch: The step as it was, with the learned rewards. Shapes (num_envs, ...).
            dones: Whether the episode ended, for good or by its time limit. Shape (num_envs,), bool.
            step_info: What the step told.
            next_info: The same, but of the new episode's start where one ended.
        """
        visible = step_info["visible_fraction"]
        if self._own is not None:
            self._replay.add(self._own.add(batch, visible, dones))
        else:
            self._replay.add(batch._replace(visible_fractions=visible))
        if self._others is not None:
            self._add_others(self._others, batch, dones, step_info)
        self._remember(next_info)

    def _add_others(
        self, windows: NStepReturns, batch: Batch, dones: Tensor, info: Mapping[str, Tensor]
    ) -> None:
        count = self._config.hindsight_targets
        before = self._before
        success = info["other_success"]
        terminations = success | info["fail"][:, None]
        visible = info["other_visible_fraction"].flatten()
        rewards = learned_reward(
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
        relabelled = Batch(
            _with_target(batch.observations.repeat_interleave(count, dim=0), position),
            batch.actions.repeat_interleave(count, dim=0),
            rewards,
            _with_target(batch.next_observations.repeat_interleave(count, dim=0), position),
            terminations.float().flatten(),
        )
        ends = (terminations | dones[:, None]).flatten()
        complete = windows.add(relabelled, visible, ends, before["other_exists"].flatten())
        self._replay.add(complete)

    def _remember(self, info: Mapping[str, Tensor]) -> None:
        if self._others is not None:
            self._before = {key: info[key].clone() for key in _OTHER_KEYS}

    def state_dict(self) -> dict[str, Any]:
        """What is held back, for `load_state_dict`."""
        state: dict[str, Any] = {"before": {key: value.cpu() for key, value in self._before.items()}}
        for name, windows in (("own", self._own), ("others", self._others)):
            if windows is not None:
                state[name] = windows.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes back what `state_dict` gave."""
        self._before = {key: value.to(self._before[key].device) for key, value in state["before"].items()}
        for name, windows in (("own", self._own), ("others", self._others)):
            if windows is not None:
                windows.load_state_dict(state[name])


def _with_target(observations: Tensor, position: Tensor) -> Tensor:
    """The observations, a fresh tensor, with another target position written into them."""
    observations[:, TARGET_POSITION] = position
    return observations
