"""The robot's frames through `sensing`: what a picture tells about the target."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, Literal, Protocol

import numpy as np
import torch

from maniskill_tomato.deploy.deploy_errors import PerceptionError, ProfileError
from maniskill_tomato.deploy.interface import Float64, Frame, FrameTruth
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.raycast.images import ROBOT_LABEL
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.kinematics import forward_kinematics, link_transforms
from maniskill_tomato.robot.look_at import carried_pose
from maniskill_tomato.robot.rotations import FORWARD_RPY, matrix_to_rpy
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.segmentation.segmenter import Segmenter
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.fruit_map import FruitMap
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.image_observation import ImageSource, picture_images
from maniskill_tomato.sensing.inspection import STALE_AFTER
from maniskill_tomato.sensing.measurement import RIPE_CATEGORIES
from maniskill_tomato.sensing.observation import ObservationLayout, ViewpointObserver
from maniskill_tomato.sensing.posed_frame import PosedFrame

Sight = Literal["images", "rays"]
"""From masks and depth images, as on a robot; or from the twin's exact rays, as in the simulated task."""

TRUE_MASKS: Final = "ground_truth"
"""Name of the segmenter that takes the masks that only a simulated camera knows."""


UNRIPE_CATEGORY: Final = "tomato_unripe"
"""What fruits are called that only a simulated camera tells from ripe ones."""

PLACE_ERROR: Final = 0.01
"""Standard deviation of each coordinate of a target's position that a profile gives, in [m]."""

FULL_VISIBILITY: Final = 0.8
"""A fruit of which more is visible needs no better view, as in `TomatoViewpoint-v1`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sighting:
    """What one view told about the target."""

    rays: ViewRays
    """The pattern about the target, as the simulated task has it."""
    visible_fraction: float
    """V_f, 0 if the target is not seen."""
    sure_fraction: float
    """Lower bound of V_f, by which a run ends."""
    fraction_margin: float | None = None
    """How far off V_f may be, by the perception's own account; `sure_fraction` is V_f less this, and at least 0. None
    where V_f is exact, or nothing was measured."""
    mask: BinaryMask
    """Visible pixels of the target. Shape (H, W)."""
    fruits_seen: int
    """How many ripe fruits the picture shows."""
    target_position: Float64
    """Where the target is believed to be, world frame, in [m]. Shape (3,)."""
    recall: Callable[[ViewpointObserver], None] | None = None
    """Makes a memory of earlier views anew, if the target turned out to stand elsewhere."""
    has_target: bool = True
    """Whether there is a target; without one the robot looks for one about `target_position`."""
    is_new_target: bool = False
    """Whether the robot has just chosen it."""
    images: ImageSource | None = None
    """Delivers the picture as policies observe it."""

    @property
    def target_seen(self) -> bool:
        """Whether any of the target was seen."""
        return self.visible_fraction > 0.0


class Perception(Protocol):
    """Turns pictures into sightings of one target."""

    name: str
    """In reports."""

    def begin(self, target_position: Float64 | None) -> None:
        """Forgets all views.

        Args:
            target_position: Where the target is, world frame, in [m]; None to choose one that a picture shows.
                Shape (3,).
        """
        ...

    def warm_up(self, intrinsics: CameraIntrinsics) -> None:
        """Does what is slow the first time, before pictures of these intrinsics come; changes nothing else."""
        ...

    def look(self, frame: Frame, T_world_camera: Float64) -> Sighting:
        """What a picture tells.

        Args:
            frame: The picture.
            T_world_camera: Pose of the optical frame when it was taken. Shape (4, 4).

        Raises:
            PerceptionError: The picture cannot be used.
        """
        ...


class ImagePerception:
    """`sensing.CameraPerception` for one camera: masks, depth, the sphere model."""

    def __init__(self, segmenter_name: str, segmenter: Segmenter | None) -> None:
        """Wraps a segmenter.

        Args:
            segmenter_name: As profiles call it.
            segmenter: Finds fruits; None takes the masks that only a simulated camera knows.
        """
        self.name = f"images, masks from {segmenter_name}"
        self._knows_truth = segmenter is None
        self._detector = FruitDetector(segmenter)
        self.begin(None)

    def begin(self, target_position: Float64 | None) -> None:
        """Forgets all views; without a position the largest sure ripe fruit of a picture becomes the target, of those
        that it does not show fully if there are any.

        It is the first picture that shows one. When a target turns out not to be there, or views have long shown no
        more of it, another one is chosen, as with `target="any"` in the simulated task.
        """
        self._chooses = target_position is None
        self._perception = CameraPerception(1, self._detector)
        self._perception.begin(
            0,
            target_position,
            place_error=PLACE_ERROR,
            chooses=self._chooses,
            patience=STALE_AFTER,
            threshold=FULL_VISIBILITY,
        )

    def begin_row(self) -> CameraPerception:
        """Forgets all views and has no target; returns what the row's fruits are mapped with."""
        self._perception = CameraPerception(1, self._detector)
        self._chooses = False
        return self._perception

    def warm_up(self, intrinsics: CameraIntrinsics) -> None:
        """Has the segmenter look at a black picture."""
        if self._knows_truth:
            return
        size = (intrinsics.height, intrinsics.width)
        black = PosedFrame(
            depth_m=np.zeros(size, np.float32),
            intrinsics=intrinsics,
            T_world_camera=np.eye(4),
            rgb=np.zeros((*size, 3), np.uint8),
        )
        self._detector.measure(black)

    def look(self, frame: Frame, T_world_camera: Float64) -> Sighting:
        """The sighting by masks and depth; see `Perception`."""
        perception, before = self._perception, self._perception.target(0)
        moved = self.take(frame, T_world_camera)
        if self._chooses and perception.target(0) is None:
            moved |= perception.choose(0, 1.0)
        target, known = perception.target(0), None if before is None else self.map.current(before.number)
        is_new = self._chooses and target is not None and target.number != known
        return replace(self.sighting(moved), is_new_target=is_new)

    def take(self, frame: Frame, T_world_camera: Float64) -> bool:
        """Takes a picture into the map; whether the target turned out to stand elsewhere.

        Raises:
            PerceptionError: The picture cannot be used.
        """
        try:
            measured = self._detector.measure(self._posed(frame, T_world_camera), self.map.crop)
        except TomatoError as error:
            raise PerceptionError(f"the picture cannot be segmented: {error}") from error
        return self._perception.add(0, measured)

    def sighting(self, moved: bool) -> Sighting:
        """What the last picture that was taken in told of the target.

        Args:
            moved: Whether the memory of earlier views must be made anew.
        """
        perception = self._perception
        return Sighting(
            rays=perception.rays(),
            visible_fraction=float(perception.visible_fraction[0]),
            sure_fraction=float(perception.sure_fraction[0]),
            fraction_margin=float(perception.fraction_margin[0]),
            mask=perception.mask(0),
            fruits_seen=sum(fruit.is_ripe for fruit in perception.views(0)[-1].fruits),
            target_position=perception.position_w(0),
            recall=self._recall if moved else None,
            has_target=perception.target(0) is not None,
            images=perception.images,
        )

    @property
    def map(self) -> FruitMap:
        """The fruits that were seen since `begin`."""
        return self._perception.map(0)

    def _recall(self, observer: ViewpointObserver) -> None:
        self._perception.recall(observer, torch.zeros(1, dtype=torch.int64))

    def _posed(self, frame: Frame, T_world_camera: Float64) -> PosedFrame:
        robot_mask, fruits = None, None
        numbers: tuple[int, ...] = ()
        if frame.truth is not None:
            # With a segmenter only the twin's judgement of itself asks for these.
            fruits, numbers = _true_fruits(frame.truth)
            robot_mask = np.asarray(frame.truth.labels == ROBOT_LABEL) if self._knows_truth else None
        return PosedFrame(
            depth_m=frame.depth,
            intrinsics=frame.intrinsics,
            T_world_camera=T_world_camera,
            rgb=frame.color,
            robot_mask=robot_mask,
            true_fruits=fruits,
            true_numbers=numbers,
        )


def _true_fruits(truth: FrameTruth) -> tuple[Instances, tuple[int, ...]]:
    """The fruits in a picture and which they are, as far as the camera says."""
    shown = set(np.unique(truth.labels).tolist())
    ripe = [label for label in truth.ripe_labels if label in shown]
    others = [label for label in truth.fruit_labels if label in shown and label not in truth.ripe_labels]
    labels = np.array([*ripe, *others], truth.labels.dtype)
    categories = (RIPE_CATEGORIES[0],) * len(ripe) + (UNRIPE_CATEGORY,) * len(others)
    numbers = tuple(truth.fruit_labels.index(label) for label in labels) if truth.fruit_labels else ()
    return Instances.from_masks(truth.labels[None] == labels[:, None, None], categories=categories), numbers


class TruthPerception:
    """The twin's exact rays and V_f: the observations of the simulated task, number by number."""

    name = "rays, ground truth"

    def __init__(self) -> None:
        self._target: Float64 | None = None

    def begin(self, target_position: Float64 | None) -> None:
        self._target = target_position

    def warm_up(self, intrinsics: CameraIntrinsics) -> None:
        """Nothing: the picture comes with its truth."""

    def look(self, frame: Frame, T_world_camera: Float64) -> Sighting:
        truth = frame.truth
        if truth is None:
            raise PerceptionError(
                "perception.sight = 'rays' needs a simulated camera; use 'images' on hardware"
            )
        if self._target is None:
            self._target = truth.target_position
        return Sighting(
            rays=truth.rays,
            visible_fraction=truth.visible_fraction,
            sure_fraction=truth.visible_fraction,
            mask=np.asarray(truth.labels == truth.target_label),
            fruits_seen=sum(bool((truth.labels == label).any()) for label in truth.ripe_labels),
            target_position=self._target,
            images=partial(_true_images, frame, truth),
        )


def _true_images(frame: Frame, truth: FrameTruth, layout: ImageLayout) -> dict[str, torch.Tensor]:
    """A twin's picture with true roles, as the simulated task has it."""
    role = np.where(truth.labels > ROBOT_LABEL, int(Role.LEAF), int(Role.BACKGROUND)).astype(np.uint8)
    for labels, shown in (
        ((ROBOT_LABEL,), Role.ROBOT),
        (truth.stem_labels, Role.STEM),
        (truth.fruit_labels or truth.ripe_labels, Role.OTHER_FRUIT),
        ((truth.target_label,), Role.TARGET),
    ):
        role[np.isin(truth.labels, labels)] = int(shown)
    told = picture_images(frame.depth, role, frame.color, frame.intrinsics, layout)
    return {kind: torch.from_numpy(image)[None] for kind, image in told.items()}


def open_perception(sight: Sight, segmenter: str) -> Perception:
    """What a profile's `[perception]` asks for.

    Args:
        sight: How pictures are used.
        segmenter: `TRUE_MASKS`, or a segmenter's name or file of weights.

    Raises:
        ProfileError: The segmenter cannot be opened.
    """
    if sight == "rays":
        return TruthPerception()
    if segmenter == TRUE_MASKS:
        return ImagePerception(segmenter, None)
    try:
        module: Any = importlib.import_module("maniskill_tomato.segmentation.segmenter")
        module.SEGMENTERS.check_recorded(segmenter, "the profile", "")
        return ImagePerception(segmenter, module.make_segmenter(segmenter))
    except ImportError as error:
        raise ProfileError(
            f"perception.segmenter {segmenter!r} cannot be loaded ({error}); install maniskill-tomato[perception], or "
            f"use {TRUE_MASKS!r} with the mock profile"
        ) from error
    except TomatoError as error:
        raise ProfileError(f"perception.segmenter: {error}") from error


class RobotBelief:
    """What is known of one target, view after view, as `TomatoViewpoint-v1` takes them."""

    def __init__(
        self,
        T_flange_camera: Float64,
        max_moves: int,
        layout: ObservationLayout | None = None,
        model: ArmModel = IIWA14,
    ) -> None:
        """Begins without a view.

        Args:
            T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
            max_moves: Moves of an episode.
            layout: What the observation holds.
            model: Of the arm.
        """
        self._model = model
        self._mount = torch.as_tensor(np.array(T_flange_camera), dtype=torch.float64)
        self._observer = ViewpointObserver(1, layout=layout, max_moves=max_moves, model=model)
        self._rpy = torch.tensor([FORWARD_RPY])
        self._has_views = False

    def camera_pose(self, joint_positions: Float64) -> Float64:
        """Pose of the optical frame, in single precision as in the task. Shape (4, 4)."""
        pose: Float64 = self._poses(joint_positions)[1][0].double().numpy()
        return pose

    def camera_position(self, joint_positions: Float64) -> Float64:
        """Where a move begins, in the precision of the task's `pd_look_at`, world frame, in [m]. Shape (3,)."""
        joints = torch.tensor(joint_positions[None], dtype=torch.float32).double()
        pose = forward_kinematics(joints, self._model) @ self._mount
        position: Float64 = pose[0, :3, 3].numpy()
        return position

    def observe(self, joint_positions: Float64, sighting: Sighting, moves_left: int) -> Belief:
        """Takes a view into the memory; once for every view.

        Args:
            joint_positions: When the picture was taken, in [rad]. Shape (7,).
            sighting: What the picture told.
            moves_left: Moves until the run ends.
        """
        if sighting.recall is not None:
            sighting.recall(self._observer)
        elif not self._has_views:
            target = torch.as_tensor(sighting.target_position, dtype=torch.float32)[None]
            self._observer.begin(torch.zeros(1, dtype=torch.int64), target)
        self._has_views = True
        T_world_flange, T_world_camera = self._poses(joint_positions)
        self._rpy = matrix_to_rpy(T_world_flange[:, :3, :3], self._rpy)
        viewpoint = torch.cat([T_world_flange[:, :3, 3], self._rpy], dim=-1)
        self._observer.observe(
            viewpoint,
            T_world_camera,
            sighting.rays,
            torch.tensor([sighting.visible_fraction], dtype=torch.float32),
            torch.tensor([moves_left]),
            qpos=torch.as_tensor(np.array(joint_positions)[None], dtype=torch.float32),
        )
        return replace(self._observer.belief, images=sighting.images)

    def _poses(self, joint_positions: Float64) -> tuple[torch.Tensor, torch.Tensor]:
        joints = torch.as_tensor(np.array(joint_positions)[None], dtype=torch.float32)
        flange = link_transforms(joints, self._model)[:, -1]
        return flange, carried_pose(flange, self._mount)
