"""What planners that know the truth ask of a general viewpoint environment."""

from typing import Any

import torch
from torch import Tensor

from maniskill_tomato.policies.moves import move_towards
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import LookAtMover


class EnvironmentTruth:
    """The ground truth of an environment, and its arm."""

    def __init__(self, env: Any, contact_free: bool = False) -> None:
        """Follows an environment.

        Args:
            env: Its `unwrapped` has `ground_truth`, `task` and the agent.
            contact_free: Whether `can_follow` also asks that no move touches the plant.
        """
        self._world: Any = env.unwrapped
        self._contact_free = contact_free
        self._mover = LookAtMover(self._world.device)
        self.threshold = float(self._world.task.full_visibility)
        """V_f above which the target counts as fully visible."""

    def visible_fraction(self, T_world_camera: Tensor, env_index: int) -> Tensor:
        """True V_f from other poses, without the arm. Shape (K, 4, 4) to (K,)."""
        seen: Tensor = self._world.ground_truth.visible_fraction(T_world_camera, env_index)
        return seen

    def can_follow(self, start: Tensor, way: Tensor, target: Tensor, env_index: int) -> bool:
        """Whether the arm, from where it stands, makes every move of a way, and its last view is good.

        Args:
            start: Where the camera stands, in the world frame, in [m]. Shape (3,).
            way: Stops of the camera. Shape (n, 3).
            target: What it looks at. Shape (3,).
            env_index: Which environment.
        """
        qpos = self._world.agent.robot.get_qpos()[env_index][None].double()
        position, target = start[None].double(), target[None].double()
        joints = [qpos]
        pose = None
        for stop in way.double():
            action = move_towards(position, target, stop[None])
            move = self._mover.move(joints[-1], position, target, action)
            if int(move.reach[0]) != int(Reach.REACHABLE):
                return False
            pose = move.T_world_camera
            position = pose[:, :3, 3]
            joints.append(move.qpos)
        if pose is None:
            return False
        truth = self._world.ground_truth
        if float(truth.visible_fraction(pose.float(), env_index, joints[-1])) <= self.threshold:
            return False
        if not self._contact_free:
            return True
        clearance = truth.clearance(torch.cat(joints[:-1]), torch.cat(joints[1:]), env_index)
        return bool((clearance > 0.0).all())
