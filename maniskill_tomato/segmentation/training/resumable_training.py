"""A training loop that can be stopped after any step and goes on bit for bit."""

import io
import json
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from maniskill_tomato.errors import CheckpointError, TrainingDivergedError
from maniskill_tomato.files import read_tensors, write_atomically
from maniskill_tomato.segmentation.training.training_pictures import PictureDraw

CHECKPOINT = "checkpoint.pt"
WEIGHTS = "weights.pt"
HISTORY = "history.json"


class ResumableTraining(ABC):
    """The loop, history and checkpoints of a segmenter's training.

    Attributes:
        step: Steps done.
        history: A line every `log_every` steps: `step`, the mean of each loss term since the last line and, where they
            were measured, the losses on validation images as `val_...`.
    """

    steps: int
    log_every: int
    save_every: int
    rng: np.random.Generator
    draw: PictureDraw
    optimizer: torch.optim.Optimizer

    def __init__(self) -> None:
        self.step = 0
        self.history: list[dict[str, float]] = []
        self._sums: dict[str, float] = {}

    @abstractmethod
    def train_step(self) -> dict[str, float]:
        """One batch; the loss terms, `loss` being their weighted sum. It counts `step` up."""

    @abstractmethod
    def validation_losses(self) -> dict[str, float]:
        """The same on validation images, named `val_...`; empty without such images."""

    @abstractmethod
    def modules(self) -> dict[str, nn.Module]:
        """The networks that a checkpoint holds, by name."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """The settings that decide the result besides the data, as JSON can hold them."""

    @abstractmethod
    def write_weights(self, path: Path) -> None:
        """Writes the trained network for use."""

    def described(self) -> dict[str, Any]:
        """The settings, how many images each set has and how often each is drawn from."""
        data = {"images": [len(s) for s in self.draw.sets], "shares": list(self.draw.shares)}
        described: dict[str, Any] = json.loads(json.dumps(self.settings() | data))
        return described

    def run(
        self, out: Path, report: Callable[[str], None], stopped: Callable[[], bool] = lambda: False
    ) -> Path | None:
        """Trains to the end.

        Args:
            out: Folder of checkpoints, history and weights; those of each checkpoint can be used already.
            report: Called with a line of progress every `log_every` steps.
            stopped: Asked after every step; if true, the state is saved and the training ends early.

        Returns:
            File of the weights, or None if it was stopped.

        Raises:
            TrainingDivergedError: A loss is no longer a finite number.
            CheckpointError: A file cannot be written.
        """
        while self.step < self.steps:
            terms = self.train_step()
            if not np.isfinite(terms["loss"]):
                raise TrainingDivergedError(
                    f"the loss is {terms['loss']} at step {self.step}; lower the learning rate"
                )
            for name, value in terms.items():
                self._sums[name] = self._sums.get(name, 0.0) + value
            if self.step % self.log_every == 0 or self.step == self.steps:
                count = self.step % self.log_every or self.log_every
                line = {"step": float(self.step), **{k: v / count for k, v in self._sums.items()}}
                self._sums.clear()
                self.history.append(line)
                report("  ".join(f"{k} {v:.4g}" for k, v in line.items()))
            end = stopped()
            if end or self.step % self.save_every == 0 or self.step == self.steps:
                if self.history and self.history[-1]["step"] == self.step:
                    self.history[-1] |= self.validation_losses()
                self.save(out)
                self.write_weights(out / WEIGHTS)
            if end:
                return None
        return out / WEIGHTS

    def save(self, out: Path) -> None:
        """Writes the state and the history.

        Raises:
            CheckpointError: A file cannot be written.
        """
        state = {
            "step": self.step,
            "settings": json.dumps(self.described()),
            "modules": {name: module.state_dict() for name, module in self.modules().items()},
            "optimizer": self.optimizer.state_dict(),
            "rng": json.dumps(self.rng.bit_generator.state),
            "torch_rng": torch.get_rng_state(),
            "history": json.dumps(self.history),
            "sums": json.dumps(self._sums),
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        write_atomically(out / CHECKPOINT, buffer.getvalue())
        write_atomically(out / HISTORY, json.dumps(self.history, indent=1).encode())

    def resume(self, out: Path) -> None:
        """Goes on where `save` was called last.

        Raises:
            CheckpointError: There is no usable checkpoint, or it is of other settings.
        """
        state = read_tensors(out / CHECKPOINT)
        try:
            if json.loads(state["settings"]) != self.described():
                raise CheckpointError(
                    f"{out / CHECKPOINT} was trained with other settings; repeat them, or choose another --out"
                )
            for name, module in self.modules().items():
                module.load_state_dict(state["modules"][name])
            self.optimizer.load_state_dict(state["optimizer"])
            self.rng.bit_generator.state = json.loads(state["rng"])
            torch.set_rng_state(state["torch_rng"])
            self.step, self.history = int(state["step"]), json.loads(state["history"])
            self._sums = json.loads(state["sums"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise CheckpointError(f"{out / CHECKPOINT} is no state of this training ({error})") from error


def plain_terms(loss: Tensor, terms: Mapping[str, Tensor]) -> dict[str, float]:
    """A loss and its terms as numbers, the loss under the name `loss`."""
    return {"loss": float(loss.detach()), **{name: float(term.detach()) for name, term in terms.items()}}


def mean_losses(batches: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each loss term over batches, named `val_...`; empty without a batch."""
    sums: Counter[str] = Counter()
    count = 0
    for terms in batches:
        sums.update(terms)
        count += 1
    return {f"val_{name}": value / count for name, value in sums.items()}
