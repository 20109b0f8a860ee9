"""The twin's plant in a SAPIEN scene with a camera; the one module of `deploy` that loads ManiSkill."""

from typing import Any, Final

import numpy as np
import sapien
import sapien.render
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import parse_sim_and_render_backend
from mani_skill.render import PREBUILT_SHADER_CONFIGS, set_shader_pack
from numpy.typing import NDArray

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.rendering.plant_actors import build_plant_actors
from maniskill_tomato.robot.d435 import CAMERA_FAR, CAMERA_NEAR, R_CAMERA_OPTICAL, CameraIntrinsics

AMBIENT: Final = [0.55, 0.58, 0.60]
"""Diffuse light of a glasshouse."""


class SapienView:
    """Colour pictures of a plant."""

    def __init__(self, plant: Plant, T_world_plant: Float64, intrinsics: CameraIntrinsics) -> None:
        """Builds the scene.

        Args:
            plant: What is looked at.
            T_world_plant: Its pose. Shape (4, 4).
            intrinsics: The camera.

        Raises:
            RuntimeError: There is no Vulkan device.
        """
        backend = parse_sim_and_render_backend("cpu", "cpu")
        set_shader_pack(PREBUILT_SHADER_CONFIGS["default"])
        scene = sapien.Scene(
            [sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(backend.render_device)]
        )
        wrapped = ManiSkillScene([scene], device=torch.device("cpu"), backend=backend)
        pose = sapien.Pose(T_world_plant)
        for actor in build_plant_actors(wrapped, plant, scene_idxs=[0], pose=pose, name_prefix=""):
            entity: Any = actor._objs[0]
            entity.set_pose(pose)
        scene.set_ambient_light(AMBIENT)
        scene.add_directional_light([0.6, 0.45, -1.0], [1.9, 1.85, 1.7])
        camera = sapien.render.RenderCameraComponent(intrinsics.width, intrinsics.height)
        i = intrinsics
        camera.set_perspective_parameters(CAMERA_NEAR, CAMERA_FAR, i.fx, i.fy, i.cx, i.cy, 0.0)
        mount = sapien.Entity()
        mount.add_component(camera)
        scene.add_entity(mount)
        self._scene, self._camera = scene, camera

    def color(self, T_world_camera: Float64) -> NDArray[np.uint8]:
        """The picture from a pose of the optical frame, (4, 4). Shape (H, W, 3)."""
        T_world_frame = T_world_camera.copy()
        T_world_frame[:3, :3] = T_world_camera[:3, :3] @ R_CAMERA_OPTICAL.T
        self._camera.local_pose = sapien.Pose(T_world_frame)
        self._scene.update_render()
        self._camera.take_picture()
        picture: Any = self._camera.get_picture("Color")
        return np.asarray((np.clip(picture[..., :3], 0.0, 1.0) * 255).round(), dtype=np.uint8)
