"""Annotated images: what stands where in a picture, read from and written to the usual formats.

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
from maniskill_tomato.segmentation.masks import Box, EncodedMask

FRUIT_CATEGORIES = ("tomato_ripe", "tomato_turning", "tomato_unripe")
"""Fruits of rendered images by ripeness."""

CATEGORIES = (*FRUIT_CATEGORIES, "leaf", "stem", "robot")
"""Everything that rendered images name."""


def is_fruit(category: str) -> bool:
    """Whether a category names a tomato, of whichever ripeness."""
    return category.startswith("tomato")


BEHIND = "behind_"
"""How the names of fruits of the rows behind begin in rendered images; an arm in front of its row cannot reach them."""


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
        import cv2

        depth = cv2.imread(str(self.depth_path), cv2.IMREAD_UNCHANGED)
        if depth is None or depth.dtype != np.uint16 or depth.shape != (self.height, self.width):
            raise InvalidInputError(
                f"{self.depth_path} must be a 16-bit image of {self.width} x {self.height} pixels, in millimetres"
            )
        return np.asarray(depth, dtype=np.float64) / 1000.0


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


def read_picture(path: Path) -> NDArray[np.uint8]:
    """An image file as RGB. Shape (height, width, 3).

    Raises:
        InvalidInputError: There is no such file, or it is not an image that OpenCV can decode.
    """
    import cv2

    if not path.is_file():
        raise InvalidInputError(f"there is no image {path}")
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise InvalidInputError(f"{path} cannot be read as an image; use JPEG or PNG")
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)


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
