"""Training of Mask R-CNN with stochastic gradient descent, epochs and steps of the learning rate, as in 4-2-3."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchvision.models.detection import MaskRCNN

from maniskill_tomato.segmentation.datasets.annotations import CATEGORIES, PLANT_CATEGORIES, is_fruit
from maniskill_tomato.segmentation.detector_configs import MaskRcnnConfig
from maniskill_tomato.segmentation.instances import TOMATO
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
            images: What to train on; without masks, a picture does not train the mask head. Its `things` are those of
                the configuration. If leaves or stems are among them, only the images that name some are kept.
            pretrained: Start from ImageNet weights of the backbone.
            seed: Of the weights and the pictures.
            log_every: Steps between two lines of the history.

        Raises:
            InvalidInputError: Leaves or stems are to be learned, and a set has none annotated.
            MissingWeightsError: The backbone's weights cannot be downloaded.
            MissingPackageError: They come from a package that is not installed.
        """
        plants = [name for name in config.categories if name in PLANT_CATEGORIES]
        images = replace(images, things=[name for name in config.categories if name != TOMATO])
        super().__init__(
            images.naming(plants) if plants else images,
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
            yield [training_picture(image, self.images.things)]

    def losses(self, network: MaskRCNN, pictures: list[TrainingPicture]) -> dict[str, Tensor]:
        """The loss terms by torchvision's names.

        torchvision has one mask loss for a whole batch, so that pictures with masks and pictures with boxes alone go
        through the network one after the other.
        """
        with_masks = [p for p in pictures if p.labels is not None]
        boxes_only = [p for p in pictures if p.labels is None]
        sums: dict[str, Tensor] = {}
        for group in (with_masks, boxes_only):
            if not group:
                continue
            images = [torch.from_numpy(p.image).permute(2, 0, 1).float() / 255 for p in group]
            targets = [mask_rcnn_target(p, self.config.categories) for p in group]
            with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.config.bfloat16):
                found: dict[str, Tensor] = network(images, targets)
            for name, term in found.items():
                share = len(group) / len(pictures)
                if name == "loss_mask" and group is boxes_only:
                    share = 0.0
                sums[name] = sums.get(name, torch.zeros(())) + share * term.float()
        return sums

    def network_config(self) -> dict[str, Any]:
        """See `MaskRcnnConfig`."""
        return asdict(self.config)

    def settings(self) -> dict[str, Any]:
        """Those of the configuration, the seed and where the weights come from."""
        return {**asdict(self.config), "seed": self.seed, "pretrained": self.pretrained}


def mask_rcnn_target(picture: TrainingPicture, categories: Sequence[str]) -> dict[str, Tensor]:
    """What torchvision wants to know about a picture: `boxes` (N, 4), `labels` (N,), `masks` (N, H, W).

    Args:
        picture: Things that are set aside are left out.
        categories: The network's classes without the background; fruits of every ripeness are `tomato`.
    """
    kept = np.flatnonzero(~picture.ignored)
    height, width = picture.image.shape[:2]
    masks = np.zeros((len(kept), height, width), np.uint8)
    if picture.labels is not None and len(kept):
        masks = (picture.labels[None] == (kept + 1)[:, None, None]).astype(np.uint8)
    kinds = [-1] * len(kept) if picture.categories is None else picture.categories[kept].tolist()
    names = [TOMATO if kind < 0 or is_fruit(CATEGORIES[kind]) else CATEGORIES[kind] for kind in kinds]
    return {
        "boxes": torch.from_numpy(np.ascontiguousarray(picture.boxes[kept], np.float32)),
        "labels": torch.tensor([1 + categories.index(name) for name in names], dtype=torch.int64),
        "masks": torch.from_numpy(masks),
    }
