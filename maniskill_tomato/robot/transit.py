"""Transits: the arm draws back, passes its ready posture and approaches a view in another posture.

A `pd_look_at` move turns no joint by more than `LARGEST_JOINT_STEP`, so that an arm that is bent the wrong way cannot
look at some places next to it. This is its way out: the camera backs away from the row, straight along -x, the joints
go to `READY_QPOS` and from there to where the camera comes in along +x to the wanted view. Backing along the optical
axis instead, or not at all, swept through leaves four times as often on the way to the ready posture and back. What is
known of the plants is not asked; the arm only keeps off the floor and its base.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14, LINK_NAMES
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics, link_transforms
from maniskill_tomato.robot.look_at import camera_to_flange, flange_to_camera
from maniskill_tomato.robot.look_at_move import LARGEST_JOINT_STEP, LookAtMover, keeps_clear

TRANSIT_MOVES: Final = 2
"""Moves that a transit counts as: one to the ready posture, one from there."""

CLEAR_X: Final = 0.2
"""How far the camera backs away, if the arm can: to this x in the base frame, in [m]."""
LOWEST_LINK: Final = 0.17
"""On the way from the ready posture the elbow and the forearm's middle stay above this, in [m]: `link_4` reaches 0.15 m
down from the elbow."""
RETREAT_STEP: Final = 0.08
"""Longest step of it, in [m]."""

STAND_OFF: Final = 0.3
"""Places for the first view of a target are at least this far from it, in [m]."""

LEG_PARTS: Final = 8
"""Straight parts of each leg, at whose ends it is checked and measured."""

ANY_STEP: Final = 10.0
"""No joint can turn farther, in [rad]."""

LOW_LINKS: Final = slice(LINK_NAMES.index("link_4"), LINK_NAMES.index("link_6"))
"""Those that this is about."""

_BLOCK = 32


@dataclass(frozen=True, eq=False, kw_only=True)
class Transit:
    """A way to a view by the ready posture."""

    waypoints: Tensor
    """Joint positions, straight lines between them, the present ones first, in [rad]. Shape (n, 7), float64."""
    T_world_camera: Tensor
    """Where the optical frame is then. Shape (4, 4), float64."""
    place: int
    """Which of the wanted places it is."""
    model: ArmModel = IIWA14
    """Of the arm."""

    @property
    def passed(self) -> Tensor:
        """Joint positions along the way, each leg in `LEG_PARTS`, the present ones first, in [rad]. Shape (m, 7)."""
        return _passed(self.waypoints)

    @property
    def camera_path_m(self) -> float:
        """Length of the camera's way, in [m]."""
        camera = flange_to_camera(forward_kinematics(self.passed, self.model))[:, :3, 3]
        return float(camera.diff(dim=0).norm(dim=-1).sum())

    @property
    def joint_path_rad(self) -> float:
        """Way of all joints together, the sum of |dq|, in [rad]."""
        return float(self.waypoints.diff(dim=0).abs().sum())


class TransitPlanner:
    """Plans for one arm; not for use from several threads at once."""

    def __init__(self, device: str | torch.device = "cpu", model: ArmModel = IIWA14) -> None:
        """Prepares the inverse kinematics.

        Args:
            device: Where tensors live.
            model: Of the arm.
        """
        self._model = model
        self._mover = LookAtMover(device, model=model)
        self._kinematics = InverseKinematics(device, model=model)
        self._ready = torch.tensor(model.ready_qpos, dtype=torch.float64, device=self._kinematics.device)

    def can_turn(self, qpos: Tensor, target: Tensor) -> bool:
        """Whether the camera can look at a target from where it is without a transit.

        Args:
            qpos: Joint positions, in [rad]. Shape (7,).
            target: In the base frame, in [m]. Shape (3,).
        """
        qpos = qpos.double()[None]
        position = flange_to_camera(forward_kinematics(qpos, self._model))[:, :3, 3]
        return int(self._mover.look_from(qpos, position, target.double()[None]).reach[0]) == Reach.REACHABLE

    def to_first_view(
        self, qpos: Tensor, camera_position: Tensor, places: Tensor, target: Tensor
    ) -> Transit | None:
        """The way to the nearest place for a first view of a target.

        Args:
            qpos: Joint positions, in [rad]. Shape (7,).
            camera_position: Where the camera is, in the base frame, in [m]. Shape (3,).
            places: Where it may look from; those nearer than `STAND_OFF` are left out, likewise. Shape (K, 3).
            target: What it shall look at, likewise. Shape (3,).

        Returns:
            None if the camera sees the target from where it is, or if there is none.
        """
        if self.can_turn(qpos, target):
            return None
        places = places[(places - camera_position).norm(dim=-1).argsort()]
        away = (places - target).norm(dim=-1)
        return self.plan(qpos, places[away >= STAND_OFF], target)

    def plan(self, qpos: Tensor, places: Tensor, target: Tensor) -> Transit | None:
        """The way to the first place from which the arm can look at the target.

        Args:
            qpos: Joint positions, in [rad]. Shape (7,).
            places: Of the camera, the most wanted first, in the base frame, in [m]. Shape (K, 3).
            target: What it shall look at, in the base frame, in [m]. Shape (3,).

        Returns:
            None if there is none.

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        if qpos.shape != (NUM_JOINTS,) or target.shape != (3,) or places.shape[1:] != (3,):
            raise InvalidInputError(
                f"qpos, places and target must have shapes (7,), (K, 3) and (3,), got {tuple(qpos.shape)}, "
                f"{tuple(places.shape)} and {tuple(target.shape)}"
            )
        out = [*self.backed_away(qpos.double()), self._ready]
        if not self._is_clear(out):
            return None
        for place, goal, T_world_camera in self._looks(places.double(), target.double()):
            back = [self._ready, *reversed(self.backed_away(goal))]
            if self._is_clear(back, LOWEST_LINK):
                waypoints = torch.stack([*out, *back[1:]])
                return Transit(
                    waypoints=waypoints, T_world_camera=T_world_camera, place=place, model=self._model
                )
        return None

    def _looks(self, places: Tensor, target: Tensor) -> Iterator[tuple[int, Tensor, Tensor]]:
        """The places that can be taken, in their order, with the joints nearest to the ready posture's."""
        for first in range(0, len(places), _BLOCK):
            block = places[first : first + _BLOCK]
            # The kernel keeps its buffers for a few batch sizes only.
            padded = torch.cat([block, block[:1].expand(_BLOCK - len(block), 3)])
            look = self._mover.look_from(
                self._ready.expand(_BLOCK, NUM_JOINTS),
                padded,
                target.expand(_BLOCK, 3),
                largest_joint_step=ANY_STEP,
            )
            for k in (look.reach[: len(block)] == int(Reach.REACHABLE)).nonzero()[:, 0].tolist():
                yield first + k, look.qpos[k], look.T_world_camera[k]

    def backed_away(self, qpos: Tensor) -> list[Tensor]:
        """Joint positions on the way back with the camera held as it is, as far as the arm gets, those given first.

        Args:
            qpos: Joint positions, in [rad]. Shape (7,), float64.

        Returns:
            In [rad]. Each of shape (7,).
        """
        joints = [qpos]
        pose = flange_to_camera(forward_kinematics(qpos[None], self._model))
        way = max(float(pose[0, 0, 3]) - CLEAR_X, 0.0)
        steps = math.ceil(way / RETREAT_STEP)
        for k in range(1, steps + 1):
            behind = pose.clone()
            behind[:, 0, 3] -= way * k / steps
            flange = camera_to_flange(behind)
            solution = self._kinematics.solve(flange, joints[-1][None], neighbour=False)
            turned = float((solution.qpos[0] - joints[-1]).abs().max())
            reached = int(solution.reach[0]) == Reach.REACHABLE and bool(keeps_clear(flange)[0])
            if not reached or turned > LARGEST_JOINT_STEP:
                break
            joints.append(solution.qpos[0])
        return joints

    def _is_clear(self, waypoints: list[Tensor], lowest_link: float = -math.inf) -> bool:
        """Whether the flange keeps off the floor and the base behind the way's start, and the elbow off the floor."""
        links = link_transforms(_passed(torch.stack(waypoints))[1:], self._model)
        high = (links[:, LOW_LINKS, 2, 3] >= lowest_link).all()
        return bool(high) and bool(keeps_clear(links[:, -1]).all())


def _passed(waypoints: Tensor) -> Tensor:
    start, end = waypoints[:-1, None], waypoints[1:, None]
    shares = torch.arange(1, LEG_PARTS + 1, dtype=start.dtype, device=start.device) / LEG_PARTS
    between = torch.lerp(start, end, shares[:, None])
    return torch.cat([waypoints[:1], between.reshape(-1, NUM_JOINTS)])
