"""The twin judges an inspection list by what its plants truly are."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.mock.twin_world import TwinWorld
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.sensing.inspection import InspectedFruit
from maniskill_tomato.sensing.inspection_judge import NO_FRUIT, JudgedFruit, judge_fruits, score_lists
from maniskill_tomato.sensing.view_lattice import ViewLattice


def judge(
    world: TwinWorld, fruits: Sequence[InspectedFruit], view_joints: Sequence[Float64], threshold: float
) -> tuple[list[JudgedFruit], dict[str, Any]]:
    """Compares a list with the truth.

    Args:
        world: The twin.
        fruits: The list.
        view_joints: Where the arm was at each view, in [rad]. Each of shape (7,).
        threshold: V_f above which a fruit is fully visible.

    Returns:
        Each fruit beside the truth, and for the whole list recall of the ripe fruits in reach, precision, and the
        median error of the places, as `ListScore` has them.
    """
    plant = world.episode.plant
    T_world_plant = world.episode.T_world_plant.double().numpy()
    centres = np.array([fruit.centre for fruit in plant.fruits], dtype=np.float64)
    centres = centres @ T_world_plant[:3, :3].T + T_world_plant[:3, 3]

    def fraction(fruit: int, view: int) -> float:
        return world.visible_fractions([fruit], view_joints[view])[0]

    judged = judge_fruits(fruits, plant, centres, fraction)
    ripe = [j for j, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe"]
    reached = (
        ViewLattice(model=world.model).in_reach(torch.as_tensor(centres[ripe], dtype=torch.float32)).tolist()
    )
    in_reach = {j for j, fits in zip(ripe, reached, strict=True) if fits}
    score = score_lists([(judged, in_reach)], threshold)
    recall, precision, error = score.recall, score.precision, score.position_error_median_m
    totals = {
        "true_ripe_in_reach": score.wanted,
        "true_fully_seen": score.seen,
        "true_recall": None if recall is None else round(recall, 4),
        "true_precision": None if precision is None else round(precision, 4),
        "true_position_error_median_m": None if error is None else round(error, 5),
    }
    return judged, totals


def true_facts(fruit: JudgedFruit, plant: Plant) -> dict[str, Any]:
    """What `inspection.json` tells of the truth about a fruit: `true_fruit` (its index in `Plant.fruits`, None for no
    fruit), `true_ripeness`, `true_visible_fraction` in the view that showed most of it and `true_position_error_m`.
    """
    is_any = fruit.fruit != NO_FRUIT
    return {
        "true_fruit": fruit.fruit if is_any else None,
        "true_ripeness": plant.fruits[fruit.fruit].ripeness if is_any else None,
        "true_visible_fraction": round(fruit.true_fraction, 4),
        "true_position_error_m": fruit.position_error_m if is_any else None,
    }
