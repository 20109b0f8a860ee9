"""The board as a page that prints at its true size."""

import io
from pathlib import Path
from typing import Final, Literal

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from maniskill_tomato.deploy.calibration.board import CharucoBoard
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically

MARGIN: Final = 0.02
"""White around the board, in [m]."""

METRES_PER_INCH: Final = 0.0254

PNG_DPI: Final = 254
"""Ten pixels a millimetre."""


def print_board(path: Path, board: CharucoBoard) -> None:
    """Writes the page; print it at 100 % and measure a square before use.

    Args:
        path: A .pdf file, or a .png file of 254 dots an inch.
        board: Which.

    Raises:
        InvalidInputError: The file has another ending.
        CheckpointError: It cannot be written.
    """
    kinds: dict[str, Literal["pdf", "png"]] = {".pdf": "pdf", ".png": "png"}
    kind = kinds.get(path.suffix)
    if kind is None:
        raise InvalidInputError(f"the board is written as .pdf or .png, got {path.name!r}")
    width, height = (side + 2.0 * MARGIN for side in board.size)
    figure = Figure(figsize=(width / METRES_PER_INCH, height / METRES_PER_INCH))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((MARGIN / width, MARGIN / height, board.size[0] / width, board.size[1] / height))
    axes.imshow(board.picture(), cmap="gray", vmin=0, vmax=255, interpolation="none", aspect="auto")
    axes.axis("off")
    note = (
        f"{board.columns} x {board.rows} squares of {1000 * board.square_length:g} mm, markers "
        f"{1000 * board.marker_length:g} mm, {board.dictionary}"
    )
    figure.text(0.5, 0.4 * MARGIN / height, note, ha="center", va="center", fontsize=7)
    content = io.BytesIO()
    figure.savefig(content, format=kind, dpi=PNG_DPI)
    write_atomically(path, content.getvalue())
