"""The twin judges an inspection list by what its plants truly are."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.mock.twin_world import TwinWorld
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.sensing.inspection import InspectedFruit
from maniskill_tomato.sensing.inspection_judge import NO_FRUIT, JudgedFruit, judge_fruits
from maniskill_tomato.sensing.view_lattice import ViewLattice


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

    def fraction(fruit: int, view: int) -> float:
        return world.visible_fractions([fruit], view_joints[view])[0]

    judged = judge_fruits(fruits, plant, centres, fraction)
    ripe = [j for j, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe"]
    reached = ViewLattice().in_reach(torch.as_tensor(centres[ripe], dtype=torch.float32)).tolist()
    in_reach = {j for j, fits in zip(ripe, reached, strict=True) if fits}
    seen: set[int] = set()
    right: dict[int, float] = {}
    for fruit in judged:
        if fruit.is_ripe and fruit.is_truly_ripe:
            right.setdefault(fruit.fruit, fruit.position_error_m)
            if fruit.is_fully_seen and fruit.true_fraction > threshold:
                seen.add(fruit.fruit)
    wanted, listed = in_reach | seen, sum(fruit.is_ripe for fruit in fruits)
    totals = {
        "true_ripe_in_reach": len(wanted),
        "true_fully_seen": len(seen),
        "true_recall": round(len(seen) / len(wanted), 4) if wanted else None,
        "true_precision": round(len(right) / listed, 4) if listed else None,
        "true_position_error_median_m": round(float(np.median(list(right.values()))), 5) if right else None,
    }
    return [_entry(fruit, plant) for fruit in judged], totals


def _entry(fruit: JudgedFruit, plant: Plant) -> dict[str, Any]:
    is_any = fruit.fruit != NO_FRUIT
    return {
        "true_fruit": fruit.fruit if is_any else None,
        "true_ripeness": plant.fruits[fruit.fruit].ripeness if is_any else None,
        "true_visible_fraction": round(fruit.true_fraction, 4),
        "true_position_error_m": fruit.position_error_m if is_any else None,
    }
