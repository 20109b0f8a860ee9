"""Embree and Warp beside each other and beside a plain loop over all triangles in double precision."""

from importlib import metadata

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Fruit, MeshPart, Organ, Plant, SemanticClass
from maniskill_tomato.raycast.embree import Backend, EmbreeMesh, choose_backend, load_embree
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import RANGE, RayLabel
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.iiwa14 import JOINT_LOWER, JOINT_UPPER
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.look_at import look_frame
from maniskill_tomato.robot.robot_description import link_meshes

Float = NDArray[np.float64]

DISTANCE_ERROR = 1e-5
"""Two searches in single precision meet the same triangle this near to each other, in [m]."""


def views(plant: Plant, count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Cameras from 5 mm to 0.8 m off fruits, every eighth inside one: poses, targets and their centres."""
    rng = np.random.default_rng(seed)
    targets = torch.from_numpy(rng.integers(len(plant.fruits), size=count))
    centres = torch.from_numpy(np.array([plant.fruits[int(k)].centre for k in targets], np.float32))
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    reach = np.where(np.arange(count) % 8 == 0, 0.01, rng.uniform(0.005, 0.8, count))
    places = centres + torch.from_numpy((away * reach[:, None]).astype(np.float32))
    poses = torch.eye(4).repeat(count, 1, 1)
    poses[:, :3, 3] = places
    beside = torch.from_numpy(rng.normal(0, 0.03, (count, 3))).float()
    frames = look_frame(places, centres + beside)
    # The optical frame: x right, y down, z forward.
    poses[:, :3, :3] = torch.stack([frames[..., 0], -frames[..., 1], frames[..., 2]], dim=-1)
    return poses, targets, centres


def both(plants: list[Plant], robot: bool = False, rays_per_side: int = 16) -> dict[Backend, RayScene]:
    meshes = link_meshes() if robot else None
    backends: tuple[Backend, ...] = ("embree", "warp")
    return {
        name: RayScene(
            plants, color_intrinsics(640, 480), robot_meshes=meshes, rays_per_side=rays_per_side, backend=name
        )
        for name in backends
    }


@pytest.mark.parametrize("preset", ["full", "varied"])
def test_both_libraries_see_the_same_of_real_plants(preset: str) -> None:
    count = 300
    plant = generate_plant(preset, 5)
    poses, targets, centres = views(plant, count, 0)
    links = link_transforms(
        torch.from_numpy(np.random.default_rng(1).uniform(JOINT_LOWER, JOINT_UPPER, (count, 7))).float()
    )
    stand = torch.eye(4).repeat(count, 1, 1)
    seen, rays = {}, {}
    for name, scene in both([plant] * count, robot=True).items():
        seen[name] = scene.visibility(poses, targets, stand, links)
        rays[name] = scene.view_rays(poses, targets, centres, stand, links)
    off = (seen["embree"].visible_fraction - seen["warp"].visible_fraction).abs()
    assert 0.2 < float((seen["warp"].visible_fraction > 0).float().mean()) < 0.98
    # A ray that grazes an edge may fall on either side of it: one of 256, in one view of a hundred.
    assert float(off.max()) <= 0.02 and float((off > 0).float().mean()) <= 0.01
    other = rays["embree"].label != rays["warp"].label
    assert float(other.float().mean()) < 1e-4
    apart = (rays["embree"].distance - rays["warp"].distance).abs()[~other]
    assert float((apart > DISTANCE_ERROR).float().mean()) < 1e-4
    assert set(rays["warp"].label.flatten().tolist()) == set(RayLabel)


def nearest(corners: Float, origin: Float, direction: Float) -> float:
    """Distance to the nearest of some triangles, by Moeller and Trumbore's formula; infinite without a hit."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, ac)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (ab * p).sum(-1)
        s = origin - a
        u = (s * p).sum(-1) * scale
        q = np.cross(s, ab)
        v = (q @ direction) * scale
        t = (ac * q).sum(-1) * scale
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0)
    return float(np.where(met, t, np.inf).min())


def test_distances_are_those_of_a_plain_loop_over_all_triangles(backend: Backend) -> None:
    count = 24
    plant = generate_plant("varied", 2)
    poses, targets, centres = views(plant, count, 3)
    scene = RayScene([plant] * count, color_intrinsics(640, 480), backend=backend)
    rays = scene.view_rays(poses, targets, centres, torch.eye(4).repeat(count, 1, 1))
    corners = plant.vertices[plant.faces].astype(np.float64)
    compared = 0
    for view in range(count):
        turn, place = poses[view, :3, :3].double().numpy(), poses[view, :3, 3].double().numpy()
        for ray in range(0, rays.label.shape[1], 9):
            if rays.label[view, ray] == int(RayLabel.OUTSIDE):
                continue
            direction_c = rays.direction_c[view, ray].double().numpy()
            direction = turn @ direction_c
            begin = 0.01 / direction_c[2]  # The near plane, in [m].
            truth = begin + nearest(corners, place + begin * direction, direction)
            assert float(rays.distance[view, ray]) == pytest.approx(min(truth, RANGE), abs=DISTANCE_ERROR)
            compared += 1
    assert compared > 200


def flat_part(vertices: Float, faces: list[tuple[int, int, int]]) -> MeshPart:
    return MeshPart(
        vertices=vertices.astype(np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (len(vertices), 1)),
        uvs=np.zeros((len(vertices), 2), np.float32),
        faces=np.array(faces, np.int32),
        material="leaf",
    )


def octahedron_plant(leaf: MeshPart) -> Plant:
    """A fruit of eight triangles 0.4 m ahead of the origin, and a leaf."""
    centre, radius = np.array([0.0, 0.0, 0.4]), 0.03
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * radius + centre
    faces = [(x, 1 + y, 2 + z) for x in (0, 3) for y in (0, 3) for z in (0, 3)]
    fruit = Organ("fruit", SemanticClass.FRUIT_RIPE, (flat_part(corners, faces),))
    organs = (Organ("leaf", SemanticClass.LEAF, (leaf,)), fruit)
    return Plant("octahedron", 0, "training", organs, (Fruit(1, centre, radius, "ripe"),))


def test_triangles_without_area_hide_nothing(backend: Backend) -> None:
    line = flat_part(np.array([[-0.1, 0.0, 0.2], [0.1, 0.0, 0.2], [0.1, 0.0, 0.2]]), [(0, 1, 2), (1, 1, 1)])
    sheet = np.array([[-0.1, -0.1, 0.2], [0.1, -0.1, 0.2], [0.1, 0.1, 0.2], [-0.1, 0.1, 0.2]])
    whole = flat_part(sheet, [(0, 1, 2), (0, 2, 3), (1, 1, 2)])
    for leaf, fraction in ((line, 1.0), (whole, 0.0)):
        scene = RayScene([octahedron_plant(leaf)], color_intrinsics(640, 480), backend=backend)
        seen = scene.visibility(torch.eye(4)[None], torch.tensor([0]), torch.eye(4)[None])
        assert float(seen.visible_fraction[0]) == fraction


def test_no_ray_slips_between_the_triangles_of_a_sheet(backend: Backend) -> None:
    side = np.linspace(-0.1, 0.1, 41)
    x, y = np.meshgrid(side, side)
    corners = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.2)], axis=1)
    quads = [
        (i * 41 + j, i * 41 + j + 1, i * 41 + j + 42, i * 41 + j + 41) for i in range(40) for j in range(40)
    ]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    plant = octahedron_plant(flat_part(corners, faces))
    scene = RayScene([plant] * 50, color_intrinsics(640, 480), rays_per_side=64, backend=backend)
    poses = torch.eye(4).repeat(50, 1, 1)
    poses[:, :2, 3] = torch.from_numpy(np.random.default_rng(0).uniform(-0.02, 0.02, (50, 2))).float()
    poses[0, :2, 3] = 0.0  # Rays along the sheet's edges and through its corners.
    seen = scene.visibility(poses, torch.zeros(50, dtype=torch.int64), torch.eye(4).repeat(50, 1, 1))
    assert float(seen.visible_fraction.max()) == 0.0


def test_answers_are_the_same_bits_in_every_run_and_batch(backend: Backend) -> None:
    plants = [generate_plant("varied", seed) for seed in (1, 2, 3)]
    poses, targets, _ = views(plants[0], 3, 4)
    targets = targets % min(len(plant.fruits) for plant in plants)
    stand = torch.eye(4).repeat(3, 1, 1)
    first = RayScene(plants, color_intrinsics(640, 480), backend=backend)
    rows = first.visibility(poses, targets, stand).rows
    rays = first.view_rays(poses, targets, poses[:, :3, 3], stand)
    assert torch.equal(first.visibility(poses, targets, stand).rows, rows)
    for env, plant in enumerate(plants):
        alone = RayScene([plant], color_intrinsics(640, 480), backend=backend)
        one = slice(env, env + 1)
        again = alone.view_rays(poses[one], targets[one], poses[one, :3, 3], stand[one])
        assert torch.equal(alone.visibility(poses[one], targets[one], stand[one]).rows, rows[:, one])
        assert torch.equal(again.distance, rays.distance[one])


def test_a_clearance_is_the_same_whatever_traces_the_rays() -> None:
    plants = [generate_plant("varied", seed) for seed in (1, 2)]
    start = torch.tensor([[0.0, 0.6, 0.0, -1.2, 0.0, 0.9, 0.0]]).repeat(2, 1)
    stand = torch.eye(4).repeat(2, 1, 1)
    stand[:, 0, 3] = torch.tensor([0.55, 0.6])
    scenes = both(plants)
    told = [scene.clearance_along(start, start + 0.1, stand) for scene in scenes.values()]
    assert torch.equal(told[0], told[1])
    for scene in scenes.values():
        scene.replace_plants({0: plants[1]})
    told = [scene.clearance_along(start, start + 0.1, stand) for scene in scenes.values()]
    assert torch.equal(told[0], told[1])


def test_a_processor_takes_embree_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    here = torch.device("cpu")
    assert choose_backend(here, None) == "embree" and choose_backend(here, "warp") == "warp"
    assert choose_backend(torch.device("cuda"), None) == "warp"

    def missing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    load_embree.cache_clear()
    monkeypatch.setattr(metadata, "files", missing)
    assert choose_backend(here, None) == "warp"
    with pytest.raises(InvalidInputError, match="needs the package embreex.*choose 'warp'"):
        choose_backend(here, "embree")
    with pytest.raises(InvalidInputError, match="embreex"):
        EmbreeMesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    load_embree.cache_clear()


def test_a_backend_that_is_not_to_be_had_is_refused_with_a_reason() -> None:
    with pytest.raises(InvalidInputError, match="backend='embree' needs a CPU"):
        choose_backend(torch.device("cuda"), "embree")
    with pytest.raises(InvalidInputError, match="backend.*'optix'"):
        choose_backend(torch.device("cpu"), "optix")  # type: ignore[arg-type]
