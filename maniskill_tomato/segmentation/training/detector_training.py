"""The training loop of the detectors, which can be stopped after any step and goes on bit for bit."""

import io
import json
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from maniskill_tomato.errors import CheckpointError, TrainingDivergedError
from maniskill_tomato.files import read_tensors, write_atomically
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.network_weights import fill_network
from maniskill_tomato.segmentation.training.training_pictures import TrainingImages, TrainingPicture
from maniskill_tomato.segmentation.weights import save_weights

CHECKPOINT = "checkpoint.pt"
WEIGHTS = "weights.pt"
HISTORY = "history.json"

Network = TypeVar("Network", bound=nn.Module)


class DetectorTraining(ABC, Generic[Network]):
    """The steps, history, checkpoints and weights of a training; a detector brings its network, pictures and loss.

    Attributes:
        network: What is trained.
        kept: What is validated and written for use: the network itself or its running average.
        optimizer: Its groups of parameters may have a `share` of the learning rate.
        step: Steps done.
        history: A line every `log_every` steps: `step`, the mean of each loss term since the last line and, where they
            were measured, the losses on validation images as `val_...`.
    """

    kind: ClassVar[str]
    """Name of the segmenter that the weights are for."""
    loss_weights: ClassVar[Mapping[str, float]] = {}
    """Weights of the loss terms in their sum, 1 where there is none."""

    network: Network
    kept: Network
    optimizer: torch.optim.Optimizer

    def __init__(
        self,
        images: TrainingImages,
        *,
        steps: int,
        batch_size: int,
        log_every: int,
        save_every: int,
        gradient_norm: float,
        seed: int,
    ) -> None:
        """Seeds PyTorch, so that the network is built after it.

        Args:
            images: What to train and validate on.
            steps: Batches in all.
            batch_size: Pictures in a batch.
            log_every: Steps between two lines of the history.
            save_every: Steps between two checkpoints.
            gradient_norm: Longest gradient; longer ones are shortened.
            seed: Of the weights and the pictures.
        """
        torch.manual_seed(seed)
        self.rng = np.random.default_rng(seed)
        self.images, self.steps, self.batch_size = images, steps, batch_size
        self.log_every, self.save_every, self.gradient_norm = log_every, save_every, gradient_norm
        self.step = 0
        self.history: list[dict[str, float]] = []
        self._sums: dict[str, float] = {}

    @abstractmethod
    def learning_rate(self) -> float:
        """That of the present step."""

    @abstractmethod
    def varied_picture(self) -> TrainingPicture:
        """A picture to train on."""

    @abstractmethod
    def validation_batches(self) -> Iterable[list[TrainingPicture]]:
        """Pictures that are the same each time; none without such images."""

    @abstractmethod
    def losses(self, network: Network, pictures: list[TrainingPicture]) -> dict[str, Tensor]:
        """The unweighted loss terms of a batch."""

    @abstractmethod
    def network_config(self) -> dict[str, Any]:
        """What the segmenter builds its network from."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """The settings that decide the result besides the data, as JSON can hold them."""

    def train_step(self) -> dict[str, float]:
        """One batch; the loss terms, `loss` being their weighted sum."""
        pictures = [self.varied_picture() for _ in range(self.batch_size)]
        for group in self.optimizer.param_groups:
            group["lr"] = group.get("share", 1.0) * self.learning_rate()
        self.network.train()
        terms = self._with_sum(self.losses(self.network, pictures))
        self.optimizer.zero_grad(set_to_none=True)
        terms["loss"].backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), self.gradient_norm)
        self.optimizer.step()
        self.step += 1
        return _numbers(terms)

    def validation_losses(self) -> dict[str, float]:
        """The means of the loss terms on the validation images, named `val_...`; empty without such images."""
        # torchvision tells losses in training mode only, and draws regions. Statistics of the normalisation and the
        # random numbers stay as they were.
        self.kept.train()
        for module in self.kept.modules():
            if isinstance(module, nn.BatchNorm2d | nn.Dropout):
                module.eval()
        random_state = torch.get_rng_state()
        sums: Counter[str] = Counter()
        count = 0
        with torch.no_grad():
            for pictures in self.validation_batches():
                sums.update(_numbers(self._with_sum(self.losses(self.kept, pictures))))
                count += 1
        torch.set_rng_state(random_state)
        return {f"val_{name}": value / count for name, value in sums.items()}

    def described(self) -> dict[str, Any]:
        """The settings, how many images each set has and how often each is drawn from."""
        data = {"images": [len(s) for s in self.images.sets], "shares": list(self.images.shares)}
        described: dict[str, Any] = json.loads(json.dumps(self.settings() | data))
        return described

    def run(
        self, out: Path, report: Callable[[str], None], stopped: Callable[[], bool] = lambda: False
    ) -> Path | None:
        """Trains to the end, from the checkpoint in `out` if there is one.

        Args:
            out: Folder of checkpoints, history and weights; those of each checkpoint can be used already.
            report: Called with a line of progress every `log_every` steps.
            stopped: Asked after every step; if true, the state is saved and the training ends early.

        Returns:
            File of the weights, or None if it was stopped.

        Raises:
            TrainingDivergedError: A loss is no longer a finite number.
            CheckpointError: A file cannot be written, the checkpoint is of other settings, or another process trains
                in the folder.
        """
        with only_writer(out, "trains"):
            return self._run(out, report, stopped)

    def _run(self, out: Path, report: Callable[[str], None], stopped: Callable[[], bool]) -> Path | None:
        if (out / CHECKPOINT).is_file():
            self.resume(out)
        while self.step < self.steps:
            terms = self.train_step()
            if not np.isfinite(terms["loss"]):
                raise TrainingDivergedError(
                    f"the loss is {terms['loss']} at step {self.step}; lower the learning rate"
                )
            for name, value in terms.items():
                self._sums[name] = self._sums.get(name, 0.0) + value
            last = self.step == self.steps
            if last or self.step % self.log_every == 0:
                count = self.step % self.log_every or self.log_every
                line = {"step": float(self.step), **{k: v / count for k, v in self._sums.items()}}
                self._sums.clear()
                self.history.append(line)
                report("  ".join(f"{k} {v:.4g}" for k, v in line.items()))
            end = stopped()
            if end or last or self.step % self.save_every == 0:
                if self.history and self.history[-1]["step"] == self.step:
                    self.history[-1] |= self.validation_losses()
                self.save(out)
                self.write_weights(out / WEIGHTS)
            if end:
                return None
        return out / WEIGHTS

    def write_weights(self, path: Path) -> None:
        """Writes the trained network for use.

        Raises:
            CheckpointError: The file cannot be written.
        """
        training = {
            "steps": self.step,
            "pictures": self.step * self.batch_size,
            "boxes_only": not self.images.with_masks,
            "config": self.described(),
        }
        save_weights(path, self.kind, self.network_config(), self.kept.state_dict(), training)

    def save(self, out: Path) -> None:
        """Writes the state and the history.

        Raises:
            CheckpointError: A file cannot be written.
        """
        state = {
            "step": self.step,
            "settings": json.dumps(self.described()),
            "modules": {name: module.state_dict() for name, module in self._modules().items()},
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
            for name, module in self._modules().items():
                fill_network(module, state["modules"][name])
            self.optimizer.load_state_dict(state["optimizer"])
            self.rng.bit_generator.state = json.loads(state["rng"])
            torch.set_rng_state(state["torch_rng"])
            self.step, self.history = int(state["step"]), json.loads(state["history"])
            self._sums = json.loads(state["sums"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise CheckpointError(f"{out / CHECKPOINT} is no state of this training ({error})") from error

    def _modules(self) -> dict[str, nn.Module]:
        """The networks that a checkpoint holds, by name."""
        averaged = {} if self.kept is self.network else {"averaged": self.kept}
        return {"network": self.network, **averaged}

    def _with_sum(self, terms: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The loss terms after their weighted sum, which is named `loss`."""
        weighted = [self.loss_weights.get(name, 1.0) * term for name, term in terms.items()]
        return {"loss": torch.stack(weighted).sum(), **terms}


def _numbers(terms: Mapping[str, Tensor]) -> dict[str, float]:
    return {name: float(term.detach()) for name, term in terms.items()}
