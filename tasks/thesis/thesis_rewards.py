"""Rewards, penalties and zones of the thesis (Eq. 5-3, 5-4, 5-9, 5-10) as pure functions of tensors.

Every function takes and returns batches of shape (B,). `reach` holds `Reach` values: 0 the asked pose was
reached, 1 a neighbour pose was taken instead, 2 the asked pose is outside the workspace.

Numbers stand in small constant tensors, because a comparison or selection with a Python number costs torch twice
as much as one with a tensor, and these functions run at every step of a simulation that takes 0.3 ms.
"""

import math
from functools import cache

import torch
from torch import Tensor

from maniskill_tomato.robot.inverse_kinematics import Reach

UNREACHABLE = int(Reach.UNREACHABLE)


@cache
def _constant(values: float | tuple[float, ...], device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=torch.float32, device=device)


def in_forbidden_zone(ee_position_w: Tensor) -> Tensor:
    """Whether the end-effector is where it must not be (third case of Eq. 5-4, second of Eq. 5-10).

    The zone is z < 0.15 m, or a box around the base (|x| < 0.3 m, |y| < 0.3 m, z < 0.25 m), or x > 0.7 m. All
    bounds are
    strict: a pose exactly on one is outside the zone.

    Args:
        ee_position_w: End-effector position in the world frame, in [m]. Shape (B, 3).

    Returns:
        Shape (B,), bool.
    """
    p, device = ee_position_w, ee_position_w.device
    # Where z < -0.25 m, outside the box below, it is also below 0.15 m.
    near_base = (p.abs() < _constant((0.3, 0.3, 0.25), device)).all(-1)
    too_low = (p < _constant((-math.inf, -math.inf, 0.15), device)).any(-1)
    too_far = (p > _constant((0.7, math.inf, math.inf), device)).any(-1)
    return near_base | too_low | too_far


def guided_visual_reward(
    visible_fraction: Tensor, target_seen: Tensor, any_tomato_seen: Tensor, reach: Tensor
) -> Tensor:
    """R_v of the guided task (Eq. 5-3).

    The cases exclude each other in this order: the asked pose is outside the workspace (-0.1), no tomato is
    seen (-0.5), tomatoes but not the target (-0.1), the target: V_f, with +0.5 above 0.85, else +0.25 above
    0.7, or -0.05 below 0.15. A neighbour pose counts as a view like any other: the camera looked from it.

    Args:
        visible_fraction: V_f of the target (Eq. 4-4). Shape (B,).
        target_seen: Whether any of the target is visible. Shape (B,).
        any_tomato_seen: Whether any ripe tomato is visible, the target included. Shape (B,).
        reach: `Reach` values. Shape (B,).

    Returns:
        Shape (B,), from -0.5 to 1.5.
    """
    v, device = visible_fraction, visible_fraction.device
    # How many of the bounds are passed; V_f = 0.15 counts as past the first, which is "below 0.15" turned round.
    passed = torch.stack((v >= 0.15, v > 0.7, v > 0.85)).sum(0)
    bonus = _constant((-0.05, 0.0, 0.25, 0.5), device).take(passed)
    unseen = torch.where(any_tomato_seen, _constant(-0.1, device), _constant(-0.5, device))
    reward = torch.where(target_seen, v + bonus, unseen)
    return torch.where(reach == UNREACHABLE, _constant(-0.1, device), reward)


def guided_pose_penalty(reach: Tensor, forbidden: Tensor) -> Tensor:
    """P_p of the guided task (Eq. 5-4): -0.3 outside the workspace, -0.1 for a neighbour pose, -1.5 in the
    forbidden zone.

    The zone is judged where the end-effector really is, so its penalty adds to that of a neighbour pose.

    Args:
        reach: `Reach` values. Shape (B,).
        forbidden: `in_forbidden_zone` of the pose taken. Shape (B,).

    Returns:
        Shape (B,), from -1.6 to 0.
    """
    device = reach.device
    workspace = _constant((0.0, -0.1, -0.3), device).take(reach)
    return torch.where(forbidden, workspace + _constant(-1.5, device), workspace)


def sparse_visual_reward(
    visible_fraction: Tensor, target_seen: Tensor, any_tomato_seen: Tensor, reach: Tensor
) -> Tensor:
    """R_v of the sparse task (Eq. 5-9): 1 above 0.8, 0.1 between 0.6 and 0.8, -0.1 if no tomato is seen,
    otherwise 0.

    The bounds are strict as printed, so exactly 0.6 or 0.8 gives 0. `target_seen` and `reach` are not part of
    Eq. 5-9; they stand in the signature so that both tasks call their reward alike.

    Args:
        visible_fraction: V_f of the target (Eq. 4-4). Shape (B,).
        target_seen: Unused. Shape (B,).
        any_tomato_seen: Whether any ripe tomato is visible, the target included. Shape (B,).
        reach: Unused. Shape (B,).

    Returns:
        Shape (B,), from -0.1 to 1.
    """
    del target_seen, reach
    v, device = visible_fraction, visible_fraction.device
    between = (v > 0.6) & (v < 0.8)
    seen = torch.where(between, _constant(0.1, device), (v > 0.8).float())
    return torch.where(any_tomato_seen, seen, _constant(-0.1, device))


def sparse_pose_penalty(reach: Tensor, forbidden: Tensor) -> Tensor:
    """P_p of the sparse task (Eq. 5-10): -1 outside the workspace, -1 in the forbidden zone.

    Args:
        reach: `Reach` values. Shape (B,).
        forbidden: `in_forbidden_zone` of the pose taken. Shape (B,).

    Returns:
        Shape (B,), from -2 to 0; the sum with R_v is clipped to [-1, 1] (section 5-2-1).
    """
    return -((reach == UNREACHABLE).float() + forbidden.float())
