"""Surroundings of the row in a rendered scene: gutters, slabs, pipes, strings, walls, an arm."""

from collections.abc import Callable

import numpy as np
import sapien
import sapien.render
from numpy.random import Generator

from maniskill_tomato.assets import asset_path
from maniskill_tomato.rendering import surfaces
from maniskill_tomato.rendering.surfaces import tiled_box
from maniskill_tomato.segmentation.synthesis.appearance import SceneAppearance

AddBody = Callable[[list[sapien.render.RenderShape], sapien.Pose], sapien.Entity]
HALF_LENGTH = 4.0
"""Half of the row's length that is built, in [m]."""


def add_surroundings(add: AddBody, appearance: SceneAppearance, rng: Generator) -> None:
    """Adds everything that is neither plant nor robot.

    Args:
        add: Puts shapes into the scene at a pose.
        appearance: Which surroundings.
        rng: Their places and stains.
    """
    rows = [0.0] + [appearance.row_distance * k for k in (1, 2)] + [-appearance.row_distance]
    gutter, slab = (
        surfaces.dirty(appearance.paint, rng, dirt=float(rng.uniform(0, 0.6))),
        surfaces.printed(appearance.paint, rng),
    )
    wool, pipe = (
        surfaces.dirty((0.42, 0.36, 0.26), rng, dirt=0.6),
        surfaces.plain((0.8, 0.8, 0.78), roughness=0.4),
    )
    for x in rows:
        low = float(rng.uniform(-0.01, 0.01))
        add([tiled_box([0.14, HALF_LENGTH, 0.03], gutter)], sapien.Pose([x, 0, low - 0.21]))
        add([tiled_box([0.11, HALF_LENGTH, 0.04], slab)], sapien.Pose([x, 0, low - 0.14]))
        for k in np.arange(-7, 8):
            add([tiled_box([0.05, 0.05, 0.05], wool)], sapien.Pose([x, 0.5 * k, low - 0.05]))
        for side in (-0.25, 0.25):
            rail = sapien.render.RenderShapeCylinder(0.026, HALF_LENGTH, pipe)
            turned = sapien.Pose(
                [x + 0.5 * appearance.row_distance + side, 0, appearance.floor + 0.1], [0.7071, 0, 0, 0.7071]
            )
            add([rail], turned)
        if rng.random() < 0.5:
            wide = sapien.render.RenderShapeCylinder(0.05, HALF_LENGTH, gutter)
            add([wide], sapien.Pose([x + 0.25, 0, appearance.floor + 0.25], [0.7071, 0, 0, 0.7071]))
    ground = surfaces.dirty(appearance.floor_colour, rng, dirt=float(rng.uniform(0.1, 0.9)))
    add([tiled_box([5.0, 5.0, 0.01], ground)], sapien.Pose([0, 0, appearance.floor]))
    _add_strings(add, appearance, rng)
    _add_walls(add, appearance, rng)


def _add_strings(add: AddBody, appearance: SceneAppearance, rng: Generator) -> None:
    colours = ((0.95, 0.95, 0.92), (0.75, 0.72, 0.6), (0.12, 0.12, 0.12))
    for _ in range(appearance.strings):
        material = surfaces.plain(colours[int(rng.integers(3))])
        radius = float(rng.uniform(0.0008, 0.003))
        x, y = float(rng.normal(0.02, 0.12)), float(rng.uniform(-0.9, 0.9))
        lean = rng.normal(0, 0.08, 2)
        # A cylinder lies along x; this turns it up, and a little aside.
        axis = np.array([lean[0], lean[1], 1.0]) / np.sqrt(1 + lean @ lean)
        add(
            [sapien.render.RenderShapeCylinder(radius, 1.6, material)],
            sapien.Pose(_x_axis_to([x, y, 0.9], axis)),
        )


def _x_axis_to(
    position: list[float], axis: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    side = np.cross([0.0, 1.0, 0.0], axis)
    side /= np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([axis, np.cross(side, axis), side], 1)
    pose[:3, 3] = position
    return pose


def _add_walls(add: AddBody, appearance: SceneAppearance, rng: Generator) -> None:
    far = 5.0 if appearance.backdrop != "bright" else 2.2
    wall = (
        surfaces.far_greenery(appearance.wall, rng)
        if appearance.greenery
        else surfaces.glowing(appearance.wall)
    )
    dark = surfaces.plain((0.35, 0.36, 0.36))
    for sign in (1.0, -1.0):
        add([tiled_box([0.01, 6.0, 4.0], wall, 4.0)], sapien.Pose([sign * far, 0, 3.0]))
        add([tiled_box([6.0, 0.01, 4.0], wall, 4.0)], sapien.Pose([0, sign * 5.0, 3.0]))
        for y in np.arange(-4, 4.1, float(rng.uniform(0.8, 2.0))):
            add([tiled_box([0.02, 0.03, 4.0], dark)], sapien.Pose([sign * (far - 0.05), float(y), 3.0]))
    roof = surfaces.glowing((1.2 * appearance.wall[0], 1.2 * appearance.wall[1], 1.25 * appearance.wall[2]))
    add([tiled_box([6.0, 6.0, 0.01], roof)], sapien.Pose([0, 0, 4.0]))
    beam = surfaces.plain((0.7, 0.72, 0.72))
    for x in np.arange(-4, 4.1, 1.0):
        add([tiled_box([0.03, 6.0, 0.04], beam)], sapien.Pose([float(x), 0, 3.5]))


def add_arm(scene: sapien.Scene, rng: Generator) -> list[sapien.Entity]:
    """Adds an iiwa 14 with its camera somewhere beside the plants, in a random pose.

    Returns:
        Its links.
    """
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    arm = loader.load(str(asset_path("iiwa14/iiwa14.urdf")))
    side = float(rng.choice([-1.0, 1.0]))
    arm.set_root_pose(sapien.Pose([float(rng.uniform(-0.9, -0.5)), side * float(rng.uniform(0.1, 0.7)), 0.0]))
    limits = np.array(arm.get_qlimits())
    low, high = np.clip(limits[:, 0], -1.6, 1.6), np.clip(limits[:, 1], -1.6, 1.6)
    arm.set_qpos(rng.uniform(low, high).astype(np.float32))
    return [link.entity for link in arm.get_links()]
