"""When the pictures of a recording were taken: by the stamps in the file, counted from where it began to play."""

import math

from maniskill_tomato.deploy.deploy_errors import ProtocolError


class PlaybackTime:
    """Turns a file's stamps into moments of the run's clock.

    The first picture comes one period after the file began to play, and every other one as long after it as the file
    says. A picture whose moment has passed is therefore old, whenever it is read.
    """

    def __init__(self, period_s: float, repeats: bool) -> None:
        """Begins with the first stamp.

        Args:
            period_s: Between two pictures, in [s].
            repeats: Whether the file starts again at its end, and its stamps with it.
        """
        self._period_s, self._repeats = period_s, repeats
        self._last: float | None = None
        self._start = 0.0

    def moment(self, stamp: float, now: float) -> float:
        """When a picture was taken, by the run's clock, in [s].

        Args:
            stamp: The file's, in [s].
            now: The run's clock, in [s].

        Raises:
            ProtocolError: The stamp is no number, or goes back in a file that does not repeat.
        """
        if not math.isfinite(stamp):
            raise ProtocolError(f"the recording gives {stamp} s as the time of a picture; record it again")
        if self._last is None:
            self._start = now + self._period_s - stamp
        elif stamp < self._last:
            if not self._repeats:
                raise ProtocolError(
                    f"the recording's time goes back from {self._last:.3f} s to {stamp:.3f} s; record it again"
                )
            self._start += self._last + self._period_s - stamp
        self._last = stamp
        return self._start + stamp
