"""Takes a picture that is recent and usable, or raises an error that says what is wrong with it."""

import logging
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import DeployError, NotConnectedError, PerceptionError, StaleError
from maniskill_tomato.deploy.interface import Camera, Frame
from maniskill_tomato.errors import check_positive, check_ranges

_logger = logging.getLogger(__name__)

BLACK: Final = 4
"""A picture whose 99th percentile of colour values is not above this is black."""


@dataclass(frozen=True, kw_only=True)
class CaptureConfig:
    """What pictures must be like."""

    attempts: int = 3
    """So often a picture is tried before the run ends."""
    pause: float = 0.2
    """Between attempts, in [s]."""
    max_age: float = 0.5
    """Oldest picture, in [s]."""
    min_depth_share: float = 0.001
    """Share of the pixels that must have depth; small, because a leaf before the lens leaves hardly any."""

    def __post_init__(self) -> None:
        check_ranges(self, attempts=(1, math.inf), pause=(0.0, math.inf), min_depth_share=(0.0, 0.999))
        check_positive(self, "max_age")


class Capture:
    """Takes pictures of one camera."""

    def __init__(self, camera: Camera, config: CaptureConfig, clock: Clock) -> None:
        self._camera = camera
        self._config = config
        self._clock = clock
        self._last_number: int | None = None

    def is_blind(self, frame: Frame) -> bool:
        """Whether hardly any pixel has depth."""
        return float((frame.depth > 0.0).mean()) < self._config.min_depth_share

    def take(self, after: float, may_be_blind: bool = False) -> Frame:
        """A picture that was begun after a moment, in [s]; tried again if something is wrong with it.

        Args:
            after: In [s].
            may_be_blind: Whether the last attempt's picture is taken although it has hardly any depth.

        Raises:
            DeployError: What was wrong with the last attempt.
        """
        for attempt in range(self._config.attempts):
            try:
                frame = self._camera.read(self._config.max_age, after)
                self._check(frame, after)
                if self.is_blind(frame) and not (may_be_blind and attempt + 1 == self._config.attempts):
                    raise PerceptionError(
                        f"{(frame.depth > 0.0).mean():.2%} of the pixels have depth, at least "
                        f"{self._config.min_depth_share:.2%} are needed; is the infrared projector on, is anything "
                        "within 0.1 to 3 m, or does a leaf cover the lens?"
                    )
                self._last_number = frame.number
                return frame
            except NotConnectedError:
                raise
            except DeployError as error:
                if attempt + 1 == self._config.attempts:
                    raise
                _logger.info("picture not used: %s; trying again", error)
                self._clock.sleep(self._config.pause)
        raise AssertionError("unreachable")

    def _check(self, frame: Frame, after: float) -> None:
        now = self._clock.now()
        if frame.number == self._last_number:
            raise StaleError(f"the camera sends picture {frame.number} again; it is frozen")
        if frame.stamp <= after:
            raise StaleError(f"the picture was taken {after - frame.stamp:.2f} s before the arm stood still")
        if not 0.0 <= now - frame.stamp <= self._config.max_age:
            raise StaleError(
                f"the picture is {now - frame.stamp:.2f} s old, at most {self._config.max_age} s are allowed"
            )
        announced, got = self._camera.intrinsics, frame.intrinsics
        if (got.width, got.height) != (announced.width, announced.height):
            raise PerceptionError(
                f"the picture has {got.width} x {got.height} px, announced were {announced.width} x {announced.height}"
            )
        if np.percentile(frame.color[::4, ::4], 99) <= BLACK:
            raise PerceptionError("the picture is black; is the lens covered, or the exposure wrong?")
        if not np.isfinite(frame.depth).all():
            raise PerceptionError("the depth image has values that are not finite")
