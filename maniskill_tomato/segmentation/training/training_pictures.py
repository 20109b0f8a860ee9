"""Pictures that detectors are trained on, drawn from sets of annotated images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import (
    CATEGORIES,
    AnnotatedImage,
    ignored_fruit,
)


@dataclass(frozen=True, kw_only=True)
class TrainingPicture:
    """A picture with its annotation, ready for the network."""

    image: NDArray[np.uint8]
    """Red, green, blue. Shape (H, W, 3)."""
    boxes: NDArray[np.float32]
    """Visible boxes of the fruits and of the other things asked for: left, top, right, bottom in [px]. Shape (N, 4)."""
    ignored: NDArray[np.bool_]
    """Things that the losses leave out, for instance because they are tiny. Shape (N,)."""
    labels: NDArray[np.int16] | None = None
    """Index of the thing at each pixel plus one; 0 without one, -1 where unknown. None if there are no masks.
    Shape (H, W)."""
    whole_boxes: NDArray[np.float32] | None = None
    """Boxes of the whole fruits in [px], NaN where not known. Shape (N, 4)."""
    categories: NDArray[np.int64] | None = None
    """Kinds, as indices in `annotations.CATEGORIES`; -1 is a fruit of unknown ripeness. Shape (N,)."""


def training_picture(image: AnnotatedImage, things: Sequence[str] = ()) -> TrainingPicture:
    """An image with its fruits, and other things, as boxes and labels.

    Args:
        image: An annotated image.
        things: Categories besides fruits that are wanted, such as `robot`.

    Raises:
        InvalidInputError: The image cannot be read.
    """
    others = tuple(i for i in image.instances if i.category in things and not i.fruit and i.box_xywh[2] > 0)
    fruits = (*image.fruits, *others)
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
            [CATEGORIES.index(f.category) if f.category in CATEGORIES else -1 for f in fruits],
            np.int64,
        ),
    )


@dataclass(kw_only=True)
class TrainingImages:
    """What a detector is trained on; the pictures that were drawn stay in memory."""

    sets: Sequence[Sequence[AnnotatedImage]]
    """Sets of images."""
    shares: Sequence[float] = ()
    """How often each set is drawn from, by default all alike; they need not add up to 1."""
    validation: Sequence[AnnotatedImage] = ()
    """Images whose losses are measured too."""
    things: Sequence[str] = ()
    """Categories of `annotations.CATEGORIES` that are learned besides fruits."""

    def __post_init__(self) -> None:
        self.shares = tuple(self.shares) or (1.0,) * len(self.sets)
        if not self.sets or any(not s for s in self.sets):
            raise InvalidInputError("there must be images to train on, and some in every set")
        if len(self.shares) != len(self.sets) or min(self.shares) < 0 or not sum(self.shares) > 0:
            raise InvalidInputError(
                f"there must be one share, at least 0, for each of {len(self.sets)} sets; got {list(self.shares)}"
            )
        if unknown := [name for name in self.things if name not in CATEGORIES]:
            raise InvalidInputError.choice("a thing to learn", unknown[0], CATEGORIES)
        self._drawn: dict[tuple[int, int], TrainingPicture] = {}

    def naming(self, categories: Sequence[str]) -> "TrainingImages":
        """The images that name a thing of one of these categories.

        An image that names none, such as a photo in which somebody framed the fruits alone, would teach that its leaves
        are background.

        Args:
            categories: Such as `PLANT_CATEGORIES`.

        Raises:
            InvalidInputError: A set has none of a category.
        """
        for number, images in enumerate(self.sets):
            for name in categories:
                if not any(image.named(name) for image in images):
                    raise InvalidInputError(
                        f"none of the {len(images)} images in set {number + 1} of {len(self.sets)} has a {name} "
                        "annotated, so that it would be learned as background; train on rendered images "
                        f"(`maniskill-tomato dataset`), or leave {name} out of the classes"
                    )

        def kept(images: Sequence[AnnotatedImage]) -> tuple[AnnotatedImage, ...]:
            return tuple(image for image in images if image.named(*categories))

        return replace(self, sets=[kept(images) for images in self.sets], validation=kept(self.validation))

    @property
    def with_masks(self) -> bool:
        """Whether any fruit to train on has a mask."""
        fruits = (fruit for images in self.sets for image in images for fruit in image.fruits)
        return any(fruit.visible_mask is not None for fruit in fruits)

    def drawn(self, rng: np.random.Generator) -> TrainingPicture:
        """A picture at random.

        Raises:
            InvalidInputError: Its file cannot be read.
        """
        shares = np.array(self.shares, np.float64)
        which = int(rng.choice(len(self.sets), p=shares / shares.sum()))
        index = int(rng.integers(len(self.sets[which])))
        key = which, index
        if key not in self._drawn:
            self._drawn[key] = _compact(training_picture(self.sets[which][index], self.things))
        return self._drawn[key]


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
