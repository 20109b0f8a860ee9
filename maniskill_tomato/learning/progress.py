"""What a run shows while it learns: a progress bar and TensorBoard's event files."""

import sys
import time
from pathlib import Path
from types import TracebackType

from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from maniskill_tomato.learning.history import EpisodeRecord, TrainingHistory
from maniskill_tomato.learning.presets import TrainConfig

LOSS_EVERY = 100
"""Environment steps that one point of the loss curves is the mean of."""

REFRESH_SECONDS = 0.5


class TrainingLog:
    """Writes CleanRL's metric names to TensorBoard and draws the bar; a context manager."""

    def __init__(self, run_dir: Path, config: TrainConfig, show_progress: bool) -> None:
        self._writer = SummaryWriter(str(run_dir / "tensorboard"))
        self._by_episodes = config.total_timesteps is None and config.total_episodes is not None
        self._bar = tqdm(
            total=config.total_episodes if self._by_episodes else config.total_timesteps,
            unit="episode" if self._by_episodes else "step",
            desc="training",
            disable=not show_progress,
            dynamic_ncols=True,
            mininterval=REFRESH_SECONDS if sys.stderr.isatty() else 10.0,
        )
        self._start = self._last_refresh = time.perf_counter()
        self._last_step = 0
        self._last_loss_step = 0
        self._losses: dict[str, list[float]] = {}

    def __enter__(self) -> "TrainingLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()
        self._writer.close()

    def step(
        self,
        step: int,
        losses: dict[str, float],
        exploration: float,
        finished: list[EpisodeRecord],
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
                self._writer.add_scalar(f"charts/{name}", value, record.end_step)
        for name, value in losses.items():
            self._losses.setdefault(name, []).append(value)
        if step - self._last_loss_step >= LOSS_EVERY:
            self._last_loss_step = step
            for name, values in self._losses.items():
                self._writer.add_scalar(f"losses/{name}", sum(values) / len(values), step)
            self._losses.clear()
            self._writer.add_scalar("charts/exploration", exploration, step)
            self._writer.add_scalar("charts/SPS", step / max(now - self._start, 1e-9), step)
        self._bar.update(len(finished) if self._by_episodes else step - self._last_step)
        self._last_step = step
        if now - self._last_refresh >= REFRESH_SECONDS:
            self._last_refresh = now
            self._bar.set_postfix_str(
                f"return {history.recent_mean('episodic_return'):.2f}, "
                f"V_f {history.recent_mean('final_visible_fraction'):.2f}, "
                f"success {history.recent_mean('success'):.0%}, {step / (now - self._start):.0f} steps/s",
                refresh=False,
            )
