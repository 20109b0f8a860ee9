"""The pattern read from painted images against what rays meet, and its errors against what was asked for."""

import math

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor
from torch.testing import assert_close

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import Fruit, MeshPart, Organ, Plant, SemanticClass
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import DEPTH_MODE, NEAREST_DEPTH, RANGE, RayLabel, ViewRays
from maniskill_tomato.robot.d435 import CameraIntrinsics, depth_noise_std
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.sensing.measurement import Measurement
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.view_pattern import disturb, sample_view

RADIUS = 0.035
WIDE = CameraIntrinsics(width=640, height=480, fx=250.0, fy=250.0, cx=320.0, cy=240.0)
"""Wide enough for the whole pattern from 0.5 m."""


def part(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> MeshPart:
    return MeshPart(
        vertices=vertices.astype(np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (len(vertices), 1)),
        uvs=np.zeros((len(vertices), 2), np.float32),
        faces=faces.astype(np.int32),
        material="leaf",
    )


def ball_behind_a_leaf() -> Plant:
    """A ripe ball at (0.5, 0, 0), and a leaf that fills x = 0.3 for y > 0."""
    corners = np.array([(0.3, 0, -2), (0.3, 3, -2), (0.3, 3, 3), (0.3, 0, 3)], float)
    leaf = part(corners, np.array([(0, 1, 2), (0, 2, 3)]))
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    ball = part(np.asarray(sphere.vertices) + (0.5, 0, 0), np.asarray(sphere.faces))
    organs = (
        Organ("leaf_00", SemanticClass.LEAF, (leaf,)),
        Organ("fruit_00", SemanticClass.FRUIT_RIPE, (ball,)),
    )
    fruit = Fruit(1, np.array((0.5, 0, 0), np.float32), RADIUS * 1.0001, "ripe")
    return Plant("by hand", 0, "training", organs, (fruit,))


def painted_view(roll: float) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Tensor]:
    """Depth and masks of a ball at (0.5, 0, 0) behind a leaf at x = 0.3, y > 0, painted pixel by pixel."""
    T_world_camera = look_at_pose(
        torch.zeros(3, dtype=torch.float64), torch.tensor([0.5, 0, 0], dtype=torch.float64), roll
    )
    direction = WIDE.ray_directions(WIDE.pixel_centres()) @ T_world_camera[:3, :3].numpy().T
    length = np.linalg.norm(direction, axis=-1)
    unit = direction / length[..., None]
    along = unit[..., 0] * 0.5
    inside = RADIUS**2 - (0.25 - along**2)
    target = inside > 0
    depth = np.where(target, (along - np.sqrt(np.maximum(inside, 0))) / length, 2.0)
    leaf = unit[..., 1] > 0
    depth = np.where(leaf, 0.3 / direction[..., 0], depth)
    return depth, target & ~leaf, leaf, T_world_camera


@pytest.mark.parametrize("roll", [0.0, 0.6])
def test_an_image_tells_what_the_rays_tell(roll: float) -> None:
    depth, target_mask, _, T_world_camera = painted_view(roll)
    sampled = sample_view(depth, target_mask, WIDE, T_world_camera, torch.tensor([0.5, 0.0, 0.0]))
    target = torch.tensor([[0.5, 0.0, 0.0]])
    pose = look_at_pose(torch.zeros(1, 3), target, roll)
    scene = RayScene([ball_behind_a_leaf()], WIDE)
    cast = scene.view_rays(pose, torch.tensor([0]), target, torch.eye(4)[None])
    assert_close(sampled.direction_c, cast.direction_c, atol=1e-5, rtol=0)
    equal = sampled.label == cast.label
    # A pixel is 2 mm wide here; the row of rays nearest to the ball's edge passes it by less.
    assert float(equal.float().mean()) > 0.98
    assert_close(sampled.distance[equal], cast.distance[equal], atol=4e-3, rtol=0)


def test_pixels_without_depth_and_the_robots_pixels_have_no_answer() -> None:
    depth, target_mask, leaf, T_world_camera = painted_view(0.0)
    target = torch.tensor([0.5, 0.0, 0.0])
    whole = sample_view(depth, target_mask, WIDE, T_world_camera, target)
    assert int((whole.label == RayLabel.OUTSIDE).sum()) == 0
    for nothing in (0.0, math.nan, math.inf, NEAREST_DEPTH - 0.01):
        holes = np.where(leaf, nothing, depth)
        rays = sample_view(holes, target_mask, WIDE, T_world_camera, target)
        lost = rays.label == RayLabel.OUTSIDE
        assert_close(lost, whole.label == RayLabel.OTHER)
        assert bool((rays.distance[lost] == 0).all())
    robot = sample_view(depth, target_mask, WIDE, T_world_camera, target, robot_mask=leaf)
    assert_close(robot.label == RayLabel.OUTSIDE, whole.label == RayLabel.OTHER)


def test_images_of_another_size_are_refused() -> None:
    depth, target_mask, _, T_world_camera = painted_view(0.0)
    with pytest.raises(InvalidInputError, match=r"target_mask must have the camera's shape \(480, 640\)"):
        sample_view(depth, target_mask[:-1], WIDE, T_world_camera, torch.zeros(3))
    with pytest.raises(InvalidInputError, match=r"target_position must have shape \(3,\)"):
        sample_view(depth, target_mask, WIDE, T_world_camera, torch.zeros(1, 3))


def test_disturbed_rays_err_as_often_and_as_far_as_asked() -> None:
    count = 200_000
    label = torch.arange(count).remainder(4).to(torch.int8)[None]
    distance = torch.where(label == RayLabel.FREE, RANGE, 0.8) * (label != RayLabel.OUTSIDE)
    direction = torch.tensor([0.6, 0.0, 0.8]).expand(1, count, 3)
    rays = ViewRays(direction, distance, label)
    generator = torch.Generator().manual_seed(0)

    same = disturb(rays, generator, depth_noise=0.0)
    assert_close(same.label, rays.label)
    assert_close(same.distance, rays.distance)

    noisy = disturb(rays, generator, depth_noise=2.0)
    assert_close(noisy.label, rays.label)
    hit = label >= RayLabel.TARGET
    assert_close(noisy.distance[~hit], rays.distance[~hit])
    # The noise of the depth 0.8 * 0.8 m, along the ray.
    wanted = 2.0 * float(depth_noise_std(0.64, DEPTH_MODE)) / 0.8
    error = noisy.distance[hit] - 0.8
    assert float(error.std()) == pytest.approx(wanted, rel=0.02)
    assert float(error.mean()) == pytest.approx(0.0, abs=wanted / 50)

    wrong = disturb(rays, generator, depth_noise=0.0, dropout=0.1, false_target=0.2, missed_target=0.3)
    lost = wrong.label == RayLabel.OUTSIDE
    for before, after, share in (
        (RayLabel.FREE, RayLabel.OUTSIDE, 0.1),
        (RayLabel.TARGET, RayLabel.OUTSIDE, 0.1),
        (RayLabel.OTHER, RayLabel.TARGET, 0.9 * 0.2),
        (RayLabel.TARGET, RayLabel.OTHER, 0.9 * 0.3),
    ):
        found = (wrong.label[label == before] == after).float().mean()
        assert float(found) == pytest.approx(share, abs=0.01)
    assert bool((wrong.distance[lost] == 0).all())
    with pytest.raises(InvalidInputError, match=r"dropout must lie in \[0, 1\], got 1.5"):
        disturb(rays, generator, dropout=1.5)


@pytest.mark.parametrize(("near", "label"), [(0.25, RayLabel.OTHER), (0.45, RayLabel.OUTSIDE)])
def test_rays_into_the_shadow_of_a_leaf_meet_what_is_behind_it_and_those_into_other_holes_nothing(
    near: float, label: RayLabel
) -> None:
    # A leaf to the left, a wall at 0.5 m, and between them 24 columns without depth. The shadow of a leaf at 0.25 m is
    # 250 x 0.065 x (1 / 0.25 - 1 / 0.5) = 32 px wide, that of one at 0.45 m 4 px.
    depth = np.full((WIDE.height, WIDE.width), 0.5, np.float32)
    depth[:, :320], depth[:, 320:344] = near, 0.0
    frame = PosedFrame(depth_m=depth, intrinsics=WIDE, T_world_camera=np.eye(4))
    rays = Measurement(frame=frame, fruits=()).rays(np.array([0.0, 0.0, 0.5]), None)
    column = WIDE.fx * rays.direction_c[0, :, 0] / rays.direction_c[0, :, 2] + WIDE.cx
    in_hole = (column > 321.0) & (column < 343.0)
    assert int(in_hole.sum()) > 16
    assert set(rays.label[0, in_hole].tolist()) == {int(label)}
