"""The clock of the loop and the drivers: monotonic seconds, real or simulated."""

import time
from typing import Protocol

from maniskill_tomato.deploy.deploy_errors import FaultError


class Clock(Protocol):
    """Where every time stamp comes from."""

    def now(self) -> float:
        """Seconds since some moment, never less than before."""
        ...

    def sleep(self, seconds: float) -> None:
        """Returns `seconds` later, or at once if that is not positive."""
        ...


class MonotonicClock:
    """The machine's monotonic clock, which no change of the date moves."""

    def now(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        if seconds > 0.0:
            time.sleep(seconds)


class SimulatedClock:
    """A clock that advances by what is slept, so that a run takes no longer than its computations."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += max(0.0, seconds)

    def set(self, now: float) -> None:
        """Jumps, also back: a fault to inject."""
        self._now = now


class CheckedClock:
    """Passes on another clock's time and notices when it runs backwards."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._last = clock.now()

    def now(self) -> float:
        """The time.

        Raises:
            FaultError: It is earlier than it has been.
        """
        now = self._clock.now()
        if not now >= self._last:
            raise FaultError(
                f"the clock went back from {self._last:.3f} s to {now:.3f} s, so that no age can be trusted; "
                "use a monotonic clock and start again"
            )
        self._last = now
        return now

    def sleep(self, seconds: float) -> None:
        self._clock.sleep(seconds)
