"""What happened during a run: one row per episode and one value per step, for the thesis's training
curves."""

import csv
import io
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.array_files import read_arrays
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically

_Record = TypeVar("_Record")

RECENT_EPISODES = 50
"""Episodes that the progress bar averages over."""


@dataclass(frozen=True, kw_only=True)
class TrainingEpisode:
    """One finished training episode."""

    episode: int
    """Number of the episode, from 0, in the order of finishing."""
    end_step: int
    """Environment steps of the whole run when it finished."""
    steps: int
    """Steps of the episode."""
    episodic_return: float
    """Sum of the task's rewards R (Eq. 4-5)."""
    loss_sum: float
    """Sum of the critic's losses over its steps; 0 for steps without an update."""
    max_visible_fraction: float
    """Largest V_f after any of its steps."""
    final_visible_fraction: float
    """V_f after its last step."""
    success: bool
    """Whether the target became fully visible."""


@dataclass(frozen=True)
class TrainingCurves:
    """The history of a run as arrays."""

    episodes: dict[str, NDArray[np.float64]]
    """One array of shape (episodes,) per field of `TrainingEpisode`."""
    step_reward: NDArray[np.float32]
    """R of every step. Shape (steps,)."""
    step_visible_fraction: NDArray[np.float32]
    """V_f of every step. Shape (steps,)."""


class TrainingHistory:
    """Collects steps and episodes of `num_envs` parallel environments."""

    def __init__(self, num_envs: int) -> None:
        self.episodes: list[TrainingEpisode] = []
        self.recent: deque[TrainingEpisode] = deque(maxlen=RECENT_EPISODES)
        self._step_reward: list[float] = []
        self._step_visible_fraction: list[float] = []
        self._running = [_RunningEpisode() for _ in range(num_envs)]

    def add_step(
        self,
        step: int,
        rewards: list[float],
        visible_fractions: list[float],
        successes: list[bool],
        dones: list[bool],
    ) -> list[TrainingEpisode]:
        """Adds one step of every environment.

        Args:
            step: Environment steps of the run after this one.
            rewards: The task's reward, one per environment.
            visible_fractions: V_f after the step, one per environment.
            successes: Whether the target is fully visible, one per environment.
            dones: Whether the episode ended, one per environment.

        Returns:
            The episodes that ended.
        """
        self._step_reward += rewards
        self._step_visible_fraction += visible_fractions
        finished: list[TrainingEpisode] = []
        for index, running in enumerate(self._running):
            running.steps += 1
            running.episodic_return += rewards[index]
            running.max_visible_fraction = max(running.max_visible_fraction, visible_fractions[index])
            running.success |= successes[index]
            if not dones[index]:
                continue
            finished.append(
                TrainingEpisode(
                    episode=len(self.episodes),
                    end_step=step,
                    final_visible_fraction=visible_fractions[index],
                    **asdict(running),
                )
            )
            self.episodes.append(finished[-1])
            self.recent.append(finished[-1])
            self._running[index] = _RunningEpisode()
        return finished

    def add_loss(self, loss: float) -> None:
        """Adds the critic's loss of this step to every running episode; call it before `add_step`."""
        for running in self._running:
            running.loss_sum += loss

    def recent_mean(self, field: str) -> float:
        """Mean of a field of `TrainingEpisode` over the last episodes; NaN before the first has ended."""
        values = [float(getattr(record, field)) for record in self.recent]
        return sum(values) / len(values) if values else float("nan")

    def state_dict(self) -> dict[str, Any]:
        """Everything so far, episodes that still run included, exactly and as tensors."""
        return {
            "episodes": _columns(self.episodes, TrainingEpisode),
            "running": _columns(self._running, _RunningEpisode),
            "step_reward": torch.tensor(self._step_reward, dtype=torch.float64),
            "step_visible_fraction": torch.tensor(self._step_visible_fraction, dtype=torch.float64),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes back what `state_dict` gave.

        Raises:
            InvalidInputError: It is of another number of environments.
        """
        running = _rows(state["running"], _RunningEpisode)
        if len(running) != len(self._running):
            raise InvalidInputError(
                f"the history is of {len(running)} parallel environments, not of {len(self._running)}"
            )
        self._running = running
        self.episodes = _rows(state["episodes"], TrainingEpisode)
        self.recent = deque(self.episodes[-RECENT_EPISODES:], maxlen=RECENT_EPISODES)
        self._step_reward = state["step_reward"].tolist()
        self._step_visible_fraction = state["step_visible_fraction"].tolist()

    def save(self, folder: Path) -> None:
        """Writes `episodes.csv` and `history.npz` (everything, as arrays) into `folder`."""
        names = [field.name for field in fields(TrainingEpisode)]
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(names)
        writer.writerows([getattr(record, name) for name in names] for record in self.episodes)
        write_atomically(folder / "episodes.csv", text.getvalue().encode())
        arrays: dict[str, Any] = {
            f"episode_{name}": np.array([getattr(record, name) for record in self.episodes], dtype=np.float64)
            for name in names
        }
        arrays["step_reward"] = np.array(self._step_reward, dtype=np.float32)
        arrays["step_visible_fraction"] = np.array(self._step_visible_fraction, dtype=np.float32)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_atomically(folder / "history.npz", buffer.getvalue())


def load_history(folder: Path) -> TrainingCurves:
    """Reads the `history.npz` of a run.

    Raises:
        InvalidInputError: The folder holds none, or it is damaged.
    """
    path = folder / "history.npz"
    if not path.is_file():
        raise InvalidInputError(
            f"{folder} holds no training history (history.npz); give the folder of a training run"
        )
    data = read_arrays(path)
    episodes = {
        key.removeprefix("episode_"): values for key, values in data.items() if key.startswith("episode_")
    }
    try:
        return TrainingCurves(episodes, data["step_reward"], data["step_visible_fraction"])
    except KeyError as error:
        raise InvalidInputError(f"{path} is no training history: it lacks {error}") from error


@dataclass
class _RunningEpisode:
    steps: int = 0
    episodic_return: float = 0.0
    loss_sum: float = 0.0
    max_visible_fraction: float = 0.0
    success: bool = False


def _columns(records: Sequence[Any], kind: type[Any]) -> dict[str, torch.Tensor]:
    """One float64 tensor per field: exact for Python's floats, counts and truth values."""
    return {
        field.name: torch.tensor([float(getattr(r, field.name)) for r in records], dtype=torch.float64)
        for field in fields(kind)
    }


def _rows(columns: dict[str, torch.Tensor], kind: Callable[..., _Record]) -> list[_Record]:
    """The records that `_columns` came from."""
    types: dict[str, Any] = {field.name: field.type for field in fields(cast(Any, kind))}
    lists = {name: [types[name](value) for value in columns[name].tolist()] for name in types}
    return [kind(**dict(zip(lists, row, strict=True))) for row in zip(*lists.values(), strict=True)]
