"""The wrist cameras of N simulated environments: depth with the D435's faults, and masks or rendered colours."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from torch import Tensor

from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.raycast.images import (
    BACKGROUND_DEPTH,
    FIRST_ORGAN_LABEL,
    NOTHING_LABEL,
    ROBOT_LABEL,
    Picture,
)
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import DEPTH_MODE
from maniskill_tomato.robot.d435 import Calibration, CameraIntrinsics, color_intrinsics
from maniskill_tomato.robot.depth_noise import DepthNoise, measure_depth
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.segmenter import make_segmenter
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.perception_kinds import RENDERED, Perception
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.simulated_segmenter import SegmenterErrors, flat_colours, simulated_masks
from maniskill_tomato.sensing.visible_fraction.estimate import UInt8
from maniskill_tomato.sensing.visible_fraction.occlusion_models import make_occlusion_model

IMAGE_SIZE: Final = (320, 240)
"""Width and height of cast images, in [px]."""

RENDERED_SIZE: Final = (640, 480)
"""Width and height of rendered ones unless `sensor_configs` says otherwise, in [px]: the camera's own."""

_CATEGORIES: Final = {"ripe": "tomato_ripe", "turning": "tomato_turning", "green": "tomato_unripe"}


class SimulatedCamera:
    """Takes frames of N environments; the errors of each come from its own random numbers."""

    def __init__(
        self,
        scene: RayScene,
        *,
        intrinsics: CameraIntrinsics | None = None,
        noise: DepthNoise | None = None,
        picture: Callable[[int], UInt8] | None = None,
        errors: SegmenterErrors | None = None,
    ) -> None:
        """Prepares the images.

        Args:
            scene: The environments' plants and links.
            intrinsics: Of the images; `IMAGE_SIZE` of the colour camera if None.
            noise: Faults of the depth, the defaults if None.
            picture: Renders the colours of an environment by its index, shape (H, W, 3); if None there are none.
            errors: Of a simulated segmenter, whose pictures have flat colours; if None there is none.
        """
        self._errors = errors
        self._scene = scene
        self._intrinsics = intrinsics or color_intrinsics(*IMAGE_SIZE)
        self._noise = noise or DepthNoise()
        self._picture = picture
        self._generators = [np.random.default_rng(0) for _ in range(scene.num_envs)]

    def seed(self, env_index: int, seed: int) -> None:
        """Begins an environment's random numbers, from which all errors of an episode follow."""
        self._generators[env_index] = np.random.default_rng(seed)

    def take(
        self,
        T_world_camera: Tensor,
        T_world_plant: Tensor,
        links: Tensor,
        mask: Tensor | None = None,
    ) -> list[PosedFrame | None]:
        """Takes a frame in each environment, or in some.

        Args:
            T_world_camera: Poses of the optical frames. Shape (N, 4, 4).
            T_world_plant: Poses of the plants. Shape (N, 4, 4).
            links: World poses of the links. Shape (N, 9, 4, 4).
            mask: Which environments take one, all if None; the others get None. Shape (N,), bool.
        """
        frames: list[PosedFrame | None] = []
        for k, generator in enumerate(self._generators):
            if mask is not None and not bool(mask[k]):
                frames.append(None)
                continue
            cast = self._scene.picture(
                self._intrinsics, T_world_camera[k], T_world_plant[k], links[k], env_index=k
            )
            is_plant = cast.labels != NOTHING_LABEL
            exact = np.where(is_plant, np.minimum(cast.depth, BACKGROUND_DEPTH), BACKGROUND_DEPTH)
            depth = measure_depth(
                exact.astype(np.float64), self._intrinsics, self._noise, generator, stereo=DEPTH_MODE
            )
            fruits, numbers = true_fruits(cast, self._scene.plant(k))
            frame = PosedFrame(
                depth_m=depth.astype(np.float32),
                intrinsics=self._intrinsics,
                T_world_camera=T_world_camera[k].double().cpu().numpy(),
                rgb=None if self._picture is None else self._picture(k),
                robot_mask=cast.labels == ROBOT_LABEL,
                true_fruits=fruits,
                true_numbers=numbers,
            )
            if self._errors is not None:
                shown, pose = self._scene.plant(k).fruits, T_world_plant[k].double().cpu().numpy()
                told = simulated_masks(
                    frame,
                    {j: pose[:3, :3] @ shown[j].centre.astype(np.float64) + pose[:3, 3] for j in numbers},
                    {j: shown[j].radius for j in numbers},
                    generator,
                    self._errors,
                )
                frame = replace(frame, told_fruits=told, rgb=flat_colours(frame))
            frames.append(frame)
        return frames


def true_fruits(cast: Picture, plant: Plant) -> tuple[Instances, tuple[int, ...]]:
    """The fruits in a cast picture and their indices in `Plant.fruits`, ordered by these."""
    shown = set(np.unique(cast.labels).tolist())
    numbers = tuple(
        j for j, fruit in enumerate(plant.fruits) if fruit.organ_index + FIRST_ORGAN_LABEL in shown
    )
    labels = np.array([plant.fruits[j].organ_index + FIRST_ORGAN_LABEL for j in numbers], np.int32)
    categories = tuple(_CATEGORIES[plant.fruits[j].ripeness] for j in numbers)
    return Instances.from_masks(cast.labels[None] == labels[:, None, None], categories=categories), numbers


def make_camera(
    perception: Perception,
    scene: RayScene,
    intrinsics: CameraIntrinsics,
    picture: Callable[[int], UInt8],
    *,
    true_association: bool = False,
    calibration: Calibration = "nominal",
) -> tuple[SimulatedCamera, CameraPerception] | None:
    """The camera of a kind of perception and what measures its frames; None for ground truth.

    Args:
        perception: Which.
        scene: The environments' plants and links.
        intrinsics: Of rendered pictures.
        picture: Renders them, by the index of an environment.
        true_association: Whether no fruit is mistaken for another.
        calibration: Of the colour camera whose images are cast.
    """
    if perception == "ground_truth":
        return None
    segmenter = make_segmenter("light") if perception == "segmenter" else None
    model = None
    if perception in ("thesis_model", "improved_model"):
        model = make_occlusion_model(perception.removesuffix("_model"))
    detector = FruitDetector(segmenter, model)
    if perception in RENDERED:
        camera = SimulatedCamera(scene, intrinsics=intrinsics, picture=picture)
    else:
        camera = SimulatedCamera(
            scene,
            intrinsics=color_intrinsics(*IMAGE_SIZE, calibration),
            errors=SegmenterErrors() if perception == "simulated_segmenter" else None,
        )
    return camera, CameraPerception(
        scene.num_envs, detector, true_association=true_association, device=scene.device
    )
