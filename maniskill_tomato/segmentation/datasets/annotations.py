"""Annotated images: which things are where in a picture.

Image coordinates are continuous: (0, 0) is the top-left corner of the first pixel. A box is (x, y, width, height) in
pixels. A category whose name begins with `tomato` is a fruit.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.picture_files import read_depth, read_picture
from maniskill_tomato.segmentation.masks import Box, EncodedMask

FRUIT_CATEGORIES = ("tomato_ripe", "tomato_turning", "tomato_unripe")
"""Fruits of rendered images by ripeness."""

CATEGORIES = (*FRUIT_CATEGORIES, "leaf", "stem", "robot")
"""Everything that rendered images name."""

PLANT_CATEGORIES = ("leaf", "stem")
"""What hides fruits. Hardly anyone annotates it in photos: an image that names none of it does not say where it is."""


def is_fruit(category: str) -> bool:
    """Whether a category names a tomato, of whichever ripeness."""
    return category.startswith("tomato")


BEHIND = "behind_"
"""Prefix of the names of fruits of the rows behind in rendered images; the arm cannot reach them."""


LEAST_VISIBLE = 0.1
"""Fruits of which less is visible (V_f) are ignored: they need not be found, and finding them is no error."""

SMALLEST_SIDE = 6.0
"""Fruits whose visible box is narrower than this are ignored too, in [px]."""

SMALLEST_SHARE = 12.0 / 640.0
"""Rendered fruits whose visible box is narrower than this share of the image's longer side are ignored too.

A renderer annotates fruits that no one would label: of the 3,301 boxes that people drew in greenhouse photos one in a
hundred is narrower than 12.8 px in an image 640 px long. A 4 cm fruit of 12 px is 1.5 m away, out of reach."""


@dataclass(frozen=True, kw_only=True)
class Instance:
    """One thing in one image."""

    category: str
    box_xywh: Box
    """The visible part's box: left, top, width, height, in [px], inside the image. For a fruit of which nothing is
    visible, and which is only in the amodal set, zeros."""
    visible_mask: EncodedMask | None = None
    """The pixels that show it; None where only boxes are annotated."""
    amodal_mask: EncodedMask | None = None
    """The pixels that would show it with nothing in front, inside the image; None where that is unknown."""
    amodal_box_xywh: Box | None = None
    """The whole thing's box, in [px]; it may leave the image."""
    visible_fraction: float | None = None
    """V_f = V / T (Eq. 4-4), 0 to 1: visible pixels over those of the whole silhouette, in the image and outside."""
    name: str | None = None
    """Which organ of the scene it is, for rendered images."""

    @property
    def fruit(self) -> bool:
        """Whether it is a tomato."""
        return is_fruit(self.category)


def ignored_fruit(fruit: Instance, longer_side: int, smallest_share: float = SMALLEST_SHARE) -> bool:
    """Whether a fruit shows so little that a detector need not find it, and makes no error if it does.

    Args:
        fruit: A fruit. One that a person annotated is judged by `SMALLEST_SIDE` alone.
        longer_side: Of its image, in [px].
        smallest_share: In place of `SMALLEST_SHARE`.
    """
    narrow = min(fruit.box_xywh[2:])
    if narrow < SMALLEST_SIDE or fruit.visible_fraction is None:
        return narrow < SMALLEST_SIDE
    return fruit.visible_fraction < LEAST_VISIBLE or narrow < smallest_share * longer_side


@dataclass(frozen=True, kw_only=True)
class CameraView:
    """Where an image was taken from."""

    T_world_optical: NDArray[np.float64]
    """Pose of the optical frame (z forward, x right, y down), in [m]. Shape (4, 4)."""
    matrix: NDArray[np.float64]
    """The camera matrix K, in [px]. Shape (3, 3)."""


@dataclass(frozen=True, kw_only=True)
class AnnotatedImage:
    """An image file and what is in it."""

    path: Path
    """The image's file."""
    file_name: str
    """Its name inside the data set, with forward slashes."""
    width: int
    """In [px]."""
    height: int
    """In [px]."""
    instances: tuple[Instance, ...] = ()
    depth_path: Path | None = None
    """PNG of the depth, 16 bits, in whole millimetres, 0 where there is no measurement."""
    camera: CameraView | None = None

    @property
    def fruits(self) -> tuple[Instance, ...]:
        """The tomatoes of which something is visible."""
        return tuple(i for i in self.instances if i.fruit and i.box_xywh[2] > 0)

    def named(self, *categories: str) -> tuple[Instance, ...]:
        """The things of these categories of which something is visible."""
        return tuple(i for i in self.instances if i.category in categories and i.box_xywh[2] > 0)

    def load(self) -> NDArray[np.uint8]:
        """The picture, RGB. Shape (height, width, 3).

        Raises:
            InvalidInputError: The file cannot be read as an image of the annotated size.
        """
        picture = read_picture(self.path)
        if picture.shape[:2] != (self.height, self.width):
            raise InvalidInputError(
                f"{self.path} has {picture.shape[1]} x {picture.shape[0]} pixels, "
                f"but its annotation says {self.width} x {self.height}"
            )
        return picture

    def load_depth(self) -> NDArray[np.float64] | None:
        """The measured depth, in [m], 0 where there is none; None without a depth file. Shape (height, width).

        Raises:
            InvalidInputError: The file cannot be read.
        """
        if self.depth_path is None:
            return None
        depth = read_depth(self.depth_path)
        if depth.shape != (self.height, self.width):
            raise InvalidInputError(
                f"{self.depth_path} must have {self.width} x {self.height} pixels, "
                f"got {depth.shape[1]} x {depth.shape[0]}"
            )
        return depth


@dataclass(frozen=True, kw_only=True)
class AnnotatedImages:
    """A set of annotated images, and what was left out when it was read."""

    images: tuple[AnnotatedImage, ...]
    skipped: Mapping[str, int] = field(default_factory=dict)
    """How many images, instances or boxes were left out or clipped, by reason."""

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of all categories that occur: the known ones in their order, then the others by name."""
        found = {i.category for image in self.images for i in image.instances}
        return tuple(c for c in CATEGORIES if c in found) + tuple(sorted(found - set(CATEGORIES)))

    def filtered(self, keep: Callable[[AnnotatedImage], bool]) -> "AnnotatedImages":
        """The images for which `keep` holds."""
        return replace(self, images=tuple(image for image in self.images if keep(image)))

    def skipped_text(self) -> str:
        """What was left out, in words; empty if nothing was."""
        return ", ".join(f"{count} {reason}" for reason, count in sorted(self.skipped.items()))


def joined(sets: Iterable[AnnotatedImages]) -> AnnotatedImages:
    """Several sets as one.

    Raises:
        InvalidInputError: Two images have the same name.
    """
    sets = list(sets)
    images = tuple(image for s in sets for image in s.images)
    doubled = [name for name, count in Counter(i.file_name for i in images).items() if count > 1]
    if doubled:
        raise InvalidInputError(f"{len(doubled)} image names occur more than once, the first is {doubled[0]}")
    skipped: Counter[str] = Counter()
    for s in sets:
        skipped.update(s.skipped)
    return AnnotatedImages(images=images, skipped=dict(skipped))


def clip_box(box: Box, width: int, height: int) -> Box | None:
    """The part of a box inside the image; None if none is left or a number is not finite.

    Args:
        box: Left, top, width, height, in [px].
        width: Of the image, in [px].
        height: Of the image, in [px].
    """
    x, y, w, h = box
    if not np.isfinite(box).all() or w <= 0 or h <= 0:
        return None
    left, top = max(x, 0.0), max(y, 0.0)
    right, bottom = min(x + w, float(width)), min(y + h, float(height))
    if right - left < 1.0 or bottom - top < 1.0:
        return None
    return left, top, right - left, bottom - top


def leaves_image(box: Box, width: int, height: int, tolerance: float = 1.0) -> bool:
    """Whether a box leaves the image by more than `tolerance` [px]."""
    x, y, w, h = box
    return min(x, y) < -tolerance or x + w > width + tolerance or y + h > height + tolerance


def counted_clip(box: Box | None, width: int, height: int, skipped: Counter[str]) -> Box | None:
    """The part of a box inside the image as by `clip_box`; what is cut off or left out is counted in `skipped`."""
    clipped = None if box is None else clip_box(box, width, height)
    if box is None or clipped is None:
        skipped["boxes that are empty or outside the image"] += 1
    elif leaves_image(box, width, height):
        skipped["boxes clipped to the image"] += 1
    return clipped
