"""The action that takes the arm's camera to where a person holds one."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.moves import move_towards
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, camera_to_viewpoint, look_at_pose
from maniskill_tomato.robot.look_at_move import MOVE_SHARES
from maniskill_tomato.tasks.world import World


def hand_move(world: World, position: NDArray[np.float64]) -> Tensor:
    """The move of the first environment's camera to a place, or a part of the way there.

    Where actions are increments of the flange's viewpoint, the camera looks at the target from there, with the first
    roll for which the arm takes the pose exactly; of the way the whole is tried, then a half and a quarter. A move goes
    1 m and turns 1 rad along each axis at most; if all these poses are farther, it goes a part of the way to the
    nearest of them. Where actions are moves about the target, it is the whole way or a full move of it, and what the
    arm makes of that is the task's business.

    Args:
        world: A world of one environment.
        position: Of the camera, in the world frame, in [m]. Shape (3,).

    Returns:
        The action. Shape (1, A), float32.

    Raises:
        InvalidInputError: No single move of the arm leads there.
    """
    state, target = world.state, world.game.known_target()
    stand = world.T_w_camera[:1, :3, 3].double()
    goal = torch.as_tensor(position, dtype=torch.float64, device=world.device)[None]
    if world.moves.control == "look_at":
        return move_towards(stand, target.double(), goal).float()
    shares = goal.new_tensor(MOVE_SHARES).repeat_interleave(len(CAMERA_ROLLS))[:, None]
    rolls = goal.new_tensor(CAMERA_ROLLS).repeat(len(MOVE_SHARES))
    poses = look_at_pose(stand + shares * (goal - stand), target.double().expand(len(rolls), 3), rolls)
    viewpoint = state.viewpoint.expand(len(rolls), 6)
    actions = camera_to_viewpoint(poses, viewpoint[:, 3:].double()).float() - viewpoint
    farthest = actions.abs().amax(dim=-1)
    actions = actions / farthest.clamp_min(1.0)[:, None]
    plan = world.moves.plan(
        state.qpos.expand(len(rolls), -1), viewpoint, target.expand(len(rolls), 3), actions
    )
    takes = plan.reach == int(Reach.REACHABLE)
    if not bool(takes.any()):
        raise InvalidInputError("the arm takes no pose on the way to this place; drag the camera elsewhere")
    whole = takes & (farthest <= 1.0)
    if bool(whole.any()):
        return actions[int(whole.int().argmax())][None]
    return actions[int(farthest.masked_fill(~takes, torch.inf).argmin())][None]
