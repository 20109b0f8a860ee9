"""Clearance between arm and plants, against trimesh and a plain loop."""

from functools import cache

import numpy as np
import pytest
import torch
import trimesh

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.raycast.scene import CLEARANCE_RANGE, PATH_SAMPLES, RayScene
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.iiwa14 import EE_LINK_NAME, LINK_NAMES, LINK_SPHERES
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.robot_description import link_meshes
from maniskill_tomato.robot.spheres import CAMERA_SPHERES, sphere_table
from maniskill_tomato.tasks.maniskill.iiwa14_agent import READY_QPOS

pytestmark = pytest.mark.usefixtures("backend")

PLANT_POSES = ((0.3, 0.1, 0.3), (0.4, -0.1, 0.0))


@cache
def plants() -> tuple[Plant, Plant]:
    return generate_plant("one_tomato", 1), generate_plant("full", 2)


def make() -> tuple[RayScene, torch.Tensor]:
    T = torch.eye(4).repeat(2, 1, 1)
    for k, (x, y, yaw) in enumerate(PLANT_POSES):
        c, s = np.cos(yaw), np.sin(yaw)
        T[k, :2, :2] = torch.tensor([[c, -s], [s, c]])
        T[k, :2, 3] = torch.tensor([x, y])
    return RayScene(plants(), color_intrinsics(160, 120)), T


def joints(rng: np.random.Generator) -> torch.Tensor:
    """Joint positions that reach into the plants, two of them."""
    return torch.as_tensor(READY_QPOS + rng.uniform(-0.5, 0.5, (2, 7)), dtype=torch.float32)


def slow_clearance(
    start: torch.Tensor, end: torch.Tensor, T_world_plant: torch.Tensor, plant: Plant
) -> float:
    """One path, sphere by sphere, with trimesh's exact distance to a triangle soup."""
    mesh = trimesh.Trimesh(plant.vertices, plant.faces, process=False)
    links, spheres = sphere_table()
    inverse = np.linalg.inv(T_world_plant.numpy().astype(np.float64))
    smallest = CLEARANCE_RANGE
    centres = []
    for k in range(1, PATH_SAMPLES + 1):
        qpos = start + (end - start) * k / PATH_SAMPLES
        poses = link_transforms(qpos.double()[None])[0].numpy()
        for link, sphere in zip(links, spheres, strict=True):
            centre = inverse @ poses[link] @ np.append(sphere[:3].astype(np.float64), 1.0)
            centres.append((*centre[:3], sphere[3]))
    table = np.array(centres)
    for chunk in np.array_split(table, 8):
        _, distance, _ = trimesh.proximity.closest_point_naive(mesh, chunk[:, :3])
        smallest = min(smallest, float((distance - chunk[:, 3]).min()))
    return smallest


def test_clearance_along_a_path_is_that_of_a_plain_loop() -> None:
    scene, T = make()
    rng = np.random.default_rng(0)
    found = []
    for _ in range(3):
        start, end = joints(rng), joints(rng)
        end = start + 0.2 * (end - start)
        clearance = scene.clearance_along(start, end, T)
        for k in range(2):
            expected = slow_clearance(start[k], end[k], T[k], plants()[k])
            assert float(clearance[k]) == pytest.approx(expected, abs=2e-5)
            found.append(expected)
    # Some paths go through leaves, some do not.
    assert min(found) < 0.0 < max(found)


def test_any_number_of_paths_can_be_held_against_one_plant() -> None:
    scene, T = make()
    rng = np.random.default_rng(1)
    start = torch.cat([joints(rng) for _ in range(4)])
    single = [scene.clearance_at(torch.stack([q, q]), T)[1] for q in start]
    together = scene.clearance_at(start, T[1].expand(8, 4, 4), torch.ones(8, dtype=torch.int64))
    for count in (5, 3, 7):
        some = scene.clearance_at(
            start[:count], T[1].expand(count, 4, 4), torch.ones(count, dtype=torch.int64)
        )
        torch.testing.assert_close(some, together[:count], atol=0.0, rtol=0.0)
    torch.testing.assert_close(together, torch.stack(single))
    back = scene.clearance_at(start[:2], T)
    torch.testing.assert_close(back[1], single[1])


def test_clearance_follows_a_replaced_plant() -> None:
    scene = RayScene(plants()[:1], color_intrinsics(160, 120))
    _, T = make()
    rng = np.random.default_rng(0)
    q = joints(rng)[:1]
    before = scene.clearance_at(q, T[1:])
    scene.replace_plants({0: plants()[1]})
    after = scene.clearance_at(q, T[1:])
    assert float(after[0]) == pytest.approx(slow_clearance(q[0], q[0], T[1], plants()[1]), abs=2e-5)
    assert not torch.equal(before, after)


@pytest.mark.parametrize("name", list(LINK_SPHERES))
def test_spheres_cover_their_link(name: str) -> None:
    vertices, faces = link_meshes()[name]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    samples = trimesh.sample.sample_surface(mesh, 4000, seed=0)[0]
    points = np.concatenate([vertices, samples])
    spheres = np.array([*LINK_SPHERES[name], *(CAMERA_SPHERES if name == EE_LINK_NAME else ())])
    outside = np.linalg.norm(points[:, None] - spheres[:, :3], axis=2) - spheres[:, 3]
    assert outside.min(axis=1).max() < 5e-4


def test_spheres_stay_near_the_arm() -> None:
    poses = link_transforms(torch.as_tensor(READY_QPOS)[None])[0].numpy()
    meshes = []
    for k, name in enumerate(LINK_NAMES[4:], start=4):
        vertices, faces = link_meshes()[name]
        placed = vertices @ poses[k, :3, :3].T + poses[k, :3, 3]
        meshes.append(trimesh.Trimesh(placed, faces, process=False))
    arm = trimesh.util.concatenate(meshes)
    links, spheres = sphere_table()
    centres = np.einsum("sij,sj->si", poses[links, :3, :3], spheres[:, :3]) + poses[links, :3, 3]
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(len(centres), 200, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    points = (centres[:, None] + spheres[:, 3][:, None, None] * directions).reshape(-1, 3)
    depth = np.linalg.norm(points[:, None] - centres, axis=2) - spheres[:, 3]
    points = points[(depth > -1e-6).all(axis=1)]
    points = points[rng.permutation(len(points))[:400]]
    distance = np.concatenate(
        [trimesh.proximity.closest_point_naive(arm, chunk)[1] for chunk in np.array_split(points, 8)]
    )
    assert distance.mean() < 0.01 and np.quantile(distance, 0.95) < 0.03


def test_wrong_shapes_are_refused() -> None:
    scene, T = make()
    q = torch.zeros(2, 7)
    with pytest.raises(InvalidInputError, match="end_qpos"):
        scene.clearance_along(q, q[:, :6], T)


def test_every_sphere_sits_on_a_link_that_exists() -> None:
    links, spheres = sphere_table()
    assert {LINK_NAMES[i] for i in links} == set(LINK_SPHERES)
    assert (spheres[:, 3] > 0.01).all()
