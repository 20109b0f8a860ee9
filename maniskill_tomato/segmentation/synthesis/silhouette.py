"""The whole silhouette of a mesh in an image, whatever stands in front of it: the amodal mask, exactly."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.robot.d435 import CAMERA_NEAR, CameraIntrinsics
from maniskill_tomato.segmentation.masks import BinaryMask

Float64 = NDArray[np.float64]

SUBPIXELS: Final = 4
"""Fine pixels along a side of a pixel; the silhouette's edge is right to about an eighth of a pixel."""

MAX_SIDE: Final = 3000
"""Largest side of the fine picture of a silhouette, in [px]; a nearer thing gets fewer fine pixels."""


class Silhouette:
    """The pixels that a thing would cover with nothing in front, in the image and outside."""

    def __init__(self, mask: BinaryMask, left: int, top: int) -> None:
        """Keeps a window of the (endless) image plane.

        Args:
            mask: The window. Shape (h, w).
            left: Column of the image where it begins; may be negative.
            top: Row where it begins.
        """
        self._mask = mask
        self._left = left
        self._top = top

    @property
    def total(self) -> int:
        """T: number of pixels, also those outside the image."""
        return int(np.count_nonzero(self._mask))

    @property
    def box_xywh(self) -> tuple[float, float, float, float]:
        """The smallest box around it, in [px]; it may leave the image."""
        rows, columns = np.flatnonzero(self._mask.any(1)), np.flatnonzero(self._mask.any(0))
        if not len(rows):
            return 0.0, 0.0, 0.0, 0.0
        x, y = self._left + columns[0], self._top + rows[0]
        return float(x), float(y), float(columns[-1] - columns[0] + 1), float(rows[-1] - rows[0] + 1)

    def in_image(self, width: int, height: int) -> BinaryMask:
        """The part inside an image. Shape (height, width)."""
        image = np.zeros((height, width), dtype=bool)
        h, w = self._mask.shape
        x0, y0 = max(self._left, 0), max(self._top, 0)
        x1, y1 = min(self._left + w, width), min(self._top + h, height)
        if x1 > x0 and y1 > y0:
            rows = slice(y0 - self._top, y1 - self._top)
            image[y0:y1, x0:x1] = self._mask[rows, x0 - self._left : x1 - self._left]
        return image


def draw_silhouette(
    vertices_optical: Float64, faces: NDArray[np.integer], intrinsics: CameraIntrinsics
) -> Silhouette | None:
    """Fills every triangle of a closed mesh that faces the camera.

    Args:
        vertices_optical: In the optical frame, in [m]. Shape (V, 3).
        faces: Counter-clockwise from outside. Shape (F, 3).
        intrinsics: The camera.

    Returns:
        The silhouette; None if a vertex is nearer than the near plane or behind the camera.
    """
    if vertices_optical[:, 2].min() <= CAMERA_NEAR:
        return None
    uv = intrinsics.project(vertices_optical)
    low, high = np.floor(uv.min(0)).astype(int) - 1, np.ceil(uv.max(0)).astype(int) + 1
    width, height = (int(v) for v in high - low)
    fine = max(1, min(SUBPIXELS, MAX_SIDE // max(width, height)))
    corners = uv[faces]
    edge_a, edge_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # Rows count downward, so that counter-clockwise triangles have a negative area here.
    facing = edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0] < 0
    canvas = np.zeros((height * fine, width * fine), dtype=np.uint8)
    # OpenCV's coordinates are those of pixel centres, here with 4 fractional bits.
    points = np.round(((corners[facing] - low) * fine - 0.5) * 16).astype(np.int32)
    for triangle in points:
        cv2.fillConvexPoly(canvas, triangle, 255, cv2.LINE_8, 4)
    if fine == 1:
        mask = canvas > 0
    else:
        # OpenCV fills the pixels that the outline touches: half a fine pixel too many, by which the half is raised.
        share = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
        mask = share > 255 * (0.5 + 0.5 / fine)
    return Silhouette(np.asarray(mask), int(low[0]), int(low[1]))
