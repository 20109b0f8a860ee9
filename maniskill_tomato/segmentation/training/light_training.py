"""Training of the light segmenter, from ImageNet weights or others, resumable step by step."""

import copy
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
from maniskill_tomato.segmentation.efficientnet_lite import EfficientNetLite0
from maniskill_tomato.segmentation.fruit_network import FruitNetwork
from maniskill_tomato.segmentation.training.augmentation import augmented
from maniskill_tomato.segmentation.training.fruit_targets import LOSS_WEIGHTS, fruit_losses, make_targets
from maniskill_tomato.segmentation.training.light_config import AugmentationConfig, LightTrainConfig
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
from maniskill_tomato.segmentation.weights import load_weights, save_weights

logger = logging.getLogger(__name__)


class LightTraining(ResumableTraining):
    """A training that can be stopped after any step and goes on where it was."""

    def __init__(
        self,
        config: LightTrainConfig,
        sets: Sequence[Sequence[AnnotatedImage]],
        shares: Sequence[float],
        validation: Sequence[AnnotatedImage] = (),
        start_from: Path | None = None,
    ) -> None:
        """Prepares the first step.

        Args:
            config: How to train.
            sets: Sets of annotated images.
            shares: How often each set is drawn from.
            validation: Images whose losses are logged, at most 64 of them.
            start_from: Weights to begin with instead of random ones, at least of the same backbone.

        Raises:
            InvalidInputError: A set is empty, or the shares do not fit.
            CheckpointError: The weights to begin with cannot be used.
        """
        super().__init__()
        torch.manual_seed(config.seed)
        self.config = config
        self.steps, self.log_every, self.save_every = config.steps, config.log_every, config.save_every
        self.rng = np.random.default_rng(config.seed)
        self.draw = PictureDraw(sets=sets, shares=shares, rng=self.rng)
        self.network = FruitNetwork(config.network).to(memory_format=torch.channels_last)
        groups: list[dict[str, Any]] = [{"params": list(self.network.parameters()), "share": 1.0}]
        backbone = self.network.backbone
        if isinstance(backbone, EfficientNetLite0):
            if start_from is None:
                backbone.load_imagenet()
            backbone.keep_fixed(config.fixed_blocks)
            known = {id(p) for p in backbone.parameters()}
            groups = [
                {"params": [p for p in self.network.parameters() if id(p) not in known], "share": 1.0},
                {
                    "params": [p for p in backbone.parameters() if p.requires_grad],
                    "share": config.backbone_rate,
                },
            ]
        if start_from is not None:
            _load_into(self.network, start_from)
        self.averaged = copy.deepcopy(self.network).requires_grad_(False)
        self.optimizer = torch.optim.AdamW(groups, config.learning_rate, weight_decay=config.weight_decay)
        self.validation = _fixed_batches(validation, config) if validation else []

    def train_step(self) -> dict[str, float]:
        """One batch; the loss terms."""
        config = self.config
        variation = config.augmentation
        if self.step >= config.steps * (1 - config.plain_share):
            variation = AugmentationConfig(**{**asdict(variation), "mosaic_probability": 0.0})
        pictures = [augmented(self.draw, variation, self.rng) for _ in range(config.batch_size)]
        for group in self.optimizer.param_groups:
            group["lr"] = group["share"] * learning_rate(config, self.step)
        self.network.train()
        terms = self._losses(self.network, pictures)
        loss = weighted(terms)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), config.gradient_norm)
        self.optimizer.step()
        self.step += 1
        self._average()
        return plain_terms(loss, terms)

    def validation_losses(self) -> dict[str, float]:
        """The loss terms of the averaged weights on pictures that are always the same, named `val_...`."""
        self.averaged.eval()
        with torch.no_grad():
            batches = [self._losses(self.averaged, pictures) for pictures in self.validation]
            return mean_losses(plain_terms(weighted(terms), terms) for terms in batches)

    def modules(self) -> dict[str, nn.Module]:
        """The network and its average."""
        return {"network": self.network, "averaged": self.averaged}

    def write_weights(self, path: Path) -> None:
        """Writes the averaged weights.

        Raises:
            CheckpointError: The file cannot be written.
        """
        training = {
            "steps": self.step,
            "pictures": self.step * self.config.batch_size,
            "boxes_only": not _with_masks(self.draw.sets),
            "config": self.described(),
        }
        save_weights(path, "light", self.config.network.to_dict(), self.averaged.state_dict(), training)

    def settings(self) -> dict[str, Any]:
        """Those of the configuration."""
        return asdict(self.config)

    def _losses(self, network: FruitNetwork, pictures: list[TrainingPicture]) -> dict[str, Tensor]:
        images = torch.from_numpy(np.stack([p.image for p in pictures])).permute(0, 3, 1, 2).float()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.config.bfloat16):
            maps = network(images)
        return fruit_losses(maps, make_targets(pictures))

    def _average(self) -> None:
        """Moves the averaged weights towards the present ones; faster at the start."""
        keep = min(self.config.averaging, self.step / (self.step + 10))
        with torch.no_grad():
            for mean, now in zip(
                self.averaged.state_dict().values(), self.network.state_dict().values(), strict=True
            ):
                if mean.is_floating_point():
                    mean.lerp_(now, 1 - keep)
                else:
                    mean.copy_(now)


def weighted(terms: Mapping[str, Tensor]) -> Tensor:
    """The loss: the sum of its terms by `LOSS_WEIGHTS`."""
    return torch.stack([LOSS_WEIGHTS[name] * term for name, term in terms.items()]).sum()


def learning_rate(config: LightTrainConfig, step: int) -> float:
    """The learning rate of a step: linear warm-up, then a cosine down to a hundredth."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    progress = (step - config.warmup_steps) / max(config.steps - config.warmup_steps, 1)
    return config.learning_rate * (0.01 + 0.99 * (1 + math.cos(math.pi * min(progress, 1.0))) / 2)


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
    network.load_state_dict(fitting, strict=False)


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


def _with_masks(sets: Sequence[Sequence[AnnotatedImage]]) -> bool:
    """Whether any fruit has a mask, so that masks are learned."""
    return any(
        fruit.visible_mask is not None for images in sets for image in images for fruit in image.fruits
    )
