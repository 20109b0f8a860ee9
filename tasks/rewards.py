"""Rewards, penalties and zones of the thesis (Eq. 5-3, 5-4, 5-9, 5-10) as pure functions of tensors.

Every function takes and returns batches of shape (B,). `reach` holds `Reach` values: 0 the asked pose was
reached, 1 a neighbour pose was taken instead, 2 the asked pose is outside the workspace.
"""

import torch
from torch import Tensor

from maniskill_tomato.robot.inverse_kinematics import Reach


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
    # A z below -0.25 m is outside the box around zero that stands for the one around the base, but below 0.15 m.
    near_base = (ee_position_w.abs() < ee_position_w.new_tensor((0.3, 0.3, 0.25))).all(-1)
    return near_base | (ee_position_w[..., 2] < 0.15) | (ee_position_w[..., 0] > 0.7)


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
    v = visible_fraction
    bonus = torch.where(v > 0.85, 0.5, torch.where(v > 0.7, 0.25, torch.where(v < 0.15, -0.05, 0.0)))
    unseen = torch.where(any_tomato_seen, -0.1, -0.5)
    reward = torch.where(target_seen, v + bonus, unseen)
    return torch.where(reach == Reach.UNREACHABLE, -0.1, reward)


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
    workspace = torch.where(
        reach == Reach.UNREACHABLE, -0.3, torch.where(reach == Reach.NEIGHBOUR, -0.1, 0.0)
    )
    return workspace + torch.where(forbidden, -1.5, 0.0)


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
    v = visible_fraction
    seen = torch.where(v > 0.8, 1.0, torch.where((v > 0.6) & (v < 0.8), 0.1, 0.0))
    return torch.where(any_tomato_seen, seen, -0.1)


def sparse_pose_penalty(reach: Tensor, forbidden: Tensor) -> Tensor:
    """P_p of the sparse task (Eq. 5-10): -1 outside the workspace, -1 in the forbidden zone.

    Args:
        reach: `Reach` values. Shape (B,).
        forbidden: `in_forbidden_zone` of the pose taken. Shape (B,).

    Returns:
        Shape (B,), from -2 to 0; the sum with R_v is clipped to [-1, 1] (section 5-2-1).
    """
    return torch.where(reach == Reach.UNREACHABLE, -1.0, 0.0) + torch.where(forbidden, -1.0, 0.0)
