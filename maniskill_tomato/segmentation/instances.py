"""Fruits found in one image: boxes, scores, categories, masks."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import FRUIT_CATEGORIES as FRUIT_CATEGORIES
from maniskill_tomato.segmentation.datasets.annotations import is_fruit

Image = NDArray[np.uint8]
"""Colours red, green, blue. Shape (H, W, 3)."""

TOMATO = "tomato"
"""Category of a fruit whose ripeness is not known; the others begin with it."""


@dataclass(frozen=True, kw_only=True)
class Instances:
    """What a segmenter found in an image, best score first."""

    boxes: NDArray[np.float32]
    """Left, top, right, bottom of the visible part in [px]; right and bottom are exclusive. Shape (N, 4)."""
    scores: NDArray[np.float32]
    """Confidence between 0 and 1. Shape (N,)."""
    categories: tuple[str, ...]
    """Kind of each; of a fruit it starts with `tomato`. N of them."""
    masks: NDArray[np.bool_]
    """Visible pixels of each. Shape (N, H, W)."""
    amodal_boxes: NDArray[np.float32] | None = None
    """Boxes of the whole fruits as if nothing stood in front, in [px]; they may reach beyond the image. None if the
    segmenter does not predict them. Shape (N, 4)."""

    def __post_init__(self) -> None:
        count = len(self.boxes)
        shapes = (self.boxes.shape, self.scores.shape, len(self.categories), len(self.masks), self.masks.ndim)
        if shapes != ((count, 4), (count,), count, count, 3):
            raise InvalidInputError(
                "instances must have boxes (N, 4), scores (N,), N categories and masks (N, H, W); got "
                f"{self.boxes.shape}, {self.scores.shape}, {len(self.categories)} and {self.masks.shape}"
            )
        if self.amodal_boxes is not None and self.amodal_boxes.shape != (count, 4):
            raise InvalidInputError(
                f"amodal boxes must have shape ({count}, 4), got {self.amodal_boxes.shape}"
            )

    def __len__(self) -> int:
        return len(self.boxes)

    @classmethod
    def empty(cls, height: int, width: int) -> "Instances":
        """Nothing found in an image of this size in [px]."""
        return cls(
            boxes=np.zeros((0, 4), np.float32),
            scores=np.zeros(0, np.float32),
            categories=(),
            masks=np.zeros((0, height, width), bool),
        )

    @classmethod
    def from_masks(
        cls,
        masks: NDArray[np.bool_],
        scores: NDArray[np.float32] | None = None,
        categories: tuple[str, ...] | None = None,
    ) -> "Instances":
        """Instances whose boxes are those around their masks; masks without a pixel are left out.

        Args:
            masks: Visible pixels. Shape (N, H, W).
            scores: Confidences, by default 1. Shape (N,).
            categories: Kinds, by default `tomato`.
        """
        kept = np.flatnonzero(masks.any(axis=(1, 2))) if len(masks) else np.zeros(0, np.int64)
        scores = np.ones(len(masks), np.float32) if scores is None else scores.astype(np.float32)
        categories = (TOMATO,) * len(masks) if categories is None else categories
        boxes = [mask_box(masks[i]) for i in kept]
        found = cls(
            boxes=np.array(boxes, np.float32).reshape(-1, 4),
            scores=scores[kept],
            categories=tuple(categories[i] for i in kept),
            masks=masks[kept],
        )
        return found.chosen(np.argsort(-found.scores, kind="stable"))

    def chosen(self, which: NDArray[Any]) -> "Instances":
        """Those with the indices, or where the flags are true, in this order. Shape (K,) or (N,)."""
        indices = np.arange(len(self))[which]
        return Instances(
            boxes=self.boxes[indices],
            scores=self.scores[indices],
            categories=tuple(self.categories[i] for i in indices),
            masks=self.masks[indices],
            amodal_boxes=None if self.amodal_boxes is None else self.amodal_boxes[indices],
        )

    def fruits(self) -> "Instances":
        """Those that are tomatoes, of whichever ripeness."""
        return self.chosen(np.array([is_fruit(c) for c in self.categories], bool))

    def amodal_masks(self) -> NDArray[np.bool_]:
        """Pixels of the whole fruits inside the image: the ellipses in the amodal boxes, and what is visible.

        A tomato is close to a spheroid, whose outline is an ellipse. Shape (N, H, W).

        Raises:
            InvalidInputError: The segmenter does not predict amodal boxes.
        """
        if self.amodal_boxes is None:
            raise InvalidInputError(
                "these instances have no amodal boxes; use a segmenter that predicts them"
            )
        height, width = self.masks.shape[1:]
        ellipses = [box_ellipse(box, height, width) for box in self.amodal_boxes]
        return np.array(ellipses, bool).reshape(-1, height, width) | self.masks

    def visible_fractions(self) -> NDArray[np.float32]:
        """V_f = V / T of each (Eq. 4-4): visible pixels over those of the whole fruit, in or out of the image.

        T is the area of the ellipse in the amodal box. Shape (N,).

        Raises:
            InvalidInputError: The segmenter does not predict amodal boxes.
        """
        if self.amodal_boxes is None:
            raise InvalidInputError(
                "these instances have no amodal boxes; use a segmenter that predicts them"
            )
        size = np.maximum(self.amodal_boxes[:, 2:] - self.amodal_boxes[:, :2], 1)
        visible = self.masks.sum(axis=(1, 2))
        return np.asarray(np.minimum(visible / (np.pi / 4 * size.prod(axis=1)), 1), np.float32)


def check_image(image: Image, depth_m: NDArray[np.float32] | None = None) -> None:
    """Accepts an image that a segmenter can work on.

    Raises:
        InvalidInputError: A shape or a type differs from what `Segmenter` documents.
    """
    if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        shape = getattr(image, "shape", None)
        raise InvalidInputError(
            "an image must have shape (H, W, 3), red, green, blue, as uint8 from 0 to 255; "
            f"got shape {shape} of {getattr(image, 'dtype', type(image).__name__)}"
        )
    if image.size == 0:
        raise InvalidInputError(f"an image must have pixels; got shape {image.shape}")
    if depth_m is not None and (
        depth_m.shape != image.shape[:2] or not np.issubdtype(depth_m.dtype, np.floating)
    ):
        raise InvalidInputError(
            f"depth must be floats in [m] of the image's shape {image.shape[:2]}; "
            f"got shape {depth_m.shape} of {depth_m.dtype}"
        )


def mask_box(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom around the true pixels of a mask that has some; the last two are exclusive, in [px]."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def box_ellipse(box: NDArray[np.float32], height: int, width: int) -> NDArray[np.bool_]:
    """Pixels of the ellipse that touches the sides of a box, left, top, right, bottom in [px]. Shape (H, W)."""
    left, top, right, bottom = (float(v) for v in box)
    y, x = np.ogrid[:height, :width]
    across = (x + 0.5 - (left + right) / 2) / max((right - left) / 2, 1e-6)
    down = (y + 0.5 - (top + bottom) / 2) / max((bottom - top) / 2, 1e-6)
    return np.asarray(across**2 + down**2 <= 1)
