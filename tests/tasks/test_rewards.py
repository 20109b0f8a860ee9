"""The rewards of the thesis and of the general task against values worked out by hand, bounds included."""

import pytest
import torch

from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.tasks.row.row_config import GeneralTaskConfig
from maniskill_tomato.tasks.thesis import thesis_rewards as rewards

OK, NEAR, OUT = int(Reach.REACHABLE), int(Reach.NEIGHBOUR), int(Reach.UNREACHABLE)


def visual(function: object, v: float, target_seen: bool, any_seen: bool, reach: int = OK) -> float:
    value = function(  # type: ignore[operator]
        torch.tensor([v]), torch.tensor([target_seen]), torch.tensor([any_seen]), torch.tensor([reach])
    )
    assert value.shape == (1,)
    return float(value[0])


def penalty(function: object, reach: int, forbidden: bool) -> float:
    return float(function(torch.tensor([reach]), torch.tensor([forbidden]))[0])  # type: ignore[operator]


@pytest.mark.parametrize(
    ("v", "expected"),
    [
        (1.0, 1.5),  # V_f + 0.5
        (0.86, 1.36),
        (0.85, 1.10),  # not above 0.85: V_f + 0.25
        (0.71, 0.96),
        (0.70, 0.70),  # not above 0.7: V_f
        (0.50, 0.50),
        (0.15, 0.15),  # not below 0.15: V_f
        (0.149, 0.099),  # V_f - 0.05
        (0.01, -0.04),
    ],
)
def test_guided_visual_reward_of_a_seen_target_follows_eq_5_3(v: float, expected: float) -> None:
    assert visual(rewards.guided_visual_reward, v, True, True) == pytest.approx(expected, abs=1e-6)


def test_guided_visual_reward_without_the_target_follows_eq_5_3() -> None:
    assert visual(rewards.guided_visual_reward, 0.0, False, False) == pytest.approx(-0.5)
    assert visual(rewards.guided_visual_reward, 0.0, False, True) == pytest.approx(-0.1)


def test_guided_visual_reward_outside_the_workspace_does_not_look() -> None:
    assert visual(rewards.guided_visual_reward, 0.9, True, True, OUT) == pytest.approx(-0.1)
    assert visual(rewards.guided_visual_reward, 0.0, False, False, OUT) == pytest.approx(-0.1)


def test_guided_visual_reward_counts_the_view_from_a_neighbour_pose() -> None:
    assert visual(rewards.guided_visual_reward, 0.9, True, True, NEAR) == pytest.approx(1.4)


@pytest.mark.parametrize(
    ("reach", "forbidden", "expected"),
    [(OK, False, 0.0), (OUT, False, -0.3), (NEAR, False, -0.1), (OK, True, -1.5), (NEAR, True, -1.6)],
)
def test_guided_pose_penalty_follows_eq_5_4(reach: int, forbidden: bool, expected: float) -> None:
    assert penalty(rewards.guided_pose_penalty, reach, forbidden) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("v", "seen", "any_seen", "expected"),
    [
        (1.0, True, True, 1.0),
        (0.81, True, True, 1.0),
        (0.8, True, True, 0.0),  # neither above 0.8 nor below it
        (0.79, True, True, 0.1),
        (0.61, True, True, 0.1),
        (0.6, True, True, 0.0),
        (0.3, True, True, 0.0),
        (0.0, False, True, 0.0),
        (0.0, False, False, -0.1),
    ],
)
def test_sparse_visual_reward_follows_eq_5_9(v: float, seen: bool, any_seen: bool, expected: float) -> None:
    # 0.8 and 0.6 in float32, as V_f is.
    assert visual(rewards.sparse_visual_reward, v, seen, any_seen) == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize(
    ("reach", "forbidden", "expected"),
    [(OK, False, 0.0), (OUT, False, -1.0), (OK, True, -1.0), (OUT, True, -2.0)],
)
def test_sparse_pose_penalty_follows_eq_5_10(reach: int, forbidden: bool, expected: float) -> None:
    assert penalty(rewards.sparse_pose_penalty, reach, forbidden) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ((0.5, 0.0, 0.14), True),  # below 0.15
        ((0.5, 0.0, 0.15), False),
        ((0.29, -0.29, 0.24), True),  # beside the base
        ((0.30, 0.0, 0.24), False),
        ((0.0, 0.30, 0.24), False),
        ((0.0, 0.0, 0.25), False),
        ((-0.29, 0.29, 0.2), True),
        ((0.71, 0.0, 0.8), True),  # too far forward
        ((0.70, 0.0, 0.8), False),
        ((0.2, -0.1, 0.9), False),
    ],
)
def test_forbidden_zone_has_the_bounds_of_eq_5_4(
    position: tuple[float, float, float], expected: bool
) -> None:
    assert bool(rewards.in_forbidden_zone(torch.tensor([position]))[0]) is expected


def test_forbidden_zones_of_a_batch_are_judged_row_by_row() -> None:
    # Beside the base and too low; too far and too low; free; too far and below the floor; behind the base, but free.
    positions = [(0.0, 0.1, 0.1), (0.8, 0.0, 0.1), (0.2, -0.1, 0.9), (0.9, 0.5, -0.3), (-0.1, 0.5, 0.5)]
    found = rewards.in_forbidden_zone(torch.tensor(positions))
    assert found.tolist() == [True, True, False, True, False]


def test_rewards_are_batched_and_keep_their_rows_apart() -> None:
    v = torch.tensor([0.9, 0.0, 0.75, 0.5])
    seen = torch.tensor([True, False, True, True])
    any_seen = torch.tensor([True, True, True, True])
    reach = torch.tensor([OK, OK, NEAR, OUT])
    torch.testing.assert_close(
        rewards.guided_visual_reward(v, seen, any_seen, reach), torch.tensor([1.4, -0.1, 1.0, -0.1])
    )
    torch.testing.assert_close(
        rewards.sparse_visual_reward(v, seen, any_seen, reach), torch.tensor([1.0, 0.0, 0.1, 0.0])
    )


def test_the_reward_of_the_general_tasks_agrees_with_values_worked_out_by_hand() -> None:
    now = torch.tensor([0.5, 0.9, 0.2, 0.7])
    before = torch.tensor([0.2, 0.7, 0.4, 0.7])
    success, contact = now > 0.8, torch.tensor([False, False, True, False])
    task = GeneralTaskConfig(step_cost=0.02, success_reward=1.0, contact_penalty=0.5)
    found = task.reward(now, before, success, contact)
    torch.testing.assert_close(found, torch.tensor([0.28, 1.18, -0.72, -0.02]))


def test_lingering_never_pays_and_a_success_always_does() -> None:
    task = GeneralTaskConfig(step_cost=0.02, success_reward=1.0, contact_penalty=0.0)

    def episode(fractions: list[float]) -> float:
        v = torch.tensor(fractions)
        no_contact = torch.zeros(len(v) - 1, dtype=torch.bool)
        return float(task.reward(v[1:], v[:-1], v[1:] > 0.8, no_contact).sum())

    finished = episode([0.1, 0.4, 0.9])
    lingering = episode([0.1, 0.4] + [0.75] * 18)
    assert finished == pytest.approx(0.8 - 0.04 + 1.0, abs=1e-6)
    assert lingering == pytest.approx(0.65 - 0.02 * 19, abs=1e-6)
    # Going back and forth brings nothing.
    assert episode([0.1, 0.7, 0.1, 0.7, 0.1]) == pytest.approx(-0.08, abs=1e-6)
