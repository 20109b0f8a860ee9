"""What a run shows while it learns: a progress bar, TensorBoard's event files, optionally Weights & Biases."""

import logging
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from maniskill_tomato.learning.rl.history import TrainingEpisode, TrainingHistory
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.learning.rl.wandb_log import WandbWriter

logger = logging.getLogger(__name__)

LOSS_EVERY = 100
"""Environment steps that one point of the loss curves is the mean of."""

REFRESH_SECONDS = 0.5


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Where a run is."""

    steps: int
    """Environment steps taken."""
    episodes: int
    """Episodes finished."""
    episodic_return: float
    """Mean over the last episodes; NaN before the first has ended."""
    success: float
    """Share of the last episodes in which the target became fully visible; NaN before the first has ended."""


class TrainingLog:
    """Writes CleanRL's metric names to TensorBoard, and to Weights & Biases if the configuration asks for it, and draws
    the bar; a context manager."""

    def __init__(
        self,
        run_dir: Path,
        config: TrainConfig,
        show_progress: bool,
        start: float,
        report: Callable[[Progress], None] | None = None,
        state: dict[str, Any] | None = None,
        done: tuple[int, int] = (0, 0),
    ) -> None:
        """Opens the event file and the bar.

        Args:
            run_dir: Folder of the run.
            config: The configuration, for the length of the run.
            show_progress: Whether to draw the bar.
            start: When the training began, on the clock of `time.perf_counter`; a continued run's lies before.
            report: Called about twice a second.
            state: What `state_dict` gave when the run was saved; the event files are cut back to that moment.
            done: Steps and episodes at that moment.

        Raises:
            InvalidInputError: Weights & Biases is asked for and cannot be used.
        """
        project = config.wandb_project
        self._wandb = None if project is None else WandbWriter(project, run_dir)
        self._folder = run_dir / "tensorboard"
        if state is not None:
            _cut_back(self._folder, state["event_files"])
        self._writer = SummaryWriter(str(self._folder))
        self._report = report
        self._by_episodes = config.total_timesteps is None and config.total_episodes is not None
        self._bar = tqdm(
            total=config.total_episodes if self._by_episodes else config.total_timesteps,
            unit="episode" if self._by_episodes else "step",
            desc="training",
            initial=done[1] if self._by_episodes else done[0],
            disable=not show_progress,
            dynamic_ncols=True,
            mininterval=REFRESH_SECONDS if sys.stderr.isatty() else 10.0,
        )
        self._start = start
        self._last_refresh = time.perf_counter()
        self._last_step = done[0]
        self._last_loss_step: int = 0 if state is None else state["last_loss_step"]
        self._losses: dict[str, list[float]] = (
            {} if state is None else {name: list(values) for name, values in state["losses"].items()}
        )

    def __enter__(self) -> "TrainingLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()
        try:
            self._writer.close()
        except OSError as failure:
            logger.warning("the TensorBoard files could not be finished: %s", failure)
        if self._wandb is not None:
            self._wandb.close(failed=error is not None)

    def _add(self, name: str, value: float, step: int) -> None:
        self._writer.add_scalar(name, value, step)
        if self._wandb is not None:
            self._wandb.add_scalar(name, value, step)

    def tell(self, step: int, history: TrainingHistory) -> None:
        """Reports where the run is to whom wants to know."""
        if self._report is not None:
            self._report(
                Progress(
                    steps=step,
                    episodes=len(history.episodes),
                    episodic_return=history.recent_mean("episodic_return"),
                    success=history.recent_mean("success"),
                )
            )

    def state_dict(self) -> dict[str, Any]:
        """The losses of the point to come, and how long the event files are after everything so far."""
        self._writer.flush()
        files = {p.name: p.stat().st_size for p in self._folder.glob("events.out.tfevents.*")}
        return {
            "event_files": files,
            "last_loss_step": self._last_loss_step,
            "losses": {name: list(values) for name, values in self._losses.items()},
        }

    def step(
        self,
        step: int,
        losses: dict[str, float],
        exploration: float,
        finished: list[TrainingEpisode],
        history: TrainingHistory,
    ) -> None:
        """Records one step.

        Args:
            step: Environment steps so far.
            losses: Means of this step's updates; empty if there were none.
            exploration: The schedule's value.
            finished: Episodes that ended in this step.
            history: Everything before, this step included.
        """
        now = time.perf_counter()
        for record in finished:
            for name, value in (
                ("episodic_return", record.episodic_return),
                ("episodic_length", record.steps),
                ("episodic_loss", record.loss_sum),
                ("visible_fraction", record.final_visible_fraction),
                ("max_visible_fraction", record.max_visible_fraction),
                ("success", float(record.success)),
            ):
                self._add(f"charts/{name}", value, record.end_step)
        for name, value in losses.items():
            self._losses.setdefault(name, []).append(value)
        if step - self._last_loss_step >= LOSS_EVERY:
            self._last_loss_step = step
            for name, values in self._losses.items():
                self._add(f"losses/{name}", sum(values) / len(values), step)
            self._losses.clear()
            self._add("charts/exploration", exploration, step)
            self._add("charts/SPS", step / max(now - self._start, 1e-9), step)
        self._bar.update(len(finished) if self._by_episodes else step - self._last_step)
        self._last_step = step
        if now - self._last_refresh >= REFRESH_SECONDS:
            self._last_refresh = now
            self.tell(step, history)
            self._bar.set_postfix_str(
                f"return {history.recent_mean('episodic_return'):.2f}, "
                f"V_f {history.recent_mean('final_visible_fraction'):.2f}, "
                f"success {history.recent_mean('success'):.0%}, {step / (now - self._start):.0f} steps/s",
                refresh=False,
            )


def _cut_back(folder: Path, sizes: dict[str, int]) -> None:
    """Drops what event files gained after their sizes were noted."""
    for path in folder.glob("events.out.tfevents.*"):
        if path.name not in sizes:
            path.unlink()
        elif path.stat().st_size > sizes[path.name]:
            os.truncate(path, sizes[path.name])
