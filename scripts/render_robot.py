"""Renders the pictures of the robot for the documentation: `python scripts/render_robot.py [--out FOLDER]`."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import sapien
import tyro

from maniskill_tomato.robot import description
from maniskill_tomato.tasks.maniskill import agent

SCALE = 2
"""Pictures are rendered this many times larger and averaged."""


@dataclass(frozen=True, kw_only=True)
class View:
    """A picture of the robot."""

    name: str
    """File name without its ending."""
    qpos_deg: tuple[float, ...]
    """Joint angles, in [degrees]."""
    eye: tuple[float, float, float]
    """Where the camera stands, in [m]."""
    target: tuple[float, float, float]
    """What it looks at, in [m]."""
    fov: float
    """Vertical field of view, in [rad]."""
    width: int
    """Width of the picture, in [px]."""
    height: int
    """Height of the picture, in [px]."""


VIEWS = (
    View(
        name="robot_home",
        qpos_deg=(0.0,) * 7,
        eye=(2.3, -2.1, 1.25),
        target=(0.0, 0.0, 0.66),
        fov=0.50,
        width=420,
        height=680,
    ),
    View(
        name="robot_ready",
        qpos_deg=tuple(np.rad2deg(agent.READY_QPOS).tolist()),
        eye=(1.75, 1.75, 1.15),
        target=(-0.02, 0.0, 0.53),
        fov=0.50,
        width=680,
        height=680,
    ),
    View(
        name="robot_camera",
        qpos_deg=(10.0, -30.0, 20.0, -95.0, 0.0, 40.0, 5.0),
        eye=(1.10, 0.42, 1.05),
        target=(0.22, 0.20, 0.86),
        fov=0.44,
        width=680,
        height=510,
    ),
)


def _look_at(eye: np.ndarray, target: np.ndarray) -> Any:
    forward = (target - eye) / np.linalg.norm(target - eye)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([forward, left, np.cross(forward, left)], axis=1)
    matrix[:3, 3] = eye
    return sapien.Pose(matrix)


def _scene() -> tuple[Any, Any]:
    """An empty studio with the robot in it."""
    scene: Any = sapien.Scene([sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem("cpu")])
    scene.set_ambient_light([0.32, 0.33, 0.35])
    scene.add_directional_light(
        [-0.6, -0.45, -1.0],
        [1.7, 1.65, 1.6],
        shadow=True,
        shadow_scale=2.0,
        shadow_near=-60.0,
        shadow_far=60.0,
        shadow_map_size=4096,
    )
    scene.add_directional_light([-0.8, -0.6, -0.3], [0.55, 0.6, 0.7])
    scene.add_directional_light([0.9, 0.2, -0.2], [0.5, 0.5, 0.5])
    floor = sapien.render.RenderMaterial(base_color=[0.33, 0.36, 0.35, 1.0])
    floor.roughness = 1.0
    scene.add_ground(0.0, render_material=floor, render_half_size=[30.0, 30.0])
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    return scene, loader.load(description.urdf_path())


def main(out: Path = Path("docs/images")) -> None:
    """Writes one PNG for each view.

    Args:
        out: Folder to write into.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    sapien.render.set_camera_shader_dir("default")
    scene, robot = _scene()
    out.mkdir(parents=True, exist_ok=True)
    for view in VIEWS:
        robot.set_qpos(np.deg2rad(view.qpos_deg).astype(np.float32))
        camera = scene.add_camera(view.name, view.width * SCALE, view.height * SCALE, view.fov, 0.01, 60.0)
        camera.entity.set_pose(_look_at(np.array(view.eye), np.array(view.target)))
        scene.update_render()
        camera.take_picture()
        picture = np.clip(camera.get_picture("Color")[..., :3], 0.0, 1.0)
        small = picture.reshape(view.height, SCALE, view.width, SCALE, 3).mean(axis=(1, 3))
        path = out / f"{view.name}.png"
        imageio.imwrite(path, np.round(255 * small).astype(np.uint8))
        logging.info("%s: %d kB", path, path.stat().st_size // 1000)


if __name__ == "__main__":
    tyro.cli(main)
