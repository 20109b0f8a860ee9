"""What only the simulator knows: how much of the target would be seen from elsewhere, and what would be touched."""

import torch
from torch import Tensor

from maniskill_tomato.policies.moves import move_towards
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.look_at_move import LookAtMover
from maniskill_tomato.tasks.plant_batch import PlantBatch
from maniskill_tomato.tasks.world_state import WorldState


class WorldTruth:
    """Asks the plants themselves: the `policies.protocol.GroundTruth` of a world."""

    def __init__(self, scene: RayScene, plant_batch: PlantBatch, state: WorldState, threshold: float) -> None:
        """Follows a world's plants, targets and arms.

        Args:
            scene: Casts the rays and measures distances.
            plant_batch: The plants.
            state: Of the world.
            threshold: V_f above which the task counts the target as fully visible.
        """
        self.threshold = threshold
        self._mover: LookAtMover | None = None
        self._scene = scene
        self._plant_batch = plant_batch
        self._state = state

    def visible_fraction(
        self,
        T_world_camera: Tensor,
        env_index: int = 0,
        qpos: Tensor | None = None,
        fruit: int | None = None,
    ) -> Tensor:
        """V_f of an environment's target, or of another fruit, from K viewpoints.

        Args:
            T_world_camera: Poses of the optical frames, translation in [m]. Shape (K, 4, 4).
            env_index: Which environment.
            qpos: The arm's joint positions at each, in [rad], if it shall hide what it hides; None for no arm.
                Shape (K, 7).
            fruit: Index in `Plant.fruits`; the target if None.

        Returns:
            In [0, 1]. Shape (K,).
        """
        links = None if qpos is None else link_transforms(qpos.float())
        target = int(self._state.target[env_index]) if fruit is None else fruit
        T_w_plant = self._plant_batch.T_world_plant[env_index]
        return self._scene.visible_fraction_from(T_world_camera.float(), target, T_w_plant, links, env_index)

    def clearance(self, start_qpos: Tensor, end_qpos: Tensor, env_index: int = 0) -> Tensor:
        """How near the arm comes to an environment's plants on K moves; see `RayScene.clearance_along`.

        Args:
            start_qpos: Joint positions, in [rad]. Shape (K, 7).
            end_qpos: Likewise. Shape (K, 7).
            env_index: Which environment.

        Returns:
            In [m], negative in contact. Shape (K,).
        """
        count = len(start_qpos)
        T_w_plant = self._plant_batch.T_world_plant[env_index].expand(count, 4, 4)
        env_idx = torch.full((count,), env_index, device=start_qpos.device)
        return self._scene.clearance_along(start_qpos.float(), end_qpos.float(), T_w_plant, env_idx)

    def can_follow(
        self, start: Tensor, way: Tensor, target: Tensor, env_index: int = 0, *, contact_free: bool = False
    ) -> bool:
        """Whether the arm, from where it stands, can make every move of a way and sees the target at its end.

        Args:
            start: Where the camera stands, in the world frame, in [m]. Shape (3,).
            way: Stops of the camera. Shape (n, 3).
            target: What it looks at. Shape (3,).
            env_index: Which environment.
            contact_free: Whether no move may touch the plants.
        """
        if not len(way):
            return False
        if self._mover is None:
            self._mover = LookAtMover(start.device)
        position, target = start[None].double(), target[None].double()
        joints = [self._state.qpos[env_index][None].double()]
        T_world_camera = torch.eye(4)[None]
        for stop in way.double():
            move = self._mover.move(joints[-1], position, target, move_towards(position, target, stop[None]))
            if int(move.reach[0]) != int(Reach.REACHABLE):
                return False
            T_world_camera = move.T_world_camera
            position = T_world_camera[:, :3, 3]
            joints.append(move.qpos)
        seen = self.visible_fraction(T_world_camera, env_index, joints[-1])
        if float(seen) <= self.threshold:
            return False
        if not contact_free:
            return True
        clearance = self.clearance(torch.cat(joints[:-1]), torch.cat(joints[1:]), env_index)
        return bool((clearance > 0.0).all())
