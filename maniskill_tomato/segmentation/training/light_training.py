"""Training of the light segmenter, from ImageNet weights or others, resumable step by step."""

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.network_weights import fill_network
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
from maniskill_tomato.segmentation.detector_configs import AugmentationConfig, LightTrainConfig
from maniskill_tomato.segmentation.fruit_network import FruitNetwork
from maniskill_tomato.segmentation.training.augmentation import augmented
from maniskill_tomato.segmentation.training.detector_training import DetectorTraining
from maniskill_tomato.segmentation.training.fruit_targets import LOSS_WEIGHTS, fruit_losses, make_targets
from maniskill_tomato.segmentation.training.training_pictures import (
    TrainingImages,
    TrainingPicture,
    training_picture,
)
from maniskill_tomato.segmentation.weights import load_weights

logger = logging.getLogger(__name__)


class LightTraining(DetectorTraining[FruitNetwork]):
    """A training of the light segmenter with AdamW; the weights that are kept are averages over the steps."""

    kind = "light"
    loss_weights: ClassVar[Mapping[str, float]] = LOSS_WEIGHTS

    def __init__(
        self, config: LightTrainConfig, images: TrainingImages, start_from: Path | None = None
    ) -> None:
        """Prepares the first step.

        Args:
            config: How to train.
            images: What to train on; of the validation images at most 64 are used.
            start_from: Weights to begin with instead of ImageNet's, of the same backbone.

        Raises:
            CheckpointError: The weights to begin with cannot be used.
            MissingPackageError: ImageNet's come from a package that is not installed.
        """
        super().__init__(
            images,
            steps=config.steps,
            batch_size=config.batch_size,
            log_every=config.log_every,
            save_every=config.save_every,
            gradient_norm=config.gradient_norm,
            seed=config.seed,
        )
        self.config = config
        self.network = FruitNetwork(config.network).to(memory_format=torch.channels_last)
        backbone = self.network.backbone
        if start_from is None:
            backbone.load_imagenet()
        else:
            _load_into(self.network, start_from)
        backbone.keep_fixed(config.fixed_blocks)
        self.kept = copy.deepcopy(self.network).requires_grad_(False)
        of_backbone = {id(p) for p in backbone.parameters()}
        groups = [
            {"params": [p for p in self.network.parameters() if id(p) not in of_backbone], "share": 1.0},
            {"params": [p for p in backbone.parameters() if p.requires_grad], "share": config.backbone_rate},
        ]
        self.optimizer = torch.optim.AdamW(groups, config.learning_rate, weight_decay=config.weight_decay)
        self._validation = _fixed_batches(images.validation, config)

    def learning_rate(self) -> float:
        """See `LightTrainConfig.rate_at`."""
        return self.config.rate_at(self.step)

    def varied_picture(self) -> TrainingPicture:
        """A picture, or a mosaic of four, in another light and another place."""
        variation = self.config.augmentation
        if self.step >= self.config.steps * (1 - self.config.plain_share):
            variation = replace(variation, mosaic_probability=0.0)
        return augmented(lambda: self.images.drawn(self.rng), variation, self.rng)

    def train_step(self) -> dict[str, float]:
        """One batch, after which the averaged weights move towards the present ones; faster at the start."""
        terms = super().train_step()
        share = min(self.config.averaging, self.step / (self.step + 10))
        with torch.no_grad():
            for mean, now in zip(
                self.kept.state_dict().values(), self.network.state_dict().values(), strict=True
            ):
                if mean.is_floating_point():
                    mean.lerp_(now, 1 - share)
                else:
                    mean.copy_(now)
        return terms

    def validation_batches(self) -> list[list[TrainingPicture]]:
        """Pictures that were cut once, without a change of light."""
        return self._validation

    def losses(self, network: FruitNetwork, pictures: list[TrainingPicture]) -> dict[str, Tensor]:
        """See `fruit_losses`."""
        images = torch.from_numpy(np.stack([p.image for p in pictures])).permute(0, 3, 1, 2).float()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.config.bfloat16):
            maps = network(images)
        return fruit_losses(maps, make_targets(pictures))

    def network_config(self) -> dict[str, Any]:
        """See `FruitNetworkConfig`."""
        return asdict(self.config.network)

    def settings(self) -> dict[str, Any]:
        """Those of the configuration."""
        return asdict(self.config)


def _load_into(network: FruitNetwork, path: Path) -> None:
    """Puts saved weights into a network on the same backbone; layers of other sizes begin anew."""
    data = load_weights(path, "light")
    own = network.state_dict()
    fitting = {n: v for n, v in data["state"].items() if n in own and own[n].shape == v.shape}
    missing = [n for n in own if n.startswith("backbone") and n not in fitting]
    if missing:
        raise CheckpointError(
            f"{path} is of a network on another backbone ({missing[0]} does not fit): {data['config']}"
        )
    if anew := len(own) - len(fitting):
        logger.warning("%d of %d layers do not fit those of %s and begin anew", anew, len(own), path)
    try:
        fill_network(network, own | fitting)
    except ValueError as error:
        raise CheckpointError(f"{path} cannot be used: {error}") from error


def _fixed_batches(
    images: Sequence[AnnotatedImage], config: LightTrainConfig, limit: int = 64
) -> list[list[TrainingPicture]]:
    """Pictures that are cut once, without a change of light."""
    rng = np.random.default_rng(0)
    plain = AugmentationConfig(
        size=config.augmentation.size,
        scale=(1.0, 1.0),
        mosaic_probability=0.0,
        flip_probability=0.0,
        brightness=(1.0, 1.0),
        contrast=(1.0, 1.0),
        gamma=(1.0, 1.0),
        channel_gain=(1.0, 1.0),
        saturation=(1.0, 1.0),
        blur_probability=0.0,
        noise_probability=0.0,
    )
    chosen = [images[i] for i in np.linspace(0, len(images) - 1, min(limit, len(images))).astype(int)]
    pictures = [augmented(lambda image=image: training_picture(image), plain, rng) for image in chosen]  # type: ignore[misc]
    size = config.batch_size
    return [pictures[i : i + size] for i in range(0, len(pictures), size)]
