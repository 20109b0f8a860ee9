"""Training of Mask R-CNN with stochastic gradient descent, epochs and steps of the learning rate, as in 4-2-3."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchvision.models.detection import MaskRCNN

from maniskill_tomato.segmentation.detector_configs import MaskRcnnConfig
from maniskill_tomato.segmentation.mask_rcnn import build_mask_rcnn
from maniskill_tomato.segmentation.training.augmentation import classic_augmentation
from maniskill_tomato.segmentation.training.detector_training import DetectorTraining
from maniskill_tomato.segmentation.training.training_pictures import (
    TrainingImages,
    TrainingPicture,
    training_picture,
)

GRADIENT_NORM = 5.0
"""Longest gradient, as in the implementation that the thesis built on."""


class MaskRcnnTraining(DetectorTraining[MaskRCNN]):
    """A training of Mask R-CNN; its loss terms are those of Fig. 4-10 to 4-14.

    `loss_box_reg` is the boxes' refinement, `loss_classifier` the classifier head, `loss_mask` the mask head,
    `loss_rpn_box_reg` and `loss_objectness` the region proposals.
    """

    kind = "mask_rcnn"

    def __init__(
        self,
        config: MaskRcnnConfig,
        images: TrainingImages,
        pretrained: bool = False,
        seed: int = 0,
        log_every: int = 50,
    ) -> None:
        """Prepares the first step.

        Args:
            config: How to train.
            images: What to train on; without masks, a picture does not train the mask head.
            pretrained: Start from ImageNet weights of the backbone.
            seed: Of the weights and the pictures.
            log_every: Steps between two lines of the history.

        Raises:
            MissingWeightsError: The backbone's weights cannot be downloaded.
            MissingPackageError: They come from a package that is not installed.
        """
        super().__init__(
            images,
            steps=config.epochs * config.steps_per_epoch,
            batch_size=config.batch_size,
            log_every=min(log_every, config.steps_per_epoch),
            save_every=config.steps_per_epoch,
            gradient_norm=GRADIENT_NORM,
            seed=seed,
        )
        self.config, self.seed, self.pretrained = config, seed, pretrained
        self.network = self.kept = build_mask_rcnn(config, pretrained)
        self.optimizer = torch.optim.SGD(
            [p for p in self.network.parameters() if p.requires_grad],
            config.learning_rates[0][1],
            momentum=config.momentum,
            weight_decay=config.weight_decay,
        )

    def learning_rate(self) -> float:
        """That of the present epoch."""
        return self.config.learning_rate(self.step // self.config.steps_per_epoch + 1)

    def varied_picture(self) -> TrainingPicture:
        """A picture that is changed in one way or not at all."""
        return classic_augmentation(self.images.drawn(self.rng), self.config.augmentation, self.rng)

    def validation_batches(self) -> Iterator[list[TrainingPicture]]:
        """The first validation images, each on its own."""
        for image in self.images.validation[: self.config.validation_steps * self.config.batch_size]:
            yield [training_picture(image)]

    def losses(self, network: MaskRCNN, pictures: list[TrainingPicture]) -> dict[str, Tensor]:
        """The loss terms by torchvision's names."""
        images = [torch.from_numpy(p.image).permute(2, 0, 1).float() / 255 for p in pictures]
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.config.bfloat16):
            found: dict[str, Tensor] = network(images, [mask_rcnn_target(p) for p in pictures])
        terms = {name: term.float() for name, term in found.items()}
        if any(p.labels is None for p in pictures):
            terms["loss_mask"] = terms["loss_mask"] * 0
        return terms

    def network_config(self) -> dict[str, Any]:
        """See `MaskRcnnConfig`."""
        return asdict(self.config)

    def settings(self) -> dict[str, Any]:
        """Those of the configuration, the seed and where the weights come from."""
        return {**asdict(self.config), "seed": self.seed, "pretrained": self.pretrained}


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
