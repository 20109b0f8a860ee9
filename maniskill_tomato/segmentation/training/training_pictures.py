"""Annotated images as the light segmenter's training takes them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import (
    FRUIT_CATEGORIES,
    AnnotatedImage,
    AnnotatedImages,
    Instance,
)
from maniskill_tomato.segmentation.datasets.formats import read_annotated
from maniskill_tomato.segmentation.training.fruit_targets import TrainingPicture

LEAST_VISIBLE = 0.1
"""Fruits of which less is visible (V_f) are neither asked for nor punished."""

SMALLEST_SIDE = 6.0
"""Nor are those whose visible box is narrower than this, in [px]."""

SMALLEST_SHARE = 12.0 / 640.0
"""Nor are rendered fruits whose visible box is narrower than this share of the image's longer side.

A renderer annotates fruits that no one would label: of the 3,301 boxes that people drew in greenhouse photos one in a
hundred is narrower than 12.8 px in an image 640 px long. A 4 cm fruit of 12 px is 1.5 m away, out of reach."""


def read_place(place: str) -> AnnotatedImages:
    """The annotated images of FOLDER, or of FOLDER:SPLIT for one list of it.

    Raises:
        InvalidInputError: There is nothing usable.
    """
    if Path(place).exists():
        return read_annotated(place)
    folder, _, split = place.rpartition(":")
    return read_annotated(folder, split) if folder else read_annotated(place)


def ignored_fruit(fruit: Instance, longer_side: int, smallest_share: float = SMALLEST_SHARE) -> bool:
    """Whether a fruit shows so little that a detector is neither asked for it nor punished for it.

    Args:
        fruit: A fruit; whoever annotated it by hand has chosen it, so that only `SMALLEST_SIDE` counts.
        longer_side: Of its image, in [px].
        smallest_share: What stands for `SMALLEST_SHARE`.
    """
    narrow = min(fruit.box_xywh[2:])
    if narrow < SMALLEST_SIDE or fruit.visible_fraction is None:
        return narrow < SMALLEST_SIDE
    return fruit.visible_fraction < LEAST_VISIBLE or narrow < smallest_share * longer_side


def training_picture(image: AnnotatedImage) -> TrainingPicture:
    """An image with its fruits as boxes and labels.

    Raises:
        InvalidInputError: The image cannot be read.
    """
    fruits = image.fruits
    count = len(fruits)
    boxes = np.array([f.box_xywh for f in fruits], np.float32).reshape(-1, 4)
    boxes[:, 2:] += boxes[:, :2]
    whole = np.full((count, 4), np.nan, np.float32)
    labels = np.zeros((image.height, image.width), np.int16)
    with_masks = count > 0 and any(f.visible_mask is not None for f in fruits)
    for index, fruit in enumerate(fruits):
        if fruit.amodal_box_xywh is not None:
            x, y, w, h = fruit.amodal_box_xywh
            whole[index] = x, y, x + w, y + h
        if fruit.visible_mask is not None:
            labels[fruit.visible_mask.decode()] = index + 1
        elif with_masks:
            x, y, w, h = (int(v) for v in fruit.box_xywh)
            labels[y : y + h + 1, x : x + w + 1] = -1
    return TrainingPicture(
        image=image.load(),
        boxes=boxes,
        ignored=np.array([ignored_fruit(f, max(image.width, image.height)) for f in fruits], bool),
        # A picture without fruits has no fruit pixels, wherever its annotation comes from.
        labels=labels if with_masks or not count else None,
        whole_boxes=whole,
        categories=np.array(
            [FRUIT_CATEGORIES.index(f.category) if f.category in FRUIT_CATEGORIES else -1 for f in fruits],
            np.int64,
        ),
    )


@dataclass(kw_only=True)
class PictureDraw:
    """Draws pictures at random from several sets of images; files are kept in memory as they are on the disk."""

    sets: Sequence[Sequence[AnnotatedImage]]
    """The sets of images."""
    shares: Sequence[float]
    """How often each set is drawn from; they need not add up to 1."""
    rng: np.random.Generator
    """Where the draws come from."""

    def __post_init__(self) -> None:
        if not self.sets or any(not s for s in self.sets):
            raise InvalidInputError("there must be images to train on, and some in every set")
        if len(self.shares) != len(self.sets) or min(self.shares) < 0 or not sum(self.shares) > 0:
            raise InvalidInputError(
                f"there must be one share, at least 0, for each of {len(self.sets)} sets; got {list(self.shares)}"
            )
        self._kept: dict[tuple[int, int], TrainingPicture] = {}

    def __call__(self) -> TrainingPicture:
        """A picture.

        Raises:
            InvalidInputError: Its file cannot be read.
        """
        shares = np.array(self.shares, np.float64)
        which = int(self.rng.choice(len(self.sets), p=shares / shares.sum()))
        index = int(self.rng.integers(len(self.sets[which])))
        key = which, index
        if key not in self._kept:
            self._kept[key] = _compact(training_picture(self.sets[which][index]))
        return self._kept[key]


def _compact(picture: TrainingPicture, longest: int = 640) -> TrainingPicture:
    """The picture no longer than this in [px], since a training picture is small."""
    rows, columns = picture.image.shape[:2]
    factor = longest / max(rows, columns)
    if factor >= 1:
        return picture
    size = round(columns * factor), round(rows * factor)
    factors = np.array([size[0] / columns, size[1] / rows] * 2, np.float32)
    labels = picture.labels
    return TrainingPicture(
        image=np.asarray(cv2.resize(picture.image, size, interpolation=cv2.INTER_AREA), np.uint8),
        boxes=picture.boxes * factors,
        ignored=picture.ignored,
        labels=None
        if labels is None
        else np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST), np.int16),
        whole_boxes=None if picture.whole_boxes is None else picture.whole_boxes * factors,
        categories=picture.categories,
    )
