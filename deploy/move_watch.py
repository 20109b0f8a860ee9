"""Compares what comes back during a move with the planned path in time: place, direction, speed, progress.

The plan is the straight line in joint space, which all joints follow together, no faster than asked, in the time that
the driver expects. Arms pause between the pieces of a move and trail what they are sent. So being late is bounded
loosely, and being beside the line, or ahead, tightly. `docs/deploy.md` has the reasons for each tolerance.
"""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from maniskill_tomato.deploy.interface import Float64, JointMove
from maniskill_tomato.robot.arm_model import ArmModel

PATH_TOLERANCE: Final = 0.03
"""How far a joint may be beside the line, back from where it has been, or ahead of its time, in [rad]."""

SPEED_TOLERANCE: Final = 1.2
"""Joints may be this much faster than asked: controllers overshoot a little when they accelerate."""

LATE_FACTOR: Final = 2.0
"""A move may take this many times as long as the driver expects, and `LATE_S` more, up to any point of its way."""

LATE_S: Final = 2.0
"""In [s]."""

STILL_S: Final = 2.0
"""An arm on its way turns within this time, in [s]."""

STILL_TURN: Final = 0.002
"""An arm has turned once the fastest joint has by this much, in [rad]; less for a slow move."""

SMOOTH_FACTOR: Final = 1.25
"""An arm may begin and end as smoothly as a path of minimum jerk, of whose time a share of the way takes at least
(share / 10)^(1/3) there, and this many times as long. In moves of up to 15 s the other tolerances are wider."""

ENDS_WITHIN_S: Final = 5.0
"""After the arm has got there the driver says so within this, in [s]."""

LONGEST_GAP_S: Final = 0.5
"""What lies between two looks counts as at most this long against the arm, in [s]: a loop that was held up says nothing
of the arm."""


@dataclass(frozen=True, kw_only=True)
class Departure:
    """What speaks against a move under way."""

    kind: Literal["off_path", "back", "fast", "late", "still", "unended"]
    detail: str
    """With numbers, for people."""

    @property
    def is_late(self) -> bool:
        """Whether the arm does too little, rather than something else than asked."""
        return self.kind in ("late", "still", "unended")


class MoveWatch:
    """One move, from before it is sent until it ends."""

    def __init__(self, start: Float64, move: JointMove, seconds: float, now: float, model: ArmModel) -> None:
        """Takes the plan.

        Args:
            start: Where the arm stands, in [rad]. Shape (7,).
            move: What is about to be sent.
            seconds: How long the driver expects it to take, in [s].
            now: The time, in [s].
            model: Of the arm.
        """
        self._joint_names = model.joint_names
        self.start = np.array(start)
        self.goal = move.joint_positions
        self._turn = self.goal - self.start
        self._largest = float(np.abs(self._turn).max())
        cruise = float((np.abs(self._turn) / (model.velocity_limits * move.speed_fraction)).max())
        self._speed = np.abs(self._turn) / cruise if cruise > 0.0 else np.zeros_like(self._turn)
        self.speed_fraction = move.speed_fraction
        self.seconds = seconds
        self.began = self._last_stamp = now
        # The smallest of q - v t and of -q - v t so far: no later reading may lie farther above them than the slack.
        self._lowest = np.stack([self.start, -self.start])
        self._watched = self._since_turn = self._since_there = 0.0
        self._turned_to = self._farthest = 0.0
        self.worst: dict[str, float] = {"off_path": 0.0, "back": 0.0, "fast": 0.0, "late": 0.0, "still": 0.0}
        """The nearest that each tolerance came to being passed, as a share of it."""

    def sent(self, now: float) -> None:
        """The driver has taken the move; delays count from here, in [s]."""
        self._last_stamp = now
        self._watched = self._since_turn = 0.0

    def see(self, joint_positions: Float64, earliest: float, stamp: float) -> Departure | None:
        """Holds a reading against the plan.

        Args:
            joint_positions: In [rad], finite. Shape (7,).
            earliest: When it was measured at the earliest, in [s].
            stamp: And at the latest, in [s].
        """
        share = self._share(joint_positions)
        done = share * self._largest
        gap = min(max(stamp - self._last_stamp, 0.0), LONGEST_GAP_S)
        self._last_stamp = max(self._last_stamp, stamp)
        self._watched += gap
        departure = (
            self._beside(joint_positions, share)
            or self._back(done)
            or self._fast(joint_positions, earliest - self.began, stamp - self.began)
            or self._slow(share, done, gap)
        )
        self._farthest = max(self._farthest, done)
        return departure

    def _share(self, joints: Float64) -> float:
        """Of the way; of the point of the line that is nearest."""
        length = float(self._turn @ self._turn)
        if length == 0.0:
            return 1.0
        return min(max(float((joints - self.start) @ self._turn) / length, 0.0), 1.0)

    def _beside(self, joints: Float64, share: float) -> Departure | None:
        off = np.abs(joints - self.start - share * self._turn)
        k = int(off.argmax())
        self._note("off_path", off[k] / PATH_TOLERANCE)
        if off[k] <= PATH_TOLERANCE:
            return None
        return Departure(
            kind="off_path",
            detail=f"{self._joint_names[k]} is {off[k]:.3f} rad beside the planned line, allowed are "
            f"{PATH_TOLERANCE} rad: {off[k] - PATH_TOLERANCE:.3f} rad too far",
        )

    def _back(self, done: float) -> Departure | None:
        back = self._farthest - done
        self._note("back", back / PATH_TOLERANCE)
        if back <= PATH_TOLERANCE:
            return None
        return Departure(
            kind="back",
            detail=f"the arm went back on its way by {back:.3f} rad, allowed are {PATH_TOLERANCE} rad: "
            f"{back - PATH_TOLERANCE:.3f} rad too far",
        )

    def _fast(self, joints: Float64, earliest: float, stamp: float) -> Departure | None:
        both = np.stack([joints, -joints])
        limit = SPEED_TOLERANCE * self._speed
        ahead = both - limit * stamp - self._lowest
        self._lowest = np.minimum(self._lowest, both - limit * earliest)
        _, k = np.unravel_index(int(ahead.argmax()), ahead.shape)
        worst = float(ahead.max())
        self._note("fast", worst / PATH_TOLERANCE)
        if worst <= PATH_TOLERANCE:
            return None
        return Departure(
            kind="fast",
            detail=f"{self._joint_names[int(k)]} is faster than asked: {worst:.3f} rad ahead of {limit[k]:.3f} rad/s, "
            f"{SPEED_TOLERANCE} times the speed fraction {self.speed_fraction:g}; allowed are {PATH_TOLERANCE} rad: "
            f"{worst - PATH_TOLERANCE:.3f} rad too far",
        )

    def _slow(self, share: float, done: float, gap: float) -> Departure | None:
        left = self._largest - done
        enough = min(STILL_TURN, 0.1 * STILL_S * float(self._speed.max()))
        self._since_turn += gap
        if done >= self._turned_to + enough:
            self._turned_to, self._since_turn = done, 0.0
        if left <= PATH_TOLERANCE / 2.0:
            self._since_there += gap
            if self._since_there <= max(ENDS_WITHIN_S, LATE_FACTOR * self._smooth(PATH_TOLERANCE / 2.0)):
                return None
            return Departure(
                kind="unended",
                detail=f"the arm is there, but the driver has not said so for {self._since_there:.1f} s, allowed are "
                f"{ENDS_WITHIN_S:g} s; it may be "
                "blocked just before its end",
            )
        allowed = max(LATE_FACTOR * self.seconds * share + LATE_S, self._smooth(max(done, enough)))
        self._note("late", self._watched / allowed)
        may_stand = self._watched <= self._smooth(self._turned_to + enough)
        self._note("still", 0.0 if may_stand else self._since_turn / STILL_S)
        if self._since_turn > STILL_S and not may_stand:
            return Departure(
                kind="still",
                detail=f"no joint has turned for {self._since_turn:.1f} s, allowed are {STILL_S:g} s, "
                f"{left:.3f} rad before the end: the arm may "
                "be blocked, or its readings are frozen",
            )
        if self._watched > allowed:
            return Departure(
                kind="late",
                detail=f"the move takes far longer than its speed says: {share:.0%} of it in {self._watched:.1f} s, "
                f"allowed are {allowed:.1f} s; the arm may be blocked",
            )
        return None

    def _smooth(self, done: float) -> float:
        """How long the first or the last part of the move may take, of so much turn of the fastest joint, in [s]."""
        share = done / self._largest if done < self._largest else 1.0
        return float(SMOOTH_FACTOR * self.seconds * (share / 10.0) ** (1.0 / 3.0))

    def _note(self, kind: str, share: float) -> None:
        self.worst[kind] = max(self.worst[kind], float(share))
