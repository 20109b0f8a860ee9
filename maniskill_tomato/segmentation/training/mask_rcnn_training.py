"""Training of Mask R-CNN with stochastic gradient descent, epochs and steps of the learning rate, as in 4-2-3."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
from maniskill_tomato.segmentation.mask_rcnn import build_mask_rcnn
from maniskill_tomato.segmentation.training.augmentation import classic_augmentation
from maniskill_tomato.segmentation.training.detector_presets import MaskRcnnConfig
from maniskill_tomato.segmentation.training.resumable_training import (
    ResumableTraining,
    mean_losses,
    plain_terms,
)
from maniskill_tomato.segmentation.training.training_pictures import (
    PictureDraw,
    TrainingPicture,
    training_picture,
)
from maniskill_tomato.segmentation.weights import save_weights

GRADIENT_NORM = 5.0
"""Longest gradient, as in the implementation that the thesis built on."""


class MaskRcnnTraining(ResumableTraining):
    """A training of Mask R-CNN; its loss terms are those of Fig. 4-10 to 4-14.

    `loss_box_reg` is the boxes' refinement, `loss_classifier` the classifier head, `loss_mask` the mask head,
    `loss_rpn_box_reg` and `loss_objectness` the region proposals.
    """

    def __init__(
        self,
        config: MaskRcnnConfig,
        sets: Sequence[Sequence[AnnotatedImage]],
        shares: Sequence[float],
        validation: Sequence[AnnotatedImage] = (),
        pretrained: bool = False,
        seed: int = 0,
        log_every: int = 50,
    ) -> None:
        """Prepares the first step.

        Args:
            config: How to train.
            sets: Sets of annotated images; without masks, a picture does not train the mask head.
            shares: How often each set is drawn from.
            validation: Images whose losses are measured after each epoch.
            pretrained: Start from ImageNet weights of the backbone.
            seed: Of the weights and the pictures.
            log_every: Steps between two lines of the history.

        Raises:
            InvalidInputError: A set is empty, or the shares do not fit.
            MissingWeightsError: The backbone's weights cannot be downloaded.
            MissingPackageError: They come from a package that is not installed.
        """
        super().__init__()
        torch.manual_seed(seed)
        self.config, self.seed, self.pretrained = config, seed, pretrained
        self.steps, self.save_every = config.epochs * config.steps_per_epoch, config.steps_per_epoch
        self.log_every = min(log_every, config.steps_per_epoch)
        self.rng = np.random.default_rng(seed)
        self.draw = PictureDraw(sets=sets, shares=shares, rng=self.rng)
        self.network = build_mask_rcnn(config, pretrained)
        self.optimizer = torch.optim.SGD(
            [p for p in self.network.parameters() if p.requires_grad],
            config.learning_rates[0][1],
            momentum=config.momentum,
            weight_decay=config.weight_decay,
        )
        self.validation = list(validation)[: config.validation_steps * config.batch_size]

    def train_step(self) -> dict[str, float]:
        """One batch; the loss terms."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate(self.step // self.config.steps_per_epoch + 1)
        pictures = [
            classic_augmentation(self.draw(), self.config.augmentation, self.rng)
            for _ in range(self.config.batch_size)
        ]
        self.network.train()
        terms = self._losses(pictures)
        loss = torch.stack(list(terms.values())).sum()
        if torch.isfinite(loss):
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(self.network.parameters(), GRADIENT_NORM)
            self.optimizer.step()
        self.step += 1
        return plain_terms(loss, terms)

    def validation_losses(self) -> dict[str, float]:
        """The loss terms on the validation images; torchvision tells them in training mode only, and draws regions."""
        # Statistics of the normalisation and the random numbers stay as they were.
        self.network.train()
        for module in self.network.modules():
            if isinstance(module, nn.BatchNorm2d | nn.Dropout):
                module.eval()
        state = torch.get_rng_state()
        with torch.no_grad():
            images = [self._losses([training_picture(image)]) for image in self.validation]
        torch.set_rng_state(state)
        return mean_losses(plain_terms(torch.stack(list(terms.values())).sum(), terms) for terms in images)

    def modules(self) -> dict[str, nn.Module]:
        """The network."""
        return {"network": self.network}

    def settings(self) -> dict[str, Any]:
        """Those of the configuration, the seed and where the weights come from."""
        return {**asdict(self.config), "seed": self.seed, "pretrained": self.pretrained}

    def write_weights(self, path: Path) -> None:
        """Writes the network's weights.

        Raises:
            CheckpointError: The file cannot be written.
        """
        training = {
            "steps": self.step,
            "pictures": self.step * self.config.batch_size,
            "config": self.described(),
        }
        save_weights(path, "mask_rcnn", asdict(self.config), self.network.state_dict(), training)

    def _losses(self, pictures: list[TrainingPicture]) -> dict[str, Tensor]:
        images = [torch.from_numpy(p.image).permute(2, 0, 1).float() / 255 for p in pictures]
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.config.bfloat16):
            found: dict[str, Tensor] = self.network(images, [mask_rcnn_target(p) for p in pictures])
        terms = {name: term.float() for name, term in found.items()}
        if any(p.labels is None for p in pictures):
            terms = {**terms, "loss_mask": terms["loss_mask"] * 0}
        return terms


def mask_rcnn_target(picture: TrainingPicture) -> dict[str, Tensor]:
    """What torchvision wants to know about a picture: `boxes` (N, 4), `labels` (N,), `masks` (N, H, W).

    All fruits are of class 1, `tomato`; fruits that are set aside are left out.
    """
    kept = np.flatnonzero(~picture.ignored)
    height, width = picture.image.shape[:2]
    masks = np.zeros((len(kept), height, width), np.uint8)
    if picture.labels is not None and len(kept):
        masks = (picture.labels[None] == (kept + 1)[:, None, None]).astype(np.uint8)
    return {
        "boxes": torch.from_numpy(np.ascontiguousarray(picture.boxes[kept], np.float32)),
        "labels": torch.ones(len(kept), dtype=torch.int64),
        "masks": torch.from_numpy(masks),
    }
