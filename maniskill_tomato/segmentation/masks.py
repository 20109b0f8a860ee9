"""Binary masks in COCO's run-length encoding; what is read is checked, pycocotools writes.

COCO counts runs of 0 and 1 in turn down the columns, from the left one. A mask here is a boolean array of shape
(height, width), True where the thing is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError

BinaryMask = NDArray[np.bool_]
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class EncodedMask:
    """A binary mask as the lengths of its runs."""

    height: int
    """Of the image, in [px]."""
    width: int
    """Of the image, in [px]."""
    counts: str
    """COCO's compressed run lengths."""

    @classmethod
    def encode(cls, mask: NDArray[Any]) -> "EncodedMask":
        """Encodes a mask.

        Args:
            mask: True or non-zero where the thing is. Shape (height, width).

        Raises:
            InvalidInputError: It is not an image of one channel.
        """
        from pycocotools import mask as coco_mask

        if mask.ndim != 2 or 0 in mask.shape:
            raise InvalidInputError(f"a mask must have shape (height, width), got {mask.shape}")
        coded: Any = coco_mask.encode(np.asfortranarray(mask.astype(bool).astype(np.uint8)))
        return cls(mask.shape[0], mask.shape[1], coded["counts"].decode("ascii"))

    @classmethod
    def from_coco(cls, segmentation: object, height: int, width: int) -> "EncodedMask":
        """Encodes COCO's `segmentation`: polygons, or run lengths with or without compression.

        Polygons that are broken are left out as long as a whole one remains.

        Raises:
            InvalidInputError: Nothing usable is in it, or its size is not that of the image.
        """
        if isinstance(segmentation, dict):
            return cls._from_runs(segmentation, height, width)
        if isinstance(segmentation, list):
            return cls._from_polygons(segmentation, height, width)
        raise InvalidInputError("a segmentation must be a list of polygons or a run-length encoding")

    @classmethod
    def _from_polygons(cls, polygons: list[object], height: int, width: int) -> "EncodedMask":
        from pycocotools import mask as coco_mask

        whole = [polygon for p in polygons if (polygon := _polygon(p)) is not None]
        if not whole:
            raise InvalidInputError(
                "a polygon must be a list of 6 or more finite numbers x1, y1, x2, y2, ...; none of the segmentation is"
            )
        # Far outside, pycocotools would walk the outline pixel by pixel.
        far = 2.0 * max(height, width)
        clipped = [np.clip(polygon, -far, far).tolist() for polygon in whole]
        coded: Any = coco_mask.merge(coco_mask.frPyObjects(clipped, height, width))
        return cls(height, width, coded["counts"].decode("ascii"))

    @classmethod
    def _from_runs(cls, segmentation: dict[str, Any], height: int, width: int) -> "EncodedMask":
        size, counts = segmentation.get("size"), segmentation.get("counts")
        if size is None or list(size) != [height, width]:
            raise InvalidInputError(
                f"a run-length encoding must have the image's size [{height}, {width}], got {size}"
            )
        if isinstance(counts, bytes):
            counts = counts.decode("ascii", errors="replace")
        if isinstance(counts, str):
            runs = _run_lengths(counts)
        elif isinstance(counts, list) and all(isinstance(c, int) for c in counts):
            runs = np.array(counts, dtype=np.int64)
        else:
            raise InvalidInputError("counts of a run-length encoding must be a string or a list of integers")
        if (runs < 0).any() or int(runs.sum()) != height * width:
            raise InvalidInputError(
                f"the runs of a mask must add up to its {height * width} pixels and none be negative"
            )
        if isinstance(counts, str):
            return cls(height, width, counts)
        from pycocotools import mask as coco_mask

        uncoded: Any = {"size": [height, width], "counts": counts}
        coded: Any = coco_mask.frPyObjects(uncoded, height, width)
        return cls(height, width, coded["counts"].decode("ascii"))

    def decode(self) -> BinaryMask:
        """The mask. Shape (height, width)."""
        # pycocotools decodes in a way that NumPy 2 has deprecated.
        runs = _run_lengths(self.counts)
        inside = np.arange(len(runs)) % 2 == 1
        return np.asarray(np.repeat(inside, runs).reshape(self.width, self.height).T)

    @property
    def area(self) -> int:
        """Number of pixels."""
        return int(_run_lengths(self.counts)[1::2].sum())

    @property
    def box_xywh(self) -> Box:
        """Left, top, width and height of the smallest box around it, in [px]; zeros for an empty mask."""
        from pycocotools import mask as coco_mask

        coded: Any = self._coded()
        x, y, w, h = coco_mask.toBbox(coded).tolist()
        return float(x), float(y), float(w), float(h)

    def to_coco(self) -> dict[str, Any]:
        """COCO's `segmentation` with compressed run lengths."""
        return {"size": [self.height, self.width], "counts": self.counts}

    def _coded(self) -> dict[str, Any]:
        return {"size": [self.height, self.width], "counts": self.counts.encode("ascii")}


def _polygon(points: object) -> list[float] | None:
    if not isinstance(points, Sequence) or isinstance(points, str) or len(points) < 6 or len(points) % 2:
        return None
    try:
        values = [float(v) for v in points]
    except (TypeError, ValueError):
        return None
    return values if np.isfinite(values).all() else None


def _run_lengths(counts: str) -> NDArray[np.int64]:
    """The runs of COCO's compressed string: 5 bits a character, and differences to two runs before.

    pycocotools reads past the end of a string that is broken, so that strings are checked here first.
    """
    digits = np.frombuffer(counts.encode("ascii", errors="replace"), dtype=np.uint8).astype(np.int64) - 48
    if not len(digits):
        return np.zeros(0, dtype=np.int64)
    if digits.min() < 0 or digits.max() > 63 or digits[-1] & 32:
        raise InvalidInputError("the compressed runs of a mask are damaged")
    ends = np.flatnonzero(digits & 32 == 0)
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > 7:
        raise InvalidInputError("the compressed runs of a mask are damaged")
    place = np.arange(len(digits)) - np.repeat(starts, lengths)
    values = np.add.reduceat((digits & 31) << (5 * place), starts)
    values -= np.where(digits[ends] & 16, np.left_shift(1, 5 * lengths), 0)
    # From the fourth on, a number is the difference to the run two before.
    for first in (1, 2):
        values[first::2] = np.cumsum(values[first::2])
    return values
