"""Rows that a robot inspects with a camera, judged by the truth."""

from typing import Any

import numpy as np
import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.camera_metrics import summarise_inspections
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.experiments.row_benchmark import seeable_in_row
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.opening import open_policy, shipped_policy
from maniskill_tomato.tasks.making import make_world

ROW = "TomatoViewpointRow-v1"
PLANT = {"seed": "validation", "pool": None}


def test_a_robot_with_perfect_masks_finds_and_sees_nearly_all_of_a_row_and_lists_no_fruit_twice() -> None:
    policy = open_policy(shipped_policy("TomatoViewpoint-v1"), env_id=ROW)
    env = make_env(ROW, perception="occlusion_model", plant=PLANT)
    record = run_episode(env, policy, 3)
    assert record.success and record.row is not None and record.row.listed is not None
    listed = record.row.listed
    numbers = [entry["fruit"] for entry in listed if entry["fruit"] >= 0]
    assert len(set(numbers)) == len(numbers)
    # An independent judge: the fruits of the plant where the list says that they are.
    world: Any = env.unwrapped
    plant = world.plant_batch.plants[0]
    centres = world.plant_batch.fruit_positions_w(0, list(range(len(plant.fruits)))).numpy()
    for told, entry in zip(world.inspecting.listed(0), listed, strict=True):
        away = np.linalg.norm(centres - told.position_w, axis=1)
        if entry["is_fully_seen"]:
            assert int(away.argmin()) == entry["fruit"] and away.min() == pytest.approx(
                entry["position_error_m"], abs=1e-4
            )
    figures = summarise_inspections([record], {3: set(seeable_in_row(make_env(ROW, plant=PLANT), 3))}, 0.8)
    assert figures["recall"] >= 0.9 and figures["precision"] >= 0.9 and figures["full_precision"] >= 0.95
    assert figures["position_error_median_m"] < 0.003
    assert record.row.moves == figures["mean_moves"] <= 120


def test_each_of_several_rows_is_inspected_as_it_would_be_alone() -> None:
    options: dict[str, Any] = {"perception": "occlusion_model", "plant": {"seed": "validation"}}
    both, alone = make_world(ROW, 2, **options), [make_world(ROW, **options) for _ in range(2)]
    both.reset([5, 6])
    for i, world in enumerate(alone):
        world.reset(5 + i)
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        move = 2.0 * torch.rand(2, 3, generator=generator) - 1.0
        both.step(move)
        for i, world in enumerate(alone):
            world.step(move[i : i + 1])
            assert len(both.inspecting.listed(i)) == len(world.inspecting.listed(0))
            torch.testing.assert_close(
                both.belief.target_position[i], world.belief.target_position[0], atol=1e-3, rtol=0
            )
    for i, world in enumerate(alone):
        places = [fruit.position_w for fruit in both.inspecting.listed(i)]
        np.testing.assert_allclose(
            places, [fruit.position_w for fruit in world.inspecting.listed(0)], atol=1e-3
        )


def test_an_inspected_row_cannot_be_taken_up_from_a_state_and_says_so() -> None:
    world = make_world(ROW, perception="occlusion_model", plant=PLANT)
    world.reset(1)
    saved = world.save()
    with pytest.raises(InvalidInputError, match="reset it with its seed"):
        world.restore(saved)


def test_a_row_that_the_truth_leads_has_no_inspection_list() -> None:
    world = make_world(ROW, plant=PLANT)
    with pytest.raises(AttributeError):
        _ = world.inspecting
