"""The twin judges an inspection list by what its plants truly are."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import torch

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.mock.twin_world import TwinWorld
from maniskill_tomato.sensing.inspection import InspectedFruit
from maniskill_tomato.sensing.view_lattice import ViewLattice

NEAREST_FRUIT: Final = 0.03
"""A listed fruit whose best view does not tell which it is counts as the nearest one, if that is nearer than this, in
[m]."""


def judge(
    world: TwinWorld, fruits: Sequence[InspectedFruit], view_joints: Sequence[Float64], threshold: float
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Compares a list with the truth.

    Args:
        world: The twin.
        fruits: The list.
        view_joints: Where the arm was at each view, in [rad]. Each of shape (7,).
        threshold: V_f above which a fruit is fully visible.

    Returns:
        For each fruit `true_fruit` (its index in `Plant.fruits`, None for no fruit), `true_ripeness`,
        `true_visible_fraction` in the view that showed most of it and `true_position_error_m`. And for the whole list:
        `true_recall`, the share of the ripe fruits in reach that are listed as ripe and fully seen and truly were;
        `true_precision`, the share of the fruits listed as ripe that are ripe and listed once; the median error of
        their places, in [m].
    """
    plant = world.episode.plant
    T_world_plant = world.episode.T_world_plant.double().numpy()
    centres = np.array([fruit.centre for fruit in plant.fruits], dtype=np.float64)
    centres = centres @ T_world_plant[:3, :3].T + T_world_plant[:3, 3]
    entries = [_judged(world, fruit, view_joints, centres) for fruit in fruits]
    ripe = [j for j, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe"]
    reached = ViewLattice().in_reach(torch.as_tensor(centres[ripe], dtype=torch.float32)).tolist()
    in_reach = {j for j, fits in zip(ripe, reached, strict=True) if fits}
    seen: set[int] = set()
    right: dict[int, float] = {}
    for fruit, entry in zip(fruits, entries, strict=True):
        number = entry["true_fruit"]
        if not fruit.is_ripe or number is None or entry["true_ripeness"] != "ripe":
            continue
        right.setdefault(number, entry["true_position_error_m"])
        if fruit.is_fully_seen and entry["true_visible_fraction"] > threshold:
            seen.add(number)
    wanted, listed = in_reach | seen, sum(fruit.is_ripe for fruit in fruits)
    totals = {
        "true_ripe_in_reach": len(wanted),
        "true_fully_seen": len(seen),
        "true_recall": round(len(seen) / len(wanted), 4) if wanted else None,
        "true_precision": round(len(right) / listed, 4) if listed else None,
        "true_position_error_median_m": round(float(np.median(list(right.values()))), 5) if right else None,
    }
    return entries, totals


def _judged(
    world: TwinWorld, fruit: InspectedFruit, view_joints: Sequence[Float64], centres: Float64
) -> dict[str, Any]:
    best = fruit.best
    number = None if best is None else best.shown_fruit
    away = np.linalg.norm(centres - fruit.position_w, axis=1)
    if number is None and away.min() < NEAREST_FRUIT:
        number = int(away.argmin())
    fraction = 0.0
    if number is not None and best is not None:
        fraction = world.visible_fractions([number], view_joints[best.view])[0]
    return {
        "true_fruit": number,
        "true_ripeness": None if number is None else world.episode.plant.fruits[number].ripeness,
        "true_visible_fraction": round(fraction, 4),
        "true_position_error_m": None if number is None else round(float(away[number]), 5),
    }
