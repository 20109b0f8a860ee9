"""A picture of a calibration: the corners' residuals by view, and the board's pose from each view alone."""

import io
from pathlib import Path
from typing import Any, Final, Literal

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from maniskill_tomato.deploy.calibration.board import CharucoBoard
from maniskill_tomato.deploy.calibration.hand_eye import Agreement, HandEyeResult, rms
from maniskill_tomato.deploy.rigid import difference
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.robot.d435 import CameraIntrinsics, T_flange_camera_color_optical

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


ARROW_LENGTH = 12.0
"""So long is the arrow of a residual of the root mean square, in [px]."""


def draw_calibration(path: Path, result: Agreement, intrinsics: CameraIntrinsics) -> None:
    """Writes the picture as PNG.

    Args:
        path: The file.
        result: What is drawn.
        intrinsics: Of the colour pictures.

    Raises:
        CheckpointError: It cannot be written.
    """
    figure = Figure(figsize=(14, 8.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid: Any = figure.add_gridspec(2, 3, height_ratios=(1.5, 1.0))
    colors = matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, len(result.views)))
    _arrows(figure.add_subplot(grid[0, :2]), result, intrinsics, colors)
    _cloud(figure.add_subplot(grid[0, 2]), result, colors)
    _bars(figure.add_subplot(grid[1, 0]), result, colors)
    _boards(figure.add_subplot(grid[1, 1]), result, colors)
    _words(figure.add_subplot(grid[1, 2]), result)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=90)
    write_atomically(path, content.getvalue())


def _arrows(axes: Any, result: Agreement, intrinsics: CameraIntrinsics, colors: Any) -> None:
    # A round number, so that the title tells it.
    wanted = ARROW_LENGTH / max(result.rms_px, 1e-6)
    times = min((1, 2, 5, 10, 20, 50, 100, 200, 500, 1000), key=lambda t: abs(np.log(t / wanted)))
    for view, residuals, color in zip(result.views, result.residuals_px, colors, strict=True):
        u, v = view.corners_px.T
        axes.quiver(
            u,
            v,
            residuals[:, 0],
            residuals[:, 1],
            color=color,
            angles="xy",
            scale_units="xy",
            scale=1.0 / times,
            width=0.002,
        )
    axes.set(
        xlim=(0, intrinsics.width),
        ylim=(intrinsics.height, 0),
        aspect="equal",
        xlabel="column (px)",
        ylabel="row (px)",
        title=f"Seen less predicted corners, {times} times as long; one colour a view",
    )


def _cloud(axes: Any, result: Agreement, colors: Any) -> None:
    for residuals, color in zip(result.residuals_px, colors, strict=True):
        axes.plot(*residuals.T, ".", color=color, markersize=3)
    reach = 1.1 * max(float(np.abs(np.concatenate(result.residuals_px)).max()), 0.05)
    axes.axhline(0, color="0.8", zorder=0)
    axes.axvline(0, color="0.8", zorder=0)
    axes.set(
        xlim=(-reach, reach),
        ylim=(reach, -reach),
        aspect="equal",
        xlabel="column (px)",
        ylabel="row (px)",
        title="Residuals of all corners",
    )


def _bars(axes: Any, result: Agreement, colors: Any) -> None:
    errors = [rms(r) for r in result.residuals_px]
    axes.bar(np.arange(len(errors)), errors, color=colors)
    axes.axhline(result.rms_px, color="black", linewidth=0.8, linestyle="--")
    axes.set(xlabel="view", ylabel="RMS (px)", title="Each view; dashed: all")


def _boards(axes: Any, result: Agreement, colors: Any) -> None:
    offsets = 1000.0 * result.board_offsets
    numbers = np.arange(len(offsets))
    for k, (name, marker) in enumerate(zip("xyz", "osD", strict=True)):
        axes.plot(numbers, offsets[:, k], marker, label=f"{name} (mm)", markersize=4)
    axes.plot(numbers, 10.0 * np.degrees(result.board_turns), "k+", label="turn (0.1 degrees)")
    axes.axhline(0, color="0.8", zorder=0)
    axes.legend(ncols=4, fontsize=7, loc="upper center")
    axes.margins(y=0.35)
    axes.set(xlabel="view", title="The board by each view alone, less that by all")


def _words(axes: Any, result: Agreement) -> None:
    distance, angle = difference(T_flange_camera_color_optical, result.T_flange_camera)
    x, y, z = 1000.0 * result.T_flange_camera[:3, 3]
    lines = [
        f"{len(result.views)} views, {sum(len(r) for r in result.residuals_px)} corners, RMS {result.rms_px:.3f} px",
        "",
        "camera in link_ee (optical frame)",
        f"  x {x:.2f}   y {y:.2f}   z {z:.2f} mm",
        *(
            [
                f"  standard deviation {1000 * result.position_std:.3f} mm, {np.degrees(result.rotation_std):.4f} deg"
            ]
            if isinstance(result, HandEyeResult)
            else ["  given, not fitted"]
        ),
        f"  from the drawing {1000 * distance:.1f} mm, {np.degrees(angle):.2f} deg",
        "",
        f"the board by one view: {1000 * result.board_position_rms:.2f} mm, "
        f"{np.degrees(result.board_turn_rms):.2f} deg (RMS)",
        f"left out: {len(result.left_out)}",
        *(f"  {text}" for text in result.left_out[:5]),
    ]
    axes.axis("off")
    axes.text(0.0, 0.98, "\n".join(lines), va="top", family="monospace", fontsize=9)
