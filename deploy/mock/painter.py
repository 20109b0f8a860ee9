"""Colours of the twin's pictures: flat ones, or SAPIEN's, which need Vulkan and ManiSkill."""

import logging
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.mock.twin_world import TwinWorld
from maniskill_tomato.raycast.images import ROBOT_LABEL, Picture

_logger = logging.getLogger(__name__)


class Painter(Protocol):
    """Makes the colour picture that belongs to depths and labels."""

    name: str
    """In `deploy check`."""

    def paint(self, world: TwinWorld, picture: Picture) -> NDArray[np.uint8]:
        """RGB. Shape (H, W, 3)."""
        ...


class FlatPainter:
    """One colour a kind of surface, darker where one looks along it; needs nothing but the ray caster."""

    name = "flat"

    def paint(self, world: TwinWorld, picture: Picture) -> NDArray[np.uint8]:
        return world.color(picture)


class SapienPainter:
    """The plant as SAPIEN renders it for the simulated tasks; the robot, which one seldom sees, in flat colours."""

    name = "sapien"

    def __init__(self, world: TwinWorld) -> None:
        from maniskill_tomato.deploy.mock.sapien_view import SapienView

        episode = world.episode
        self._view: Any = SapienView(episode.plant, episode.T_world_plant.double().numpy(), world.intrinsics)

    def paint(self, world: TwinWorld, picture: Picture) -> NDArray[np.uint8]:
        color: NDArray[np.uint8] = self._view.color(world.camera_pose())
        robot = picture.labels == ROBOT_LABEL
        if robot.any():
            color = np.where(robot[..., None], world.color(picture), color)
        return color


def make_painter(renderer: Literal["rays", "sapien", "auto"], world: TwinWorld) -> Painter:
    """The painter that a profile asks for.

    Raises:
        ProfileError: `sapien` cannot render here.
    """
    if renderer == "rays":
        return FlatPainter()
    try:
        return SapienPainter(world)
    except (ImportError, RuntimeError) as error:
        if renderer == "sapien":
            raise ProfileError(
                f"twin.renderer is 'sapien', which cannot render here ({error}); use 'rays' or 'auto', or install "
                "Vulkan with `make vulkan`"
            ) from error
        _logger.info("no SAPIEN renderer here (%s); the twin's pictures have flat colours", error)
        return FlatPainter()
