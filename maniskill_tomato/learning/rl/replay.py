"""Replay: a ring of transitions kept in preallocated tensors."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError


class Batch(NamedTuple):
    """Transitions (s, a, r, s', done), one per row."""

    observations: Tensor
    """Shape (B, observation_dim)."""
    actions: Tensor
    """In units of the action scale. Shape (B, action_dim)."""
    rewards: Tensor
    """Shape (B,)."""
    next_observations: Tensor
    """What was seen after the action, before any reset. Shape (B, observation_dim)."""
    terminations: Tensor
    """1.0 where the episode ended for good, 0.0 where it went on or only ran out of time. Shape (B,)."""
    visible_fractions: Tensor | None = None
    """V_f after the action; None where nobody needs it. Shape (B,)."""


class ReplayBuffer:
    """The newest `capacity` transitions; older ones are overwritten."""

    def __init__(
        self,
        capacity: int,
        observation_dim: int,
        action_dim: int,
        device: torch.device | str = "cpu",
        *,
        visible_fractions: bool = False,
    ) -> None:
        """Allocates an empty buffer.

        Args:
            capacity: How many transitions it holds.
            observation_dim: Number of observed values.
            action_dim: Number of actions.
            device: Where they are kept.
            visible_fractions: Whether `Batch.visible_fractions` is kept.

        Raises:
            InvalidInputError: The capacity is not positive.
        """
        if capacity < 1:
            raise InvalidInputError(f"the replay capacity must be 1 or more, got {capacity}")
        self.capacity = capacity
        self._storage = Batch(
            torch.zeros(capacity, observation_dim, device=device),
            torch.zeros(capacity, action_dim, device=device),
            torch.zeros(capacity, device=device),
            torch.zeros(capacity, observation_dim, device=device),
            torch.zeros(capacity, device=device),
            torch.zeros(capacity, device=device) if visible_fractions else None,
        )
        self._next = 0
        self._size = 0

    def __len__(self) -> int:
        """Number of transitions held."""
        return self._size

    def add(self, transitions: Batch) -> None:
        """Stores one transition per row, the first row first.

        Raises:
            InvalidInputError: There are more rows than the buffer can hold, or a column that it keeps is missing.
        """
        count = len(transitions.rewards)
        if count > self.capacity:
            raise InvalidInputError(
                f"{count} transitions at once do not fit a replay buffer of {self.capacity}; "
                "raise buffer_size or lower num_envs"
            )
        end = self._next + count
        if end <= self.capacity:
            rows: slice | Tensor = slice(self._next, end)
        else:
            rows = torch.arange(self._next, end, device=self._storage.rewards.device) % self.capacity
        for name, stored in self._columns().items():
            new = getattr(transitions, name)
            if new is None:
                raise InvalidInputError(f"this replay buffer keeps {name}, and the transitions have none")
            stored[rows] = new.to(stored.dtype)
        self._next = end % self.capacity
        self._size = min(self._size + count, self.capacity)

    def sample(self, batch_size: int, generator: torch.Generator | None = None) -> Batch:
        """Draws `batch_size` transitions uniformly, with replacement.

        Raises:
            InvalidInputError: The buffer is empty.
        """
        if self._size == 0:
            raise InvalidInputError("cannot sample from an empty replay buffer")
        rows = torch.randint(
            self._size, (batch_size,), generator=generator, device=self._storage.rewards.device
        )
        return Batch(*(None if stored is None else stored[rows] for stored in self._storage))  # type: ignore[arg-type]

    def state_dict(self) -> dict[str, Any]:
        """The transitions held and where the next one goes, for `load_state_dict`."""
        held = {name: stored[: self._size].cpu().clone() for name, stored in self._columns().items()}
        return {**held, "next": self._next, "capacity": self.capacity}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes back what `state_dict` gave.

        Raises:
            InvalidInputError: It belongs to a buffer of another size or other transitions.
        """
        size = len(state["rewards"])
        if state["capacity"] != self.capacity or size > self.capacity:
            raise InvalidInputError(
                f"the replay state is of a buffer of {state['capacity']} transitions, this one holds {self.capacity}"
            )
        for name, stored in self._columns().items():
            if state[name].shape != (size, *stored.shape[1:]):
                raise InvalidInputError(
                    f"replay {name} must have shape {(size, *stored.shape[1:])}, got {tuple(state[name].shape)}"
                )
            stored[:size] = state[name].to(stored.device)
        self._next, self._size = int(state["next"]), size

    def _columns(self) -> dict[str, Tensor]:
        """The tensors that are kept, by their names in `Batch`."""
        return {name: stored for name, stored in self._storage._asdict().items() if stored is not None}
