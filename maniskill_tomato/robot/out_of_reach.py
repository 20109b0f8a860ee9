"""Why a view is out of the arm's reach: which limit, by how much, and the nearest place that the camera gets to."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, look_at_pose
from maniskill_tomato.robot.look_at_move import (
    BASE_BOX,
    LARGEST_JOINT_STEP,
    LOWEST_FLANGE,
    MIN_DISTANCE,
    LookAtMover,
    keeps_clear,
)

Float64 = npt.NDArray[np.float64]

SHELL: Final = 0.01
"""Places are looked for on spheres that lie this far apart, in [m]."""

FARTHEST: Final = 0.3
"""Up to this far from the place asked for, in [m]."""

DIRECTIONS: Final = 64
"""Places on each sphere."""

FINEST: Final = 0.5e-3
"""The nearest place in its direction is known to this, in [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutOfReach:
    """A view that is refused."""

    limit: str
    """Which limit, and by how much it would be passed."""
    excess: float | None
    """By how much, in [m] or [rad]; None where the joint limits leave no posture at all."""
    nearest: Float64 | None
    """The nearest place from which the camera can look at the target after one move, world frame, in [m]; None if there
    is none within `FARTHEST`. Shape (3,)."""
    distance: float
    """How far that is from the place asked for, in [m]."""

    def __str__(self) -> str:
        if self.nearest is None:
            return f"out of reach: {self.limit}; no place within {FARTHEST} m of it is in reach of one move from here"
        place = ", ".join(f"{v:.4f}" for v in self.nearest)
        away = f"{1e3 * self.distance:.1f} mm away"
        return f"out of reach: {self.limit}; the nearest place that is allowed is ({place}) m, {away}"


def out_of_reach(
    mover: LookAtMover,
    T_flange_camera: Float64,
    joints: Float64,
    position: Float64,
    target: Float64,
    model: ArmModel = IIWA14,
) -> OutOfReach:
    """Explains why the camera cannot look at a target from a place.

    Args:
        mover: Whose moves they are.
        T_flange_camera: The camera's optical frame in `link_ee`, the mover's. Shape (4, 4).
        joints: Where the arm is, in [rad]. Shape (7,).
        position: Where the camera should be, world frame, in [m]. Shape (3,).
        target: What it should look at, likewise. Shape (3,).
        model: Of the arm, the mover's.
    """
    limit, excess = _limit(mover, T_flange_camera, joints, position, target, model)
    nearest = _nearest(mover, joints, position, target)
    distance = np.inf if nearest is None else float(np.linalg.norm(nearest - position))
    return OutOfReach(limit=limit, excess=excess, nearest=nearest, distance=distance)


def _limit(
    mover: LookAtMover,
    T_flange_camera: Float64,
    joints: Float64,
    position: Float64,
    target: Float64,
    model: ArmModel,
) -> tuple[str, float | None]:
    """Of the pictures turned about the optical axis, what the best one passes."""
    rolls = torch.tensor(CAMERA_ROLLS, dtype=torch.float64)
    poses = look_at_pose(torch.as_tensor(position)[None], torch.as_tensor(target)[None], rolls).numpy()
    flange = poses @ np.linalg.inv(T_flange_camera)
    wrist = flange[:, :3, 3] - model.wrist_to_flange * flange[:, :3, 2]
    away = float(np.linalg.norm(wrist - [0.0, 0.0, model.base_to_shoulder], axis=1).min())
    longest = model.shoulder_to_elbow + model.elbow_to_wrist
    if away > longest:
        return (
            f"the wrist would be {away:.4f} m from the shoulder, the arm reaches {longest:g} m: "
            f"{1e3 * (away - longest):.1f} mm too far",
            away - longest,
        )
    highest = float(flange[:, 2, 3].max())
    if highest < LOWEST_FLANGE:
        return (
            f"the flange would be at a height of {highest:.4f} m, at least {LOWEST_FLANGE:g} m are allowed: "
            f"{1e3 * (LOWEST_FLANGE - highest):.1f} mm too low",
            LOWEST_FLANGE - highest,
        )
    if not bool(keeps_clear(torch.as_tensor(flange)).any()):
        depth = float((np.array(BASE_BOX) - np.abs(flange[:, :3, 3])).min(axis=1).min())
        return (f"the flange would be {1e3 * depth:.1f} mm inside the box around the base", depth)
    anyhow = _look(mover, joints, position[None], target, largest_joint_step=np.inf)
    if int(anyhow.reach[0]) == int(Reach.REACHABLE):
        turn = np.abs(anyhow.qpos[0].numpy() - joints)
        k = int(turn.argmax())
        return (
            f"{model.joint_names[k]} would turn by {turn[k]:.3f} rad in one move, allowed are "
            f"{LARGEST_JOINT_STEP:g} rad: {turn[k] - LARGEST_JOINT_STEP:.3f} rad too far",
            float(turn[k] - LARGEST_JOINT_STEP),
        )
    return "the joint limits leave no posture there", None


def _nearest(mover: LookAtMover, joints: Float64, position: Float64, target: Float64) -> Float64 | None:
    directions = _directions()
    for radius in np.arange(1, round(FARTHEST / SHELL) + 1) * SHELL:
        places = position + radius * directions
        places = places[np.linalg.norm(places - target, axis=1) >= MIN_DISTANCE]
        if not len(places):
            continue
        found = _look(mover, joints, places, target).reach.numpy() == int(Reach.REACHABLE)
        if found.any():
            return _approached(mover, joints, position, places[found][0], target)
    return None


def _approached(
    mover: LookAtMover, joints: Float64, position: Float64, place: Float64, target: Float64
) -> Float64:
    """The nearest to the place asked for on the line to one in reach, up to `FINEST`."""
    outside, inside = 0.0, 1.0
    length = float(np.linalg.norm(place - position))
    while (inside - outside) * length > FINEST:
        middle = (outside + inside) / 2.0
        at = position + middle * (place - position)
        is_far = float(np.linalg.norm(at - target)) >= MIN_DISTANCE
        if is_far and int(_look(mover, joints, at[None], target).reach[0]) == int(Reach.REACHABLE):
            inside = middle
        else:
            outside = middle
    nearest: Float64 = position + inside * (place - position)
    return nearest


def _look(mover: LookAtMover, joints: Float64, places: Float64, target: Float64, **options: Any) -> Any:
    count = len(places)
    return mover.look_from(
        torch.as_tensor(np.tile(joints, (count, 1))),
        torch.as_tensor(places),
        torch.as_tensor(np.tile(target, (count, 1))),
        **options,
    )


def _directions() -> Float64:
    """Evenly about the sphere, by the golden angle. Shape (N, 3)."""
    k = np.arange(DIRECTIONS) + 0.5
    height = 1.0 - 2.0 * k / DIRECTIONS
    turn = np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
