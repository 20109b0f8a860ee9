"""The checks of a command before it goes to the arm. They are pure functions that refuse with a reason.

    safety = Safety(config)
    refusal = safety.check(move, state, now, frame_stamp, points_w)

A command is accepted as it is or refused; it is never altered. Cheap checks run first: finite numbers, joint limits,
step sizes, ages, the path of the flange. Collisions come last, along the straight line in joint space that a PTP move
follows.
"""

import math
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.deploy.collision import Box, CollisionChecker
from maniskill_tomato.deploy.interface import ArmState, Float64, JointMove
from maniskill_tomato.deploy.motion_bounds import (
    chord_error,
    chords_meet,
    joint_path,
    lever_arms,
    pieces_for,
    straight_line,
)
from maniskill_tomato.deploy.plant_points import sphere_distances, swept_distances
from maniskill_tomato.deploy.refusals import Reason, Refusal, words
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.kinematics import forward_kinematics

CHORD_ERROR: Final = 1e-4
"""Flange and camera leave the chords between the postures that are looked at by less than this, in [m]."""

WORST_STEP: Final = 0.01
"""How near a refused move gets to something is told by postures this far apart, in [rad]."""

DEGREES = 180.0 / math.pi


class Safety:
    """The checks of one envelope."""

    def __init__(
        self,
        config: SafetyConfig | None = None,
        T_flange_camera: Float64 = T_flange_camera_color_optical,
        model: ArmModel = IIWA14,
    ) -> None:
        """Prepares the checks.

        Args:
            config: The envelope; the usual one if None.
            T_flange_camera: Where the camera's optical frame was measured to be in `link_ee`; its housing goes with
                it. Shape (4, 4).
            model: Of the arm, whose limits and shapes are held against every command.
        """
        self.config = config or SafetyConfig()
        self.model = model
        self._T_flange_camera = T_flange_camera
        beyond = abs(model.flange_height) + float(np.linalg.norm(T_flange_camera[:3, 3]))
        self._levers = lever_arms(model.joint_origins, beyond)
        c = self.config
        self._collisions = CollisionChecker(
            table_height=c.table_height,
            table_clearance=c.table_clearance,
            self_clearance=c.self_clearance,
            obstacles=c.obstacles,
            obstacle_clearance=c.obstacle_clearance,
            T_flange_camera=T_flange_camera,
            model=model,
        )

    def check(
        self,
        move: JointMove,
        state: ArmState,
        now: float,
        frame_stamp: float | None = None,
        points_w: Float64 | None = None,
    ) -> Refusal | None:
        """Judges a command.

        Args:
            move: What shall be sent.
            state: Where the arm is.
            now: The time, in [s].
            frame_stamp: When the picture was taken that the command rests on, in [s]; None if it rests on none.
            points_w: What was seen of the plant, base frame, in [m]; None for no such check. Shape (P, 3).

        Returns:
            None if it may go out.
        """
        refusal = (
            self._numbers(move, state, now, frame_stamp)
            or self._seen(points_w)
            or self._limits(move, state)
            or self._ages(state, now, frame_stamp)
        )
        if refusal is not None:
            return refusal
        start, goal = state.joint_positions, move.joint_positions
        refusal = self._way(start, goal) or self._contacts(start, goal) or self._plant(start, goal, points_w)
        if refusal is None:
            return None
        more = refusal.nearest

        def nearest() -> str:
            part = self._part(move, state, now, frame_stamp, points_w)
            return "; ".join(filter(None, (more(), part)))

        return replace(refusal, nearest=nearest)

    def _part(
        self,
        move: JointMove,
        state: ArmState,
        now: float,
        frame_stamp: float | None,
        points_w: Float64 | None,
    ) -> str:
        """How much of a refused move is allowed, in whole percent."""
        start, turn = state.joint_positions, move.joint_positions - state.joint_positions
        allowed, refused = 0, 100
        while refused - allowed > 1:
            middle = (allowed + refused) // 2
            part = replace(move, joint_positions=start + middle / 100 * turn)
            if self.check(part, state, now, frame_stamp, points_w) is None:
                allowed = middle
            else:
                refused = middle
        if not allowed:
            return "no part of the move is allowed"
        goal = ", ".join(f"{v:.1f}" for v in np.rad2deg(start + allowed / 100 * turn))
        return f"the first {allowed} % of the move are allowed, to joints at ({goal}) deg"

    def stands_in_collision(self, joint_positions: Float64, points_w: Float64 | None) -> bool:
        """Whether a posture touches something wherever the arm comes from.

        Args:
            joint_positions: In [rad]. Shape (7,).
            points_w: What was seen of the plant, base frame, in [m]; None for no such check. Shape (P, 3).
        """
        c = self.config
        if self._seen(points_w) is not None or self._collisions.nearest(joint_positions[None]) is not None:
            return True
        if c.plant_clearance is None or points_w is None or len(points_w) < c.plant_points_needed:
            return False
        near = self._sphere_distances(joint_positions[None], points_w) < c.plant_clearance
        return int(near.sum()) >= c.plant_points_needed

    def _sphere_distances(self, path: Float64, points_w: Float64) -> Float64:
        return sphere_distances(path, points_w, self._T_flange_camera, self.model)

    def _numbers(
        self, move: JointMove, state: ArmState, now: float, frame_stamp: float | None
    ) -> Refusal | None:
        for name, values in (
            ("the commanded joint positions", move.joint_positions),
            ("the measured joint positions", state.joint_positions),
            ("the measured joint velocities", state.joint_velocities),
            ("the speed fraction", np.array(move.speed_fraction, dtype=np.float64)),
            ("the time stamps", np.array([state.stamp, now, now if frame_stamp is None else frame_stamp])),
        ):
            if not np.isfinite(values).all():
                return Refusal(
                    reason="not_finite",
                    detail=f"{name} are not finite: {values.tolist()}",
                    nearest=words("any finite number within the limits is allowed"),
                )
        return None

    def _seen(self, points_w: Float64 | None) -> Refusal | None:
        """A point that is not finite is near to nothing by every comparison, so that it would hide a leaf."""
        if points_w is None or self.config.plant_clearance is None:
            return None
        bad = int((~np.isfinite(points_w)).any(-1).sum())
        if not bad:
            return None
        return Refusal(
            reason="not_finite",
            detail=f"{bad} of the {len(points_w)} points that were seen of the plant are not finite",
            nearest=words("none may be"),
        )

    def _limits(self, move: JointMove, state: ArmState) -> Refusal | None:
        c, joints = self.config, move.joint_positions
        fraction = move.speed_fraction
        if not 0.0 < fraction <= c.max_speed_fraction:
            over = max(fraction - c.max_speed_fraction, 0.0)
            nearest = f"{c.max_speed_fraction:g}" if over else "the smallest number above 0"
            return Refusal(
                reason="speed",
                detail=f"the speed fraction must be above 0 and at most {c.max_speed_fraction:g}, got {fraction:g}: "
                f"{over or -fraction:.6g} too {'fast' if over else 'slow'}",
                nearest=words(f"the nearest allowed is {nearest}"),
            )
        low, high = self.model.joint_lower + c.joint_margin, self.model.joint_upper - c.joint_margin
        over_limit = np.maximum(low - joints, joints - high)
        if (over_limit > 0.0).any():
            k = int(over_limit.argmax())
            # Rounded inwards: what is told is allowed.
            least, most = math.ceil(low[k] * DEGREES * 100) / 100, math.floor(high[k] * DEGREES * 100) / 100
            bound = least if joints[k] < low[k] else most
            return Refusal(
                reason="joint_limit",
                detail=f"{self.model.joint_names[k]} must stay from {least:.2f} to {most:.2f} deg, got "
                f"{float(joints[k]) * DEGREES:.2f} deg: {over_limit[k] * DEGREES:.2f} deg too far",
                nearest=words(f"the nearest allowed is {bound:.2f} deg"),
            )
        step = np.abs(joints - state.joint_positions)
        if (step > c.max_joint_step).any():
            k = int(step.argmax())
            way = math.floor(c.max_joint_step * 1e4) / 1e4
            start = float(state.joint_positions[k])
            to = start + math.copysign(way - 1e-4, float(joints[k]) - start)
            return Refusal(
                reason="joint_step",
                detail=f"{self.model.joint_names[k]} would turn {step[k]:.4f} rad in one move, allowed are "
                f"{c.max_joint_step:g} rad: {step[k] - c.max_joint_step:.4f} rad too far",
                nearest=words(f"the nearest allowed is {to:.4f} rad"),
            )
        return None

    def _ages(self, state: ArmState, now: float, frame_stamp: float | None) -> Refusal | None:
        c = self.config
        picture_age = 0.0 if frame_stamp is None else now - frame_stamp
        ages: tuple[tuple[Reason, str, float, float], ...] = (
            ("stale_state", "the arm's state", now - state.stamp, c.max_state_age),
            ("stale_frame", "the picture", picture_age, c.max_frame_age),
        )
        for reason, what, age, oldest in ages:
            if not 0.0 <= age <= oldest:
                off = f"{age - oldest:.3f} s too old" if age > oldest else f"{-age:.3f} s in the future"
                return Refusal(
                    reason=reason,
                    detail=f"{what} is {age:.3f} s old, it must be from 0 to {oldest:g} s: {off}",
                    nearest=words(f"the nearest allowed is {oldest if age > oldest else 0.0:g} s"),
                )
        return None

    def _way(self, start: Float64, goal: Float64) -> Refusal | None:
        c, turn = self.config, goal - start
        pieces = pieces_for(turn, self._levers, CHORD_ERROR)
        path = straight_line(start, goal, pieces)
        T_w_flange = forward_kinematics(torch.as_tensor(path), self.model).numpy()
        flange = T_w_flange[:, :3, 3]
        camera = flange + T_w_flange[:, :3, :3] @ self._T_flange_camera[:3, 3]
        error = chord_error(turn, self._levers, pieces)
        # The start is where the arm is already: a move may lead out of a wrong place, not into it.
        leaving = int(np.ceil(pieces * min(1.0, c.leave_within / max(float(np.abs(turn).max()), 1e-12))))
        outside = ~_within(flange, c.workspace, -error)
        outside[: 1 if _within(flange[0], c.workspace) else leaving] = False
        if outside.any():
            k = int(outside.argmax())
            low, high = np.array(c.workspace.low), np.array(c.workspace.high)
            beyond = np.maximum(low - flange, flange - high).max(
                axis=0, where=outside[:, None], initial=-np.inf
            )
            axis = int(beyond.argmax())
            return Refusal(
                reason="workspace",
                detail=f"the flange would be at {_metres(flange[k])}, outside {c.workspace}: up to "
                f"{1e3 * max(float(beyond[axis]), 0.0):.1f} mm too far along {'xyz'[axis]}",
            )
        for name, positions in (("flange", flange), ("camera", camera)):
            for box in c.forbidden:
                meets = chords_meet(positions, np.array(box.low) - error, np.array(box.high) + error)
                if _within(positions[0], box):
                    meets[:leaving] = False
                    meets[leaving - 1] = _within(positions[leaving], box)
                if meets.any():
                    k = int(meets.argmax()) + 1
                    ends = np.minimum(positions - box.low, np.array(box.high) - positions).min(axis=-1)
                    deep = max(float(ends[1:].max(where=meets, initial=0.0)), 0.0)
                    return Refusal(
                        reason="forbidden_zone",
                        detail=f"the {name} would be at {_metres(positions[k])}, inside {box}: at least "
                        f"{1e3 * deep:.1f} mm deep",
                    )
        away = np.linalg.norm(flange - flange[0], axis=-1)
        if (away + error > c.max_flange_step).any():
            return Refusal(
                reason="flange_step",
                detail=f"the flange would get {away.max():.4f} m away in one move, allowed are {c.max_flange_step:g} "
                f"m: {1e3 * (away.max() + error - c.max_flange_step):.1f} mm too far",
            )
        return None

    def _contacts(self, start: Float64, goal: Float64) -> Refusal | None:
        contact = self._collisions.along(start, goal, self.config.leave_within)
        if contact is None:
            return None
        reason: Reason = "self_collision"
        if contact.second == "table":
            reason = "table"
        elif contact.second.startswith("obstacle"):
            reason = "obstacle"

        def worst() -> str:
            nearest = self._collisions.smallest(contact, joint_path(start, goal, WORST_STEP))
            return f"at the nearest {nearest * 1e3:.1f} mm, {(contact.clearance - nearest) * 1e3:.1f} mm too near"

        return Refusal(
            reason=reason,
            detail=f"{contact.first} would come within {contact.distance * 1e3:.1f} mm of {contact.second} after "
            f"{contact.share:.0%} of the move, {contact.clearance * 1e3:g} mm must be left",
            nearest=worst,
        )

    def _plant(self, start: Float64, goal: Float64, points_w: Float64 | None) -> Refusal | None:
        c = self.config
        if c.plant_clearance is None or points_w is None or len(points_w) < c.plant_points_needed:
            return None
        nearest = swept_distances(start, goal, points_w, c.plant_clearance, self._T_flange_camera, self.model)
        standing = self._sphere_distances(start[None], points_w)[0]
        # Where the arm is near a leaf already, it may go away from it but not nearer.
        touched = (nearest < c.plant_clearance) & (nearest < standing - 1e-3)
        if int(touched.sum()) < c.plant_points_needed:
            return None
        return Refusal(
            reason="plant",
            detail=f"{int(touched.sum())} points of the plant would be nearer than {c.plant_clearance * 1e3:.1f} mm "
            f"to the arm's spheres, the nearest {nearest[touched].min() * 1e3:.1f} mm: "
            f"{(c.plant_clearance - nearest[touched].min()) * 1e3:.1f} mm too near; fewer than "
            f"{c.plant_points_needed} such points are taken for noise",
        )


def _within(positions: Float64, box: Box, margin: float = 0.0) -> NDArray[np.bool_]:
    inside = (positions >= np.array(box.low) - margin) & (positions <= np.array(box.high) + margin)
    return np.asarray(inside.all(-1))


def _metres(position: Float64) -> str:
    return "(" + ", ".join(f"{v:.3f}" for v in position) + ") m"
