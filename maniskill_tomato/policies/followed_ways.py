"""How many moves the arm really needs to a place: its way there is followed by kinematics, move by move.

A place that the arm can look from may still be out of reach from where it stands: no joint turns farther than
`LARGEST_JOINT_STEP` in a move, so that the arm keeps the posture it is in. A robot knows its joints, and finds that out
without spending moves on it.
"""

from typing import Final

import torch
from torch import Tensor

from maniskill_tomato.policies.moves import LEAST_MOVE, move_towards, moves_needed
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import MAX_MOVE, LookAtMover

SAME_PLACE: Final = 0.25 * MAX_MOVE
"""Cameras this near to each other have the same view, in [m]: a way ends this near to its goal."""

MOST_MOVES: Final = 10
"""Of longer ways the rest is taken to be free."""


def moves_along(mover: LookAtMover, qpos: Tensor, position: Tensor, target: Tensor, goal: Tensor) -> Tensor:
    """How many moves straight towards their goals arms make until they are there.

    Args:
        mover: Makes the moves.
        qpos: Joint positions, in [rad]. Shape (M, 7).
        position: Where the cameras stand, in the base frame, in [m]. Shape (M, 3).
        target: What they look at. Shape (M, 3).
        goal: Where they are to go. Shape (M, 3).

    Returns:
        Infinite where a move is refused on the way. Shape (M,).
    """
    qpos, position = qpos.double().clone(), position.double().clone()
    target, goal = target.double(), goal.double()
    moves = torch.full((len(goal),), torch.inf, device=goal.device)
    open_rows = torch.arange(len(goal), device=goal.device)
    for count in range(1, MOST_MOVES + 1):
        if not len(open_rows):
            break
        before, about = position[open_rows], target[open_rows]
        move = mover.move(qpos[open_rows], before, about, move_towards(before, about, goal[open_rows]))
        after = move.T_world_camera[:, :3, 3]
        is_made = (move.reach != int(Reach.UNREACHABLE)) & ((after - before).norm(dim=-1) >= LEAST_MOVE)
        is_there = is_made & ((goal[open_rows] - after).norm(dim=-1) < SAME_PLACE)
        qpos[open_rows], position[open_rows] = move.qpos, after
        moves[open_rows[is_there]] = float(count)
        open_rows = open_rows[is_made & ~is_there]
    rest = (goal[open_rows] - position[open_rows]).norm(dim=-1)
    moves[open_rows] = MOST_MOVES + moves_needed(rest).to(moves)
    return moves
