"""The ChArUco board: its layout, its corners, and their detection in a picture."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.errors import InvalidInputError

DICTIONARIES: Final = ("DICT_4X4_50", "DICT_4X4_100", "DICT_5X5_50", "DICT_5X5_100", "DICT_6X6_250")
"""Sets of markers that may be printed; the first number is the size of a marker in bits."""


@dataclass(frozen=True, kw_only=True)
class CharucoBoard:
    """A chessboard with markers in its white squares.

    Board frame: origin in the top-left corner of the print, x right, y down, z into the board.
    """

    columns: int = 8
    """Squares side by side."""
    rows: int = 6
    """Squares one above the other."""
    square_length: float = 0.030
    """Edge of a square as measured on the print, in [m]."""
    marker_length: float = 0.022
    """Edge of a marker, in [m]."""
    dictionary: str = "DICT_5X5_100"
    """Set of markers."""

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 30 and 3 <= self.rows <= 30):
            raise InvalidInputError(f"a board has 3 to 30 columns and rows, got {self.columns} x {self.rows}")
        if not 0.005 <= self.square_length <= 0.5:
            raise InvalidInputError(f"square_length must be from 0.005 to 0.5 m, got {self.square_length}")
        if not 0.4 * self.square_length <= self.marker_length <= 0.9 * self.square_length:
            raise InvalidInputError(
                f"marker_length must be from 0.4 to 0.9 of square_length = {self.square_length} m, "
                f"got {self.marker_length}"
            )
        if self.dictionary not in DICTIONARIES:
            raise InvalidInputError.choice("dictionary", self.dictionary, DICTIONARIES)
        if self.columns * self.rows // 2 > int(self.dictionary.rsplit("_", 1)[1]):
            raise InvalidInputError(
                f"{self.dictionary} has too few markers for {self.columns} x {self.rows} squares"
            )

    @cached_property
    def _board(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_length, self.marker_length, dictionary
        )

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._board)

    @property
    def corners(self) -> Float64:
        """The inner corners of the squares in the board frame, in [m]. Shape (N, 3)."""
        return np.asarray(self._board.getChessboardCorners(), dtype=np.float64)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the print, in [m]."""
        return self.columns * self.square_length, self.rows * self.square_length

    def picture(self, square_px: int = 100) -> NDArray[np.uint8]:
        """The print, without a margin.

        Args:
            square_px: Edge of a square, in [px].

        Returns:
            Grey. Shape (rows * square_px, columns * square_px).
        """
        size = (self.columns * square_px, self.rows * square_px)
        return np.asarray(self._board.generateImage(size, marginSize=0), dtype=np.uint8)

    def find(self, color: NDArray[np.uint8]) -> tuple[NDArray[np.int64], Float64]:
        """The corners of the board that a picture shows.

        Args:
            color: RGB. Shape (H, W, 3).

        Returns:
            Indices into `corners`, shape (M,), and where each is, in continuous image coordinates (0 is the edge of the
            first pixel), in [px], shape (M, 2). Both are empty without a board.
        """
        grey = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY)
        pixels, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) == 0:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        # OpenCV counts from the centre of the first pixel.
        return np.asarray(ids, np.int64).reshape(-1), np.asarray(pixels, np.float64).reshape(-1, 2) + 0.5
