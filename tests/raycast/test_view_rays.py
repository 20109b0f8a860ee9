"""The pattern of rays against geometry worked out by hand and a plain ray tracer; many views against single ones."""

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor
from torch.testing import assert_close

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Fruit, MeshPart, Organ, Plant, SemanticClass
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import (
    NEAREST_DEPTH,
    PATTERN_HALF_WIDTH,
    RANGE,
    RAYS_PER_SIDE,
    RayLabel,
    ViewRays,
    ray_pattern,
)
from maniskill_tomato.raycast.warp_scene import VIEWS_AT_ONCE
from maniskill_tomato.robot.d435 import CameraIntrinsics, color_intrinsics
from maniskill_tomato.robot.iiwa14 import LINK_NAMES
from maniskill_tomato.robot.look_at import look_at_pose, look_frame
from maniskill_tomato.robot.robot_description import link_meshes

pytestmark = pytest.mark.usefixtures("backend")

RAYS = RAYS_PER_SIDE**2
RADIUS = 0.035
WIDE = CameraIntrinsics(width=640, height=480, fx=250.0, fy=250.0, cx=320.0, cy=240.0)
"""Wide enough for the whole pattern from 0.5 m."""


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


def part(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> MeshPart:
    return MeshPart(
        vertices=vertices.astype(np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (len(vertices), 1)),
        uvs=np.zeros((len(vertices), 2), np.float32),
        faces=faces.astype(np.int32),
        material="leaf",
    )


def ball_plant(centres: list[tuple[float, float, float]], leaf_x: float | None = None) -> Plant:
    """Ripe balls, and a leaf that fills x = leaf_x for y > 0."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    organs, fruits = [], []
    if leaf_x is not None:
        corners = np.array([(leaf_x, 0, -2), (leaf_x, 3, -2), (leaf_x, 3, 3), (leaf_x, 0, 3)], float)
        leaf = part(corners, np.array([(0, 1, 2), (0, 2, 3)]))
        organs.append(Organ("leaf_00", SemanticClass.LEAF, (leaf,)))
    for i, centre in enumerate(centres):
        ball = part(np.asarray(sphere.vertices) + centre, np.asarray(sphere.faces))
        fruits.append(Fruit(len(organs), np.array(centre, np.float32), RADIUS * 1.0001, "ripe"))
        organs.append(Organ(f"fruit_{i:02d}", SemanticClass.FRUIT_RIPE, (ball,)))
    return Plant("by hand", 0, "training", tuple(organs), tuple(fruits))


def look(
    plant: Plant,
    position: tuple[float, float, float],
    intrinsics: CameraIntrinsics = WIDE,
    device: str = "cpu",
    roll: float = 0.0,
    target: int = 0,
) -> ViewRays:
    """One view of a plant that stands at the origin, straight at a fruit."""
    centre = torch.from_numpy(plant.fruits[target].centre).to(device)
    pose = look_at_pose(torch.tensor(position, device=device), centre, roll)
    return RayScene([plant], intrinsics, device=device).view_rays(
        pose[None], torch.tensor([target], device=device), centre[None], torch.eye(4, device=device)[None]
    )


def test_the_pattern_is_symmetric_dense_in_the_middle_and_ends_at_the_square() -> None:
    pattern = ray_pattern().reshape(RAYS_PER_SIDE, RAYS_PER_SIDE, 2)
    assert np.all(np.diff(pattern[0, :, 0]) > 0) and np.all(np.diff(pattern[:, 0, 1]) < 0)
    np.testing.assert_allclose(pattern, -pattern[::-1, ::-1], atol=1e-7)
    steps = np.diff(pattern[0, :, 0])
    assert np.all(np.diff(steps[RAYS_PER_SIDE // 2 - 1 :]) > 0)
    assert 0.8 * PATTERN_HALF_WIDTH < pattern.max() < PATTERN_HALF_WIDTH


@pytest.mark.parametrize("roll", [0.0, 1.0, -2.5])
def test_rays_cross_the_targets_plane_at_the_pattern_whatever_the_roll(device: str, roll: float) -> None:
    plant = ball_plant([(0.8, 0.1, 0.9)])
    position, target = torch.tensor([0.3, -0.2, 1.2]), torch.tensor([0.8, 0.1, 0.9])
    rays = look(plant, (0.3, -0.2, 1.2), device=device, roll=roll)
    R = look_at_pose(position, target, roll)[:3, :3]
    direction_w = rays.direction_c[0].cpu() @ R.T
    frame = look_frame(position, target)
    away = (target - position).norm()
    crossing = position + direction_w * (away / (direction_w @ frame[:, 2]))[:, None] - target
    assert_close((crossing @ frame)[:, :2], torch.from_numpy(ray_pattern()), atol=1e-5, rtol=0)
    assert_close(rays.direction_c.norm(dim=-1), torch.ones(1, RAYS, device=device))


def test_labels_and_distances_of_a_ball_behind_half_a_leaf_are_those_worked_out_by_hand(device: str) -> None:
    # The camera faces +x, so that the leaf at y > 0 covers the left half.
    rays = look(ball_plant([(0.5, 0.0, 0.0)], leaf_x=0.3), (0.0, 0.0, 0.0), device=device)
    pattern = torch.from_numpy(ray_pattern())
    direction = torch.cat([torch.full((RAYS, 1), 0.5), -pattern[:, :1], pattern[:, 1:]], dim=-1)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    along = direction[:, 0] * 0.5
    inside = RADIUS**2 - (0.25 - along**2)
    expected = torch.full((RAYS,), int(RayLabel.FREE), dtype=torch.int8)
    expected[inside > 0] = int(RayLabel.TARGET)
    expected[direction[:, 1] > 0] = int(RayLabel.OTHER)
    assert_close(rays.label[0].cpu(), expected)
    distance = torch.full((RAYS,), RANGE)
    distance = torch.where(inside > 0, along - inside.clamp_min(0).sqrt(), distance)
    distance = torch.where(direction[:, 1] > 0, 0.3 / direction[:, 0], distance)
    # The ball is made of flat triangles.
    assert_close(rays.distance[0].cpu(), distance, atol=1e-3, rtol=0)
    for label in (RayLabel.FREE, RayLabel.TARGET, RayLabel.OTHER):
        assert int((rays.label == label).sum()) >= 6


def test_a_second_fruit_in_front_is_something_else() -> None:
    plant = ball_plant([(0.5, 0.0, 0.0), (0.35, 0.0, 0.0)])
    rays = look(plant, (0.0, 0.0, 0.0))
    assert int((rays.label == RayLabel.TARGET).sum()) == 0
    assert int((rays.label == RayLabel.OTHER).sum()) >= 6
    nearer = look(plant, (0.0, 0.0, 0.0), target=1)
    assert int((nearer.label == RayLabel.TARGET).sum()) >= 6


def test_rays_outside_the_image_have_no_answer() -> None:
    narrow = color_intrinsics()
    rays = look(ball_plant([(0.4, 0.0, 0.0)]), (0.0, 0.0, 0.0), intrinsics=narrow)
    x = rays.direction_c[0, :, 0] / rays.direction_c[0, :, 2]
    y = rays.direction_c[0, :, 1] / rays.direction_c[0, :, 2]
    u, v = narrow.fx * x + narrow.cx, narrow.fy * y + narrow.cy
    outside = (u < 0) | (u > narrow.width) | (v < 0) | (v > narrow.height)
    assert 20 < int(outside.sum()) < RAYS - 20
    assert_close(rays.label[0] == RayLabel.OUTSIDE, outside)
    assert bool((rays.distance[0][outside] == 0).all())


def test_what_is_nearer_than_the_camera_measures_has_no_answer() -> None:
    for leaf_x, label in ((NEAREST_DEPTH - 0.005, RayLabel.OUTSIDE), (NEAREST_DEPTH + 0.005, RayLabel.OTHER)):
        rays = look(ball_plant([(0.5, 0.0, 0.0)], leaf_x=leaf_x), (0.0, 0.0, 0.0))
        left = rays.label[0].view(RAYS_PER_SIDE, RAYS_PER_SIDE)[:, : RAYS_PER_SIDE // 2]
        assert bool((left == label).all())


def test_the_robots_links_leave_rays_without_an_answer(device: str) -> None:
    plant = ball_plant([(0.5, 0.0, 0.0)])
    cube = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    meshes = {"link_3": (np.asarray(cube.vertices), np.asarray(cube.faces))}
    scene = RayScene([plant], WIDE, robot_meshes=meshes, device=device)
    pose = look_at_pose(torch.zeros(1, 3, device=device), torch.tensor([[0.5, 0.0, 0.0]], device=device))
    links = torch.eye(4, device=device).repeat(1, len(LINK_NAMES), 1, 1)
    links[0, LINK_NAMES.index("link_3"), :3, 3] = torch.tensor([0.3, 0.05, 0.0], device=device)
    given = (
        pose,
        torch.zeros(1, device=device),
        torch.tensor([[0.5, 0, 0]], device=device),
        torch.eye(4, device=device)[None],
    )
    with_link = scene.view_rays(*given, links).label[0].cpu()
    without = scene.view_rays(*given).label[0].cpu()
    # The cube covers y from 0 to 0.1 and z from -0.05 to 0.05 at x = 0.25, and less behind.
    y, z = -ray_pattern()[:, 0] / 0.5, ray_pattern()[:, 1] / 0.5
    covered = torch.from_numpy((y > 0) & (y < 0.1 / 0.25) & (np.abs(z) < 0.05 / 0.25))
    assert int(covered.sum()) > 20
    assert_close(with_link == RayLabel.OUTSIDE, covered)
    assert_close(with_link[~covered], without[~covered])
    assert int((without == RayLabel.OUTSIDE).sum()) == 0
    links[0, LINK_NAMES.index("link_3"), 0, 3] = -0.3
    assert_close(scene.view_rays(*given, links).label[0].cpu(), without)


def test_turned_links_anywhere_near_the_pattern_cover_the_rays_that_meet_them(device: str) -> None:
    plant = ball_plant([(0.5, 0.0, 0.0)])
    half = np.array([0.01, 0.03, 0.09])
    rod = trimesh.creation.box(extents=2 * half)
    meshes = {"link_3": (np.asarray(rod.vertices), np.asarray(rod.faces))}
    scene = RayScene([plant], WIDE, robot_meshes=meshes, device=device)
    target = torch.tensor([[0.5, 0.0, 0.0]])
    pose = look_at_pose(torch.zeros(1, 3), target, 0.4)
    given = (
        pose.to(device),
        torch.zeros(1, device=device),
        target.to(device),
        torch.eye(4, device=device)[None],
    )
    seen = scene.view_rays(*given)
    free = seen.label[0].cpu().numpy() == RayLabel.FREE
    rays_w = seen.direction_c[0].cpu().double().numpy() @ pose[0, :3, :3].double().numpy().T
    rng = np.random.default_rng(0)
    covered = []
    for _ in range(60):
        # Many stand across the rim of the pattern, where x is depth; some beside or behind the camera.
        depth = rng.uniform(-0.3, 1.2)
        aside = rng.uniform(0.3, 1.0) * (abs(depth) * 0.56 * 2**0.5 + 0.1)
        angle = rng.uniform(-np.pi, np.pi)
        place = np.array([depth, aside * np.cos(angle), aside * np.sin(angle)])
        if np.linalg.norm(place) < 0.2:
            continue
        turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
        links = torch.eye(4).repeat(1, len(LINK_NAMES), 1, 1)
        links[0, LINK_NAMES.index("link_3"), :3, :3] = torch.from_numpy(turn)
        links[0, LINK_NAMES.index("link_3"), :3, 3] = torch.from_numpy(place)
        ray, start = rays_w @ turn, -place @ turn
        first, last = np.sort(np.stack([(-half - start) / ray, (half - start) / ray]), axis=0)
        enter, leave = first.max(axis=-1), last.min(axis=-1)
        is_clear = free & (np.abs(leave - enter) > 1e-3) & (np.abs(enter - RANGE) > 1e-3)
        expected = (enter < leave) & (leave > 0.0) & (enter < RANGE)
        label = scene.view_rays(*given, links.to(device)).label[0].cpu().numpy()
        np.testing.assert_array_equal((label == RayLabel.OUTSIDE)[is_clear], expected[is_clear])
        covered.append(int(expected[is_clear].sum()))
    assert len(covered) > 50 and 15 < np.count_nonzero(covered) < len(covered) - 10


def test_a_grown_plant_agrees_with_a_plain_loop_over_its_triangles() -> None:
    plant = generate_plant("full", 3, "training")
    target = next(i for i, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe")
    centre = plant.fruits[target].centre.astype(np.float64)
    for offset in ((-0.45, -0.2, 0.1), (-0.3, 0.25, -0.15)):
        position = centre + offset
        rays = look(plant, tuple(position.tolist()), intrinsics=WIDE, target=target)
        R = look_at_pose(torch.from_numpy(position), torch.from_numpy(centre))[:3, :3].numpy()
        chosen = np.arange(0, RAYS, 2)
        direction = rays.direction_c[0].numpy().astype(np.float64)[chosen] @ R.T
        hits, ray_of_hit, face = _first_hits(plant, position, direction)
        label = np.full(len(chosen), int(RayLabel.FREE))
        label[ray_of_hit] = np.where(
            plant.organ_of_face[face] == plant.fruits[target].organ_index,
            int(RayLabel.TARGET),
            int(RayLabel.OTHER),
        )
        distance = np.full(len(chosen), RANGE)
        distance[ray_of_hit] = hits
        np.testing.assert_array_equal(rays.label[0].numpy()[chosen], label)
        np.testing.assert_allclose(rays.distance[0].numpy()[chosen], distance, atol=1e-4)
        assert len(set(label.tolist())) >= 2


def _first_hits(
    plant: Plant, position: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Distance, ray and face of the first hit of each ray that has one within range (Moeller & Trumbore 1997)."""
    a, b, c = (plant.vertices[plant.faces[:, i]].astype(np.float64) for i in range(3))
    edge1, edge2, back = b - a, c - a, position - a
    q = np.cross(back, edge1)
    distances, rays, faces = [], [], []
    for i, d in enumerate(direction):
        p = np.cross(d, edge2)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / np.einsum("ij,ij->i", edge1, p)
            u = np.einsum("ij,ij->i", back, p) * scale
            v = (q @ d) * scale
            t = np.einsum("ij,ij->i", edge2, q) * scale
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0.01), t, np.inf)
        if t.min() < RANGE:
            distances.append(t.min())
            rays.append(i)
            faces.append(int(t.argmin()))
    return np.array(distances), np.array(rays), np.array(faces)


def test_a_new_plant_is_seen_also_when_it_has_more_fruits(device: str) -> None:
    one, two = ball_plant([(0.5, 0.0, 0.0)]), ball_plant([(0.5, 0.3, 0.0), (0.5, 0.0, 0.0)])
    scene = RayScene([one], WIDE, device=device)
    pose = look_at_pose(torch.zeros(1, 3, device=device), torch.tensor([[0.5, 0.0, 0.0]], device=device))
    there, plant_pose = torch.tensor([[0.5, 0.0, 0.0]], device=device), torch.eye(4, device=device)

    def targets_seen(index: int) -> int:
        view = scene.view_rays(pose, torch.tensor([index], device=device), there, plant_pose[None])
        return int((view.label == RayLabel.TARGET).sum())

    seen = targets_seen(0)
    assert seen >= 6 and float(scene.visible_fraction_from(pose, 0, plant_pose)) == 1.0
    scene.replace_plants({0: two})
    assert targets_seen(1) == seen and float(scene.visible_fraction_from(pose, 1, plant_pose)) == 1.0
    # This fruit lies 31 degrees to the left, in the image still, and the pattern ends before.
    assert targets_seen(0) == 0 and float(scene.visible_fraction_from(pose, 0, plant_pose)) == 1.0


def random_cameras(centre: Tensor, count: int) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    offset = 0.25 * torch.randn(count, 3, generator=generator) - torch.tensor([0.5, 0.0, 0.0])
    aside = 0.1 * torch.randn(count, 3, generator=generator)
    return look_at_pose(centre + offset, centre + aside)


def test_many_views_at_once_have_the_visible_fractions_of_single_views(device: str) -> None:
    plants = [generate_plant("three_tomatoes", seed, "training") for seed in (1, 2)]
    scene = RayScene(plants, color_intrinsics(), robot_meshes=link_meshes(), device=device)
    T_world_plant = torch.eye(4)
    T_world_plant[:3, 3] = torch.tensor([0.8, 0.1, 0.0])
    T_world_plant = T_world_plant.to(device)
    count = 2 * VIEWS_AT_ONCE + 76
    links = torch.eye(4).repeat(count, len(LINK_NAMES), 1, 1)
    links[..., :3, 3] = (
        torch.randn(count, len(LINK_NAMES), 3, generator=torch.Generator().manual_seed(1)) * 0.5
    )
    links = links.to(device)
    for env_index, target in ((0, 2), (1, 0)):
        centre = torch.from_numpy(plants[env_index].fruits[target].centre) + T_world_plant[:3, 3].cpu()
        cameras = random_cameras(centre, count).to(device)
        for given in (None, links):
            at_once = scene.visible_fraction_from(cameras, target, T_world_plant, given, env_idx=env_index)
            for k in (0, VIEWS_AT_ONCE - 1, VIEWS_AT_ONCE, count - 1):
                single = scene.visibility(
                    cameras[k : k + 1].expand(2, 4, 4),
                    torch.full((2,), target, device=device),
                    T_world_plant.expand(2, 4, 4),
                    None if given is None else given[k : k + 1].expand(2, -1, -1, -1),
                )
                assert float(at_once[k]) == float(single.visible_fraction[env_index])
            assert 0.05 < float(at_once.mean()) < 0.95
    assert scene.visible_fraction_from(cameras[:0], 0, T_world_plant).shape == (0,)


def test_views_of_several_environments_at_once_have_the_visible_fractions_of_each_alone(device: str) -> None:
    plants = [generate_plant("three_tomatoes", seed, "training") for seed in (1, 2)]
    scene = RayScene(plants, color_intrinsics(), device=device)
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, :3, 3] = torch.tensor([[0.8, 0.1, 0.0], [0.9, -0.2, 0.05]])
    centres = [
        torch.from_numpy(plants[env].fruits[fruit].centre) + poses[env, :3, 3]
        for env, fruit in ((0, 2), (1, 0))
    ]
    cameras = torch.cat([random_cameras(centre, 20) for centre in centres]).to(device)
    env_idx = torch.tensor([0, 1] * 20).sort().values.to(device)
    fruits = torch.where(env_idx == 0, 2, 0)
    mixed = torch.randperm(40, generator=torch.Generator().manual_seed(2)).to(device)
    poses = poses.to(device)
    seen = scene.visible_fraction_from(
        cameras[mixed], fruits[mixed], poses[env_idx[mixed]], env_idx=env_idx[mixed]
    )
    alone = torch.cat(
        [
            scene.visible_fraction_from(cameras[:20], 2, poses[0], env_idx=0),
            scene.visible_fraction_from(cameras[20:], 0, poses[1], env_idx=1),
        ]
    )
    assert torch.equal(seen, alone[mixed])
    assert 0.05 < float(seen.mean()) < 0.95


def test_environments_that_are_asked_about_get_the_same_answers_as_all(device: str) -> None:
    plants = [generate_plant("full", seed, "training") for seed in range(3)]
    scene = RayScene(plants, color_intrinsics(), device=device)
    targets = torch.tensor(
        [next(i for i, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe") for plant in plants],
        device=device,
    )
    centres = torch.stack(
        [torch.from_numpy(p.fruits[int(t)].centre) for p, t in zip(plants, targets, strict=True)]
    ).to(device)
    stand = torch.eye(4, device=device).expand(3, 4, 4)
    mask = torch.tensor([True, False, True], device=device)
    for shift in (0.0, 0.15):
        cameras = look_at_pose(centres + torch.tensor([-0.45, shift, 0.05], device=device), centres)
        few = scene.visibility(cameras, targets, stand, mask=mask).rows
        some = scene.view_rays(cameras, targets, centres, stand, mask=mask)
        every = scene.visibility(cameras, targets, stand).rows
        rays = scene.view_rays(cameras, targets, centres, stand)
        assert_close(few[:, mask], every[:, mask], rtol=0.0, atol=0.0)
        for found, expected in (
            (some.direction_c, rays.direction_c),
            (some.distance, rays.distance),
            (some.label, rays.label),
        ):
            assert torch.equal(found[mask], expected[mask])
    with pytest.raises(InvalidInputError, match=r"mask must have shape \(3,\), got \(2,\)"):
        scene.visibility(cameras, targets, stand, mask=mask[:2])


def test_views_that_do_not_exist_are_refused() -> None:
    scene = RayScene([ball_plant([(0.5, 0, 0)])], WIDE)
    pose = torch.eye(4)
    with pytest.raises(InvalidInputError, match=r"target_fruit must be from 0 to 0, got 1"):
        scene.visible_fraction_from(pose[None], 1, pose)
    with pytest.raises(InvalidInputError, match=r"env_idx must be from 0 to 0, got 2"):
        scene.visible_fraction_from(pose[None], 0, pose, env_idx=2)
    with pytest.raises(InvalidInputError, match=r"T_w_plant must have shape \(1, 4, 4\)"):
        scene.visible_fraction_from(pose[None], 0, pose.expand(2, 4, 4))
    with pytest.raises(InvalidInputError, match=r"target_fruit must have shape \(1,\)"):
        scene.visible_fraction_from(pose[None], torch.zeros(2, dtype=torch.int64), pose)
