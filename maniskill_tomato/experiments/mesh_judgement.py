"""What plants from mesh files are, and what a budget of triangles changes in V_f of their fruits."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.files import write_atomically
from maniskill_tomato.plants.mesh_plant import plant_from_mesh
from maniskill_tomato.plants.mesh_set import MeshSource
from maniskill_tomato.plants.organs import Plant, SemanticClass
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.report_design import markdown_table, paragraph, report, section, table, tile, tiles
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.tasks.row.row_config import GeneralTaskConfig

AZIMUTHS_DEG: Final = (-60.0, -45.0, -30.0, 0.0, 30.0, 45.0, 60.0)
"""Of the views, seen from the fruit; 0 is the robot's side (-x)."""

ELEVATIONS_DEG: Final = (-30.0, -15.0, 0.0, 20.0)
"""Of the views, seen from the fruit."""

DISTANCE: Final = 0.35
"""Of the views from the fruit's centre, in [m]."""

FULL: Final = GeneralTaskConfig().full_visibility
"""V_f above which the tasks call a fruit fully visible."""

COLUMNS: Final = (
    "V_f is the share of a fruit's outline in the image that nothing hides, from 0 to 1. Its change is "
    "that from the file's own triangles to those that are kept. Views across "
    f"{FULL}: those in which this change decides whether the fruit counts as fully visible. Many of them say that the "
    "budget is too small."
)

UNCHANGED: Final = (
    "All triangles are kept: no plant has more than the budget, or there is none. "
    "--triangles judges another one."
)


@dataclass(frozen=True, kw_only=True)
class MeshRow:
    """One plant."""

    plant: str
    """Its file's name without the ending."""
    split: str
    leaves: int
    """Leaf organs."""
    fruits: int
    ripe: int
    """Ripe fruits."""
    triangles: int
    """Of the file."""
    kept: int
    """Within the budget."""
    views: int
    """Views of ripe fruits that were compared; none where all triangles are kept."""
    mean_change: float
    """Mean absolute change of V_f over the views."""
    largest_change: float
    crossed: int
    """Views in which the budget decides whether V_f is above `FULL`."""


def judge_meshes(
    source: MeshSource,
    split: str,
    triangles: int | None,
    out: Path,
    on_plant: Callable[[int], object] | None = None,
) -> str:
    """Reads plants, casts rays at their ripe fruits with all and with the budget's triangles, and writes both.

    Args:
        source: File or folder, with its rules.
        split: Whose plants, or `all`.
        triangles: The budget; None takes that of the rules.
        out: Folder of report.html and plants.json.
        on_plant: Called with 1 after each plant.

    Returns:
        The table as Markdown.

    Raises:
        InvalidInputError: There are no such plants, or one is refused.
    """
    found = source.plants
    rules = found.rules if triangles is None else replace(found.rules, triangles=triangles)
    rows = []
    for seed in found.seeds(split):
        path = found.files[seed]
        whole = plant_from_mesh(path, replace(rules, triangles=None), seed)
        fewer = whole if rules.triangles is None else plant_from_mesh(path, rules, seed)
        rows.append(_row(whole, fewer, found.split_of(seed)))
        if on_plant is not None:
            on_plant(1)
    head, cells, told = _table(rows, rules.triangles)
    write_atomically(out / "plants.json", json.dumps([asdict(row) for row in rows], indent=1).encode())
    _write_report(rows, rules.triangles, split, out)
    text = markdown_table(head, cells) + "\n"
    return f"{told}\n\n{text}" if told else text


def _write_report(rows: list[MeshRow], budget: int | None, split: str, out: Path) -> None:
    """Writes report.html, the plants that change most first."""
    worst_first = sorted(rows, key=lambda row: (-row.crossed, -row.largest_change))
    head, cells, told = _table(worst_first, budget)
    plants = f"n = {len(rows)} plant{'' if len(rows) == 1 else 's'}"
    views, crossed = sum(row.views for row in rows), sum(row.crossed for row in rows)
    judged = f"n = {views} views of ripe fruits, {plants}"
    sums = [
        tile(f"{sum(row.ripe for row in rows)} ripe", f"of {sum(row.fruits for row in rows)} fruits", plants),
        tile(f"{sum(row.triangles for row in rows) / len(rows):,.0f} triangles", "of a file, mean", plants),
    ]
    if views:
        largest = max(row.largest_change for row in rows)
        sums += [
            tile(f"{largest:.3f}", "largest change of V_f by the budget (0 to 1)", judged),
            tile(f"{crossed} views", f"in which the budget decides whether V_f is above {FULL}", judged),
        ]
    report(
        out,
        "Plants from mesh files",
        f"{len(rows)} plants, split {split}",
        [
            tiles(*sums),
            section(
                f"Plants, {plants}" + (", largest change first" if views else ""),
                table(head, cells),
                paragraph(f"{told} {COLUMNS}" if told else UNCHANGED, "caption"),
            ),
        ],
        run_facts(),
    )


def fixed_views(centre: NDArray[np.floating[Any]]) -> torch.Tensor:
    """Poses of the optical frame about a fruit, for all azimuths and elevations. Shape (28, 4, 4).

    Args:
        centre: Of the fruit, in the plant frame, in [m]. Shape (3,).
    """
    places = [
        [-math.cos(e) * math.cos(a), -math.cos(e) * math.sin(a), math.sin(e)]
        for a in map(math.radians, AZIMUTHS_DEG)
        for e in map(math.radians, ELEVATIONS_DEG)
    ]
    target = torch.as_tensor(np.asarray(centre, dtype=np.float32))
    return look_at_pose(target + DISTANCE * torch.tensor(places), target.expand(len(places), 3))


def _row(whole: Plant, fewer: Plant, split: str) -> MeshRow:
    changes, crossed = np.zeros(0), 0
    ripe = [k for k, fruit in enumerate(whole.fruits) if fruit.ripeness == "ripe"]
    if len(fewer.faces) < len(whole.faces):
        scene, place = RayScene([whole, fewer], color_intrinsics()), torch.eye(4)
        before, after = (
            np.concatenate(
                [
                    scene.visible_fraction_from(
                        fixed_views(whole.fruits[k].centre), k, place, env_idx=env
                    ).numpy()
                    for k in ripe
                ]
            )
            for env in (0, 1)
        )
        changes, crossed = np.abs(after - before), int(((after > FULL) != (before > FULL)).sum())
    return MeshRow(
        plant=whole.preset,
        split=split,
        leaves=sum(organ.semantic_class == SemanticClass.LEAF for organ in whole.organs),
        fruits=len(whole.fruits),
        ripe=len(ripe),
        triangles=len(whole.faces),
        kept=len(fewer.faces),
        views=len(changes),
        mean_change=float(changes.mean()) if len(changes) else 0.0,
        largest_change=float(changes.max()) if len(changes) else 0.0,
        crossed=crossed,
    )


def _table(rows: list[MeshRow], budget: int | None) -> tuple[list[str], list[list[str]], str]:
    """Head and lines of the table, and what its figures are; no words where no budget is judged."""
    head = ["plant", "split", "leaves", "fruits (ripe)", "triangles"]
    cells = [[r.plant, r.split, str(r.leaves), f"{r.fruits} ({r.ripe})", f"{r.triangles:,}"] for r in rows]
    if budget is None:
        return head, cells, ""
    head += ["kept", "change of V_f: mean", "largest", f"views across {FULL}"]
    views = sum(row.views for row in rows)
    for row, line in zip(rows, cells, strict=True):
        line += [f"{row.kept:,}", f"{row.mean_change:.4f}", f"{row.largest_change:.3f}"]
        line += [f"{row.crossed} of {row.views}"]
    mean = sum(row.mean_change * row.views for row in rows) / max(views, 1)
    cells.append(
        ["all", "", str(sum(r.leaves for r in rows))]
        + [f"{sum(r.fruits for r in rows)} ({sum(r.ripe for r in rows)})"]
        + [f"{sum(r.triangles for r in rows):,}", f"{sum(r.kept for r in rows):,}", f"{mean:.4f}"]
        + [f"{max((r.largest_change for r in rows), default=0.0):.3f}"]
        + [f"{sum(r.crossed for r in rows)} of {views}"]
    )
    count = len(AZIMUTHS_DEG) * len(ELEVATIONS_DEG)
    told = (
        f"At most {budget:,} triangles a plant. V_f of ripe fruits from {count} views each, {DISTANCE} m away: "
        f"azimuths of {AZIMUTHS_DEG[0]:.0f} to {AZIMUTHS_DEG[-1]:.0f} degrees from the robot's side, elevations of "
        f"{ELEVATIONS_DEG[0]:.0f} to {ELEVATIONS_DEG[-1]:.0f}."
    )
    return head, cells, told
