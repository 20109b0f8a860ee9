"""Replay: a ring of transitions kept in preallocated tensors, in memory or in files."""

import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.observations import columns_of


class Batch(NamedTuple):
    """Transitions (s, a, r, s', done), one per row."""

    observations: Any
    """Shape (B, observation_dim), or a dictionary with images."""
    actions: Tensor
    """In units of the action scale. Shape (B, action_dim)."""
    rewards: Tensor
    """Shape (B,)."""
    next_observations: Any
    """What was seen after the action, before any reset; as `observations`."""
    terminations: Tensor
    """1.0 where the episode ended for good, 0.0 where it went on or only ran out of time. Shape (B,)."""
    visible_fractions: Tensor | None = None
    """V_f after the action; None where nobody needs it. Shape (B,)."""


class ReplayBuffer:
    """The newest `capacity` transitions; older ones are overwritten.

    Every column of `Batch` is one tensor, of observations with images one a name: `observations.depth`.
    """

    def __init__(
        self,
        capacity: int,
        observation_space: gym.Space[Any],
        action_dim: int,
        device: torch.device | str = "cpu",
        *,
        visible_fractions: bool = False,
        largest_gb: float = 4.0,
        folder: Path | None = None,
        spare: int = 0,
    ) -> None:
        """Allocates an empty buffer.

        Args:
            capacity: How many transitions it holds.
            observation_space: Of one environment: a vector, or a dictionary of a state and images.
            action_dim: Number of actions.
            device: Where they are kept.
            visible_fractions: Whether `Batch.visible_fractions` is kept.
            largest_gb: The most memory, in [GB].
            folder: Keeps the transitions in files there instead of in memory.
            spare: With `folder`: how many transitions may come after a checkpoint until the run goes on from it; so
                many more are kept, because files know only what was written last.

        Raises:
            InvalidInputError: The capacity is not positive, or takes more memory than allowed.
        """
        if capacity < 1:
            raise InvalidInputError(f"the replay capacity must be 1 or more, got {capacity}")
        self.capacity = capacity
        shapes: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
            "actions": ((action_dim,), torch.float32),
            "rewards": ((), torch.float32),
            "terminations": ((), torch.float32),
        }
        for column in ("observations", "next_observations"):
            for name, shape in columns_of(observation_space).items():
                shapes[f"{column}.{name}" if name else column] = shape
        if visible_fractions:
            shapes["visible_fractions"] = ((), torch.float32)
        row = sum(math.prod(shape) * dtype.itemsize for shape, dtype in shapes.values())
        if folder is None and capacity * row > largest_gb * 1e9:
            raise InvalidInputError(
                f"a replay buffer of {capacity} transitions takes {capacity * row / 1e9:.1f} GB, more than "
                f"replay_memory_gb ({largest_gb:g}); set buffer_size to {int(largest_gb * 1e9 / row)} or less, allow "
                "more, or set replay_on_disk"
            )
        self._folder = folder
        self._rows = capacity + (0 if folder is None else spare)
        self._device = torch.device(device)
        self._storage = {
            name: self._allocated(name, (self._rows, *shape), dtype)
            for name, (shape, dtype) in shapes.items()
        }
        self._next = 0
        self._size = 0

    def _allocated(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        if self._folder is None:
            return torch.zeros(shape, dtype=dtype, device=self._device)
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / f"{name}.bin"
        size = math.prod(shape)
        return torch.from_file(str(path), shared=True, size=size, dtype=dtype).view(shape)

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
        if end <= self._rows:
            rows: slice | Tensor = slice(self._next, end)
        else:
            rows = torch.arange(self._next, end, device=self._device) % self._rows
        given = _columns(transitions)
        for name, stored in self._storage.items():
            new = given.get(name)
            if new is None:
                raise InvalidInputError(f"this replay buffer keeps {name}, and the transitions have none")
            stored[rows] = new.to(stored)
        self._next = end % self._rows
        self._size = min(self._size + count, self.capacity)

    def sample(self, batch_size: int, generator: torch.Generator | None = None) -> Batch:
        """Draws `batch_size` transitions uniformly, with replacement.

        Raises:
            InvalidInputError: The buffer is empty.
        """
        if self._size == 0:
            raise InvalidInputError("cannot sample from an empty replay buffer")
        drawn = torch.randint(self._size, (batch_size,), generator=generator, device=self._device)
        if self._rows > self.capacity:
            drawn = (drawn + self._next - self._size) % self._rows
        return _batch({name: stored[drawn] for name, stored in self._storage.items()})

    def state_dict(self) -> dict[str, Any]:
        """The transitions held and where the next one goes, for `load_state_dict`.

        Of a buffer in files: only where it stands in them; they are written out first.
        """
        place = {"next": self._next, "capacity": self.capacity}
        if self._folder is not None:
            for name in self._storage:
                _flush(self._folder / f"{name}.bin")
            return {**place, "rows": self._rows, "size": self._size}
        return {name: stored[: self._size].cpu().clone() for name, stored in self._storage.items()} | place

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes back what `state_dict` gave.

        Raises:
            InvalidInputError: It belongs to a buffer of another size or other transitions.
        """
        if self._folder is not None:
            if state["capacity"] != self.capacity or state.get("rows") != self._rows:
                raise InvalidInputError(
                    f"the replay files in {self._folder} hold {state.get('rows')} rows, and this run's would hold "
                    f"{self._rows}; with replay_on_disk, checkpoint_every and checkpoints_kept stay as they were"
                )
            self._next, self._size = int(state["next"]), int(state["size"])
            return
        size = len(state["rewards"])
        if state["capacity"] != self.capacity or size > self.capacity:
            raise InvalidInputError(
                f"the replay state is of a buffer of {state['capacity']} transitions, this one holds {self.capacity}"
            )
        for name, stored in self._storage.items():
            if state[name].shape != (size, *stored.shape[1:]):
                raise InvalidInputError(
                    f"replay {name} must have shape {(size, *stored.shape[1:])}, got {tuple(state[name].shape)}"
                )
            stored[:size] = state[name].to(stored.device)
        self._next, self._size = int(state["next"]), size


def _columns(batch: Batch) -> dict[str, Tensor]:
    """The tensors of a batch by the names of their columns."""
    columns: dict[str, Tensor] = {}
    for name, value in batch._asdict().items():
        if isinstance(value, Tensor):
            columns[name] = value
        elif value is not None:
            columns |= {f"{name}.{key}": tensor for key, tensor in value.items()}
    return columns


def _batch(columns: dict[str, Tensor]) -> Batch:
    """The batch of columns."""
    values: dict[str, Any] = {}
    for name, tensor in columns.items():
        column, _, key = name.partition(".")
        if key:
            values.setdefault(column, {})[key] = tensor
        else:
            values[column] = tensor
    return Batch(**values)


def _flush(path: Path) -> None:
    """Makes sure that what was written to a mapped file is on the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
