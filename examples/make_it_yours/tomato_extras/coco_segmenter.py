"""A segmenter: torchvision's Mask R-CNN, which knows apples and oranges from COCO, as an eye for tomatoes."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torchvision.models.detection import maskrcnn_resnet50_fpn

from maniskill_tomato.segmentation.instances import Instances, check_image

ROUND_FRUITS = (53, 55)
"""COCO's apple and orange."""


class CocoSegmenter:
    """Finds round fruits; their ripeness is not told."""

    def __init__(self, score_threshold: float = 0.5, weights: str | None = "DEFAULT") -> None:
        """Opens the network.

        Args:
            score_threshold: Detections below are left out.
            weights: torchvision's, which are downloaded once; None for random ones.
        """
        self.network = maskrcnn_resnet50_fpn(
            weights=weights, weights_backbone=None, box_score_thresh=score_threshold
        ).eval()

    def __call__(self, image: NDArray[np.uint8], depth_m: NDArray[Any] | None = None) -> Instances:
        """The fruits in an image of shape (H, W, 3)."""
        check_image(image, depth_m)
        with torch.inference_mode():
            (found,) = self.network([torch.from_numpy(image).permute(2, 0, 1).float() / 255])
        kept = torch.isin(found["labels"], torch.tensor(ROUND_FRUITS))
        return Instances(
            boxes=found["boxes"][kept].numpy(),
            scores=found["scores"][kept].numpy(),
            categories=("tomato",) * int(kept.sum()),
            masks=(found["masks"][kept, 0] > 0.5).numpy(),
        )
