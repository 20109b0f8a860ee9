"""Pictures and page of an inspection: a cut-out a fruit, all of them under a front view of the row, `report.html`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.policy_run import MARK, wrap_text, write_text
from maniskill_tomato.report_design import (
    GRID,
    INK,
    LEAF,
    MUTED,
    SKY,
    TOMATO,
    figure,
    many_small,
    number,
    page,
    paragraph,
    percent,
    photo,
    rgb,
    section,
    table,
    tile,
    tiles,
)
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.sensing.inspection import InspectedFruit

SIDE: Final = 240
"""Edge of a fruit's picture, in [px]."""
BAR: Final = 40
"""Height of the caption below it, in [px]."""
COLUMNS: Final = 6
"""Of the pictures in `report.png`."""
SCALE: Final = 820.0
"""Of the front view, in [px/m]."""
LEFT, TOP = 0.9, 0.95
"""Its upper left corner: y and z in the base frame, in [m]."""
FRONT_SIZE: Final = (1486, 680)
"""Width and height, in [px]."""

Picture = NDArray[np.uint8]


def fruit_picture(fruit: InspectedFruit) -> Picture | None:
    """The cut-out of the view that showed most of a fruit, its outline and a caption; None without one."""
    best = fruit.best
    if best is None or best.picture is None:
        return None
    height, width = best.mask.shape
    scale = SIDE / max(height, width)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    large: Any = cv2.resize(best.picture, size, interpolation=cv2.INTER_CUBIC)
    mask: Any = cv2.resize(best.mask.astype(np.uint8), size, interpolation=cv2.INTER_LINEAR)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(large, outlines, -1, MARK, 2)
    picture = np.full((SIDE + BAR, SIDE, 3), 255, dtype=np.uint8)
    picture[: size[1], : size[0]] = large
    seen = "fully seen" if fruit.is_fully_seen else "not fully seen"
    write_text(picture, f"{fruit.number}: {_ripeness(fruit)}, {seen}", (4, SIDE + 15), 0.42)
    told = f"V_f {fruit.visible_fraction:.2f} +- {fruit.fraction_error:.2f}, r {1e3 * fruit.radius_m:.0f} mm"
    write_text(picture, told, (4, SIDE + 32), 0.42)
    return picture


def overview(
    title: str, fruits: Sequence[InspectedFruit], cameras: Sequence[Float64], pictures: Sequence[Picture]
) -> Picture:
    """The row as the robot stands before it, and the fruits' pictures below.

    Args:
        title: Above it.
        fruits: The list.
        cameras: Where the camera was at each look, base frame, in [m]. Each of shape (3,).
        pictures: Of the fruits.
    """
    front = front_view(fruits, cameras)
    rows = math.ceil(len(pictures) / COLUMNS)
    width = max(FRONT_SIZE[0], COLUMNS * (SIDE + 8) + 8)
    head = wrap_text(title, width - 20, 0.55)
    bar = 18 + 22 * len(head)
    sheet = np.full((bar + FRONT_SIZE[1] + 8 + rows * (SIDE + BAR + 8), width, 3), 255, dtype=np.uint8)
    for k, line in enumerate(head):
        write_text(sheet, line, (10, 24 + 22 * k), 0.55)
    sheet[bar : bar + front.shape[0], : front.shape[1]] = front
    for k, picture in enumerate(pictures):
        top = bar + FRONT_SIZE[1] + 8 + (k // COLUMNS) * (SIDE + BAR + 8)
        left = 8 + (k % COLUMNS) * (SIDE + 8)
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


def write_page(path: Path, facts: dict[str, Any], fruits: Sequence[dict[str, Any]], front: bytes) -> bytes:
    """The content of `report.html`.

    Args:
        path: Where it will be; the fruits' pictures lie beside it.
        facts: Of the run, as in `inspection.json`.
        fruits: Its list.
        front: PNG file of `front_view`.
    """
    ripe = [fruit for fruit in fruits if fruit["ripeness"] == "ripe"]
    full = sum(fruit["fully_seen"] for fruit in ripe)
    cells = [
        tile(
            f"{full} fruits",
            "ripe and fully seen",
            f"n = {len(fruits)} fruits listed, {len(ripe)} of them ripe",
        ),
        tile(f"{facts['moves']} moves", "for the row", f"{facts['refused_moves']} refused"),
        tile(f"{facts['device_seconds']:.0f} s", "by the run's clock", str(facts["reason"])),
    ]
    if facts.get("true_recall") is not None:
        seen, wanted = facts["true_fully_seen"], facts["true_ripe_in_reach"]
        note = f"{seen} of {wanted} ripe fruits in reach truly fully seen"
        precision = facts["true_precision"]
        told = "no ripe fruit listed" if precision is None else f"precision {percent(precision)}"
        cells.append(tile(percent(facts["true_recall"]), "recall by the twin's truth", note, told))
    head = ["Fruit", "Ripeness", "V_f", "Fully seen", "x", "y", "z [m]", "+- [mm]", "Radius [mm]", "Views"]
    has_truth = any("true_visible_fraction" in fruit for fruit in fruits)
    rows = [_row(fruit, has_truth) for fruit in fruits]
    shown = [
        figure(
            path.parent / fruit["picture"],
            f"Fruit {fruit['number']}, {fruit['ripeness']}: V_f {fruit['visible_fraction']:.2f} (0 to 1), "
            f"{fruit['views']} views",
        )
        for fruit in fruits
        if fruit["picture"] is not None
    ]
    outcome = f"{facts['reason']}: {facts['detail']}. {facts['end_state'].capitalize()}."
    keys = ("profile", "policy_name", "perception", "seed", "mode", "simulated", "version")
    return page(
        "Inspection of a row",
        f"{facts['profile']}, seed {facts['seed']}, {facts['policy_name']}",
        [
            tiles(*cells),
            section(
                "The row",
                paragraph(outcome),
                photo(
                    front,
                    f"The row seen from the robot, in metres, n = {len(fruits)} fruits; thick ring: fully seen, "
                    "line: the camera's way",
                    least_px=760,
                ),
            ),
            section(
                f"Fruits, n = {len(fruits)}",
                table([*head, *(["True V_f", "Off [mm]"] if has_truth else [])], rows),
            ),
            section(f"Pictures, n = {len(shown)} fruits", many_small(*shown)) if shown else "",
        ],
        {**{key.replace("_", " "): str(facts[key]) for key in keys}, **run_facts()},
    ).encode()


def _row(fruit: dict[str, Any], has_truth: bool) -> list[str]:
    position = [f"{value:.3f}" for value in fruit["position_m"]]
    row = [
        str(fruit["number"]),
        fruit["ripeness"],
        f"{fruit['visible_fraction']:.2f} +- {fruit['fraction_error']:.2f}",
        "yes" if fruit["fully_seen"] else "no",
        *position,
        f"{1e3 * fruit['position_error_m']:.1f}",
        f"{1e3 * fruit['radius_m']:.1f}",
        str(fruit["views"]),
    ]
    if has_truth:
        off = fruit["true_position_error_m"]
        row += [f"{fruit['true_visible_fraction']:.2f}", number(None if off is None else 1e3 * off, 1)]
    return row


def front_view(fruits: Sequence[InspectedFruit], cameras: Sequence[Float64]) -> Picture:
    """y to the left and z upwards, as the robot sees them."""
    picture = np.full((FRONT_SIZE[1], FRONT_SIZE[0], 3), 255, dtype=np.uint8)

    def place(point: Float64) -> tuple[int, int]:
        return round(float(LEFT - point[1]) * SCALE), round(float(TOP - point[2]) * SCALE)

    for k in range(-8, 9, 2):
        column, _ = place(np.array([0.0, k / 10, TOP]))
        cv2.line(picture, (column, 0), (column, FRONT_SIZE[1]), rgb(GRID), 1)
        write_text(picture, f"y {k / 10:.1f} m", (column + 3, FRONT_SIZE[1] - 8), 0.65)
    for k in range(2, 10, 2):
        _, row = place(np.array([0.0, 0.0, k / 10]))
        cv2.line(picture, (0, row), (FRONT_SIZE[0], row), rgb(GRID), 1)
        write_text(picture, f"z {k / 10:.1f} m", (4, row - 6), 0.65)
    way = [place(camera) for camera in cameras]
    for start, end in zip(way[:-1], way[1:], strict=True):
        cv2.line(picture, start, end, rgb(SKY), 1, cv2.LINE_AA)
    for point in way:
        cv2.circle(picture, point, 2, rgb(SKY), -1, cv2.LINE_AA)
    for fruit in fruits:
        centre, radius = place(fruit.position_w), round(fruit.radius_m * SCALE)
        cv2.circle(picture, centre, radius, rgb(TOMATO if fruit.is_ripe else LEAF), -1, cv2.LINE_AA)
        cv2.circle(
            picture,
            centre,
            radius + 3,
            rgb(INK if fruit.is_fully_seen else MUTED),
            2 if fruit.is_fully_seen else 1,
        )
        write_text(picture, str(fruit.number), (centre[0] - 8 * len(str(fruit.number)), centre[1] + 7), 0.65)
    return picture


def _ripeness(fruit: InspectedFruit) -> str:
    return "ripe" if fruit.is_ripe else "unripe"
