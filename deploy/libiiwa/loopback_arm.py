"""The arm of the loopback robot: point-to-point moves as functions of time, which can be cancelled on the way."""

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from maniskill_tomato.robot import iiwa14

FloatArray = npt.NDArray[np.float64]

VELOCITY_WINDOW: Final = 0.01
"""Velocities are the difference of positions this far apart, in [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Phase:
    """A part of a motion along a straight line in joint space. Shares of the line's length, seconds from `began`."""

    began: float
    start: FloatArray
    change: FloatArray
    cruise: float
    """Largest speed, in [1/s]."""
    acceleration: float
    """In [1/s^2]."""
    brakes_from: tuple[float, float] | None = None
    """Share and speed at which it begins to brake; None for a move from rest to rest."""

    @property
    def duration(self) -> float:
        if self.brakes_from is not None:
            return self.brakes_from[1] / self.acceleration
        return 1.0 / self.cruise + self.cruise / self.acceleration

    def share(self, now: float) -> tuple[float, float]:
        """How far along the line it is, and how fast, in [1/s]."""
        t, a = min(max(now - self.began, 0.0), self.duration), self.acceleration
        if self.brakes_from is not None:
            share, speed = self.brakes_from
            return share + speed * t - 0.5 * a * t * t, speed - a * t
        ramp, left = self.cruise / a, self.duration - t
        if t < ramp:
            return 0.5 * a * t * t, a * t
        if left > ramp:
            return self.cruise * (t - 0.5 * ramp), self.cruise
        return 1.0 - 0.5 * a * left * left, a * left

    def position(self, now: float) -> FloatArray:
        return self.start + self.share(now)[0] * self.change

    def braked(self, now: float) -> "_Phase":
        share, speed = self.share(now)
        return _Phase(
            began=now,
            start=self.start,
            change=self.change,
            cruise=self.cruise,
            acceleration=self.acceleration,
            brakes_from=(share, speed),
        )


class CancellableArm:
    """Seven joints that move together; nothing runs in between, positions are computed when they are asked for."""

    def __init__(self, qpos: Sequence[float], speedup: float = 1.0) -> None:
        """Stands.

        Args:
            qpos: Joint angles, in [rad]. Shape (7,).
            speedup: How much faster than a real arm it moves.
        """
        self._lock = threading.Lock()
        self._speedup = speedup
        still = np.array(qpos, dtype=np.float64)
        self._phases = [
            _Phase(began=-math.inf, start=still, change=np.zeros(7), cruise=1.0, acceleration=1.0)
        ]

    @property
    def qpos(self) -> FloatArray:
        """Joint angles now, in [rad]. Shape (7,)."""
        with self._lock:
            return self._position(self._now())

    @property
    def qvel(self) -> FloatArray:
        """Joint speeds as a difference of positions, in [rad/s]. Shape (7,)."""
        with self._lock:
            now = self._now()
            return (self._position(now) - self._position(now - VELOCITY_WINDOW)) / VELOCITY_WINDOW

    @property
    def moves(self) -> bool:
        """Whether it is in a move, or brakes."""
        with self._lock:
            last = self._phases[-1]
            return bool(self._now() < last.began + last.duration)

    def start(self, target: Sequence[float], speed: float, acceleration: float, after_s: float = 0.0) -> None:
        """Begins a move; one that is under way is braked first.

        Args:
            target: Joint angles, in [rad]. Shape (7,).
            speed: Share of the largest joint speeds.
            acceleration: Share of the largest joint accelerations.
            after_s: How long it stands before it moves, in [s].
        """
        with self._lock:
            began = self._brake() + after_s
            start = self._position(began)
            change = np.array(target, dtype=np.float64) - start
            if not np.any(change):
                return
            length = np.maximum(np.abs(change), 1e-12)
            cruise = float(np.min(iiwa14.VELOCITY_LIMITS * speed / length))
            ramp = float(np.min(iiwa14.ACCELERATION_LIMITS * acceleration / length))
            phase = _Phase(
                began=began,
                start=start,
                change=change,
                cruise=min(cruise, math.sqrt(ramp)),
                acceleration=ramp,
            )
            self._phases.append(phase)

    def cancel(self) -> None:
        """Brakes along the path of the move that is under way."""
        with self._lock:
            self._brake()

    def _brake(self) -> float:
        """When it will stand."""
        now, last = self._now(), self._phases[-1]
        if now >= last.began + last.duration:
            return now
        if last.brakes_from is None:
            last = last.braked(now)
            self._phases.append(last)
        return last.began + last.duration

    def _position(self, now: float) -> FloatArray:
        phase = next(phase for phase in reversed(self._phases) if phase.began <= now)
        return phase.position(now)

    def _now(self) -> float:
        return time.monotonic() * self._speedup
