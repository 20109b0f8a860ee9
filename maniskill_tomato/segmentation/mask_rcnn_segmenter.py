"""A trained Mask R-CNN as a segmenter."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torchvision.models.detection import MaskRCNN

from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.segmentation.instances import Image, Instances
from maniskill_tomato.segmentation.mask_rcnn import build_mask_rcnn
from maniskill_tomato.segmentation.segmenter import check_image
from maniskill_tomato.segmentation.training.detector_presets import ClassicAugmentation, MaskRcnnConfig
from maniskill_tomato.segmentation.weights import load_weights


class MaskRcnnSegmenter:
    """A `Segmenter` over torchvision's Mask R-CNN; colours only, depth is not used."""

    def __init__(
        self, network: MaskRCNN, categories: tuple[str, ...], score_threshold: float | None = None
    ) -> None:
        """Takes a trained network.

        Args:
            network: It is set to evaluation mode.
            categories: Names of its classes without the background.
            score_threshold: Detections below are left out; by default the network's own.

        Raises:
            InvalidInputError: The threshold is not between 0 and 1.
        """
        if score_threshold is not None:
            if not 0 <= score_threshold <= 1:
                raise InvalidInputError(f"score_threshold must be between 0 and 1, got {score_threshold}")
            heads: Any = network.roi_heads
            heads.score_thresh = score_threshold
        self.network = network.eval().requires_grad_(False)
        self.categories = categories

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The fruits in an image; see `Segmenter`. Its other classes, such as the robot, are left out."""
        check_image(image, depth_m)
        height, width = image.shape[:2]
        x = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float() / 255
        with torch.inference_mode():
            (found,) = self.network([x])
        names = [self.categories[k - 1] for k in found["labels"].tolist()]
        fruit = torch.tensor([name.startswith("tomato") for name in names], dtype=torch.bool)
        boxes, masks = found["boxes"][fruit], found["masks"][fruit, 0] >= 0.5
        whole = ((boxes[:, 2:] - boxes[:, :2]) >= 1).all(1)
        return Instances(
            boxes=boxes[whole].numpy(),
            scores=found["scores"][fruit][whole].numpy(),
            categories=tuple(
                n for n, w in zip((n for n in names if n.startswith("tomato")), whole, strict=True) if w
            ),
            masks=masks[whole].numpy().reshape(-1, height, width),
        )


def config_to_dict(config: MaskRcnnConfig) -> dict[str, Any]:
    """Settings as a file of weights holds them."""
    return asdict(config)


def config_from_dict(data: dict[str, Any]) -> MaskRcnnConfig:
    """The inverse of `config_to_dict`."""
    augmentation = ClassicAugmentation(**data["augmentation"])
    return MaskRcnnConfig(**{**data, "augmentation": augmentation})


def open_mask_rcnn(
    weights: Path | str | None = None, score_threshold: float | None = None
) -> MaskRcnnSegmenter:
    """Opens the weights in a file; none ship.

    Raises:
        CheckpointError: No file is given, or it is missing, damaged or of something else.
    """
    if weights is None:
        raise CheckpointError(
            "no Mask R-CNN weights ship; train some with `python scripts/train_segmenter.py mask-rcnn` and give "
            "their file as the segmenter"
        )
    data = load_weights(Path(weights), "mask_rcnn")
    try:
        config = config_from_dict(data["config"])
        network = build_mask_rcnn(config)
        network.load_state_dict(data["state"])
    except (TypeError, KeyError, RuntimeError) as error:
        raise CheckpointError(
            f"{weights} does not fit this version's network ({str(error).splitlines()[0]})"
        ) from error
    return MaskRcnnSegmenter(network, config.categories, score_threshold)
