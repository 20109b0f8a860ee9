"""The segmenter that knows: fruits from a label image that a renderer gives."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.instances import Image, Instances, check_image


class GroundTruthSegmenter:
    """A `Segmenter` that returns what the label image of the same view says."""

    def __init__(self, labels: Callable[[], NDArray[np.integer]], categories: Mapping[int, str]) -> None:
        """Takes the renderer's side.

        Args:
            labels: Gives the label image of the present view, a number for each thing. Shape (H, W).
            categories: Kind of each number that is a fruit; other numbers are no fruit.
        """
        self.labels = labels
        self.categories = dict(categories)

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The fruits of which a pixel is visible, each with score 1; see `Segmenter`."""
        check_image(image, depth_m)
        labels = self.labels()
        if labels.shape != image.shape[:2]:
            raise InvalidInputError(
                f"labels must have the image's shape {image.shape[:2]}, got {labels.shape}; are they of this view?"
            )
        present = [number for number in np.unique(labels).tolist() if number in self.categories]
        masks = labels[None] == np.array(present, labels.dtype)[:, None, None]
        return Instances.from_masks(masks, categories=tuple(self.categories[n] for n in present))
