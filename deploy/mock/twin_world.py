"""The twin's world: one arm in front of one plant, what its camera sees, and the options of a profile."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.drivers import DriverContext, arm_model
from maniskill_tomato.deploy.interface import Float64, FrameTruth
from maniskill_tomato.deploy.mock.dynamics import ArmDynamics
from maniskill_tomato.deploy.mock.episode import TwinEpisode, load_episode
from maniskill_tomato.deploy.toml_tables import parse_table
from maniskill_tomato.errors import InvalidInputError, check_ranges
from maniskill_tomato.plants.episode_list import EPISODE_LISTS, episode_path
from maniskill_tomato.plants.organs import SemanticClass
from maniskill_tomato.raycast.images import FIRST_ORGAN_LABEL, Picture
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import CameraIntrinsics, T_flange_camera_color_optical, color_intrinsics
from maniskill_tomato.robot.iiwa14 import IIWA14, LINK_NAMES
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.look_at import carried_pose
from maniskill_tomato.robot.robot_description import link_meshes

ArmFault = Literal["silent", "slow", "nan", "jump", "drop", "stuck", "refuse"]
"""No answers; moves 20 times too slow; NaN positions; positions that jump; gone in the middle of a move; does not move;
commands refused."""

CameraFault = Literal["unplugged", "frozen", "late", "black", "zero_depth", "wrong_size", "silent"]
"""Gone; the same picture again; pictures 30 s old; black; no depth; another size than announced; no answers."""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What goes wrong, and when."""

    arm: ArmFault | None = None
    """The arm's fault."""
    arm_from_move: int = 0
    """From which command on, counted from 0."""
    camera: CameraFault | None = None
    """The camera's fault."""
    camera_from_read: int = 0
    """From which picture on, counted from 0."""
    camera_reads: int = 1_000_000
    """For how many pictures."""

    def __post_init__(self) -> None:
        check_ranges(self, arm_from_move=(0, math.inf), camera_from_read=(0, math.inf))
        check_ranges(self, camera_reads=(1, math.inf))


Renderer = Literal["rays", "sapien", "auto"]


@dataclass(frozen=True, kw_only=True)
class TwinOptions:
    """The `[twin]` table of a profile; the run's seed is the number of the episode."""

    episodes: str = "held_out"
    """Which list the plants come from: held_out, validation, or a `.json` file such as `benchmark --plants` writes."""
    plants: str | None = None
    """Mesh file or folder whose plants such a file names; None for our own."""
    model: str = IIWA14.name
    """Which arm MuJoCo moves: the name of a registered arm model (`drivers.arm_model`)."""
    width: int = 640
    """Of the colour picture, in [px]."""
    height: int = 480
    """Of the colour picture, in [px]."""
    depth_noise: float = 1.0
    """Standard deviation of depths in multiples of the D435's; 0 for exact depths."""
    renderer: Renderer = "rays"
    """Where colours come from: flat ones by ray casting, SAPIEN's, or SAPIEN's where Vulkan is there (`auto`)."""
    real_time: bool = False
    """Whether the arm takes the time that it really would."""
    faults: Faults = Faults()
    """What goes wrong."""

    def __post_init__(self) -> None:
        episode_path(self.episodes)
        if self.plants is not None and self.episodes in EPISODE_LISTS:
            raise InvalidInputError(
                f"plants needs a list of its own: set episodes to a .json file, which `benchmark --plants` writes, "
                f"instead of {self.episodes!r}"
            )
        check_ranges(self, depth_noise=(0.0, math.inf), width=(16, 1920), height=(16, 1080))


COLORS: Final = {
    SemanticClass.BACKGROUND: (178, 196, 204),
    SemanticClass.STEM: (112, 142, 70),
    SemanticClass.LEAF: (62, 112, 44),
    SemanticClass.FRUIT_RIPE: (204, 42, 28),
    SemanticClass.FRUIT_TURNING: (214, 138, 52),
    SemanticClass.FRUIT_GREEN: (148, 176, 88),
    SemanticClass.ROBOT: (206, 206, 208),
}
"""Flat colours, sRGB."""


class TwinWorld:
    """Arm, plant and time. The arm moves when somebody asks for the time."""

    def __init__(
        self, episode: TwinEpisode, intrinsics: CameraIntrinsics, clock: Clock, model: ArmModel = IIWA14
    ) -> None:
        """Puts everything in place.

        Args:
            episode: Which plant and start.
            intrinsics: The camera's.
            clock: Drives the arm.
            model: Of the arm.
        """
        self.model = model
        self.episode = episode
        self.intrinsics = intrinsics
        self.clock = clock
        self.arm = ArmDynamics(episode.start_joints, model)
        self._began = clock.now()
        # Rays call links by the names of the iiwa 14.
        meshes = dict(zip(LINK_NAMES, link_meshes(model).values(), strict=True))
        self.scene = RayScene([episode.plant], intrinsics, robot_meshes=meshes)
        self._mount = torch.tensor(T_flange_camera_color_optical, dtype=torch.float64)
        organs = [organ.semantic_class for organ in episode.plant.organs]
        classes = [SemanticClass.BACKGROUND, SemanticClass.ROBOT, *organs]
        self._palette = np.array([COLORS[c] for c in classes], dtype=np.float64)
        fruits = episode.plant.fruits
        self._target_label = FIRST_ORGAN_LABEL + fruits[episode.target].organ_index
        self._ripe = [j for j, fruit in enumerate(fruits) if fruit.ripeness == "ripe"]
        self._fruit_labels = tuple(FIRST_ORGAN_LABEL + fruit.organ_index for fruit in fruits)
        self._stem_labels = tuple(
            FIRST_ORGAN_LABEL + k for k, organ in enumerate(organs) if organ is SemanticClass.STEM
        )

    def advance(self) -> float:
        """Moves the arm on to the present; that time, in [s]."""
        now = self.clock.now()
        self.arm.advance(now - self._began)
        return now

    def camera_pose(self) -> Float64:
        """Pose of the optical frame now. Shape (4, 4)."""
        pose: Float64 = self._poses(self.arm.joint_positions)[0][0].double().numpy()
        return pose

    def picture(self) -> Picture:
        """What the camera sees now, exactly."""
        camera, links = self._poses(self.arm.joint_positions)
        return self.scene.picture(self.intrinsics, camera[0], self.episode.T_world_plant, links[0])

    def color(self, picture: Picture) -> NDArray[np.uint8]:
        """The picture in flat colours, darker where one looks along a surface. Shape (H, W, 3)."""
        return picture.coloured(self._palette)

    def truth(self, picture: Picture) -> FrameTruth:
        """What is in the picture, and what the simulated task would say about it."""
        camera, links = self._poses(self.arm.joint_positions)
        target = torch.tensor([self.episode.target])
        plant = self.episode.T_world_plant[None]
        seen = self.scene.visibility(camera, target, plant, links)
        known = self.episode.target_position
        rays = self.scene.view_rays(camera, target, known[None], plant, links)
        labels = picture.labels.copy()
        labels.setflags(write=False)
        return FrameTruth(
            labels=labels,
            target_label=self._target_label,
            target_position=known.double().numpy(),
            visible_fraction=float(seen.visible_fraction[0]),
            ripe_labels=tuple(self._fruit_labels[j] for j in self._ripe),
            rays=rays,
            fruit_labels=self._fruit_labels,
            stem_labels=self._stem_labels,
            ripe_fractions=self.visible_fractions(self._ripe, self.arm.joint_positions),
        )

    def visible_fractions(self, fruits: Sequence[int], joints: Float64) -> tuple[float, ...]:
        """V_f of some fruits by ray casting.

        Args:
            fruits: As indices in `Plant.fruits`.
            joints: Where the arm is, in [rad]. Shape (7,).
        """
        if not fruits:
            return ()
        camera, links = self._poses(joints)
        seen = self.scene.visible_fraction_from(
            camera.expand(len(fruits), 4, 4),
            torch.tensor(list(fruits)),
            self.episode.T_world_plant,
            links.expand(len(fruits), *links.shape[1:]),
        )
        return tuple(seen.tolist())

    def _poses(self, joints: Float64) -> tuple[Tensor, Tensor]:
        """Poses of the optical frame and of the links, in single precision as in the simulated task."""
        links = link_transforms(torch.tensor(joints[None], dtype=torch.float32), self.model)
        return carried_pose(links[:, -1], self._mount), links


def twin_options(options: Mapping[str, Any]) -> TwinOptions:
    """Checks the table.

    Raises:
        ProfileError: A key or a value is wrong.
    """
    return parse_table(TwinOptions, options, "twin")


def twin_world(options: TwinOptions, context: DriverContext) -> TwinWorld:
    """The world of a run, made when arm or camera asks first."""

    def make() -> TwinWorld:
        intrinsics, model = color_intrinsics(options.width, options.height), arm_model(options.model)
        episode = load_episode(options.episodes, context.seed, options.plants, model)
        return TwinWorld(episode, intrinsics, context.clock, model)

    return context.shared("twin", make)
