"""The visible fraction against values worked out by hand, and against a plain loop over all triangles."""

import gc
import math
import weakref

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Fruit, MeshPart, Organ, Plant, Ripeness, SemanticClass
from maniskill_tomato.plants.plant_store import PLANT_STORE
from maniskill_tomato.raycast.embree import Backend
from maniskill_tomato.raycast.meshes import LinkTriangles, PlantMeshes
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.visibility import Visibility
from maniskill_tomato.robot.d435 import (
    CAMERA_NEAR,
    CameraIntrinsics,
    T_flange_camera_color_optical,
    color_intrinsics,
)
from maniskill_tomato.robot.iiwa14 import LINK_NAMES
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.robot_description import link_meshes

pytestmark = pytest.mark.usefixtures("backend")

Float = NDArray[np.float64]
FRUIT_CLASS: dict[Ripeness, SemanticClass] = {
    "ripe": SemanticClass.FRUIT_RIPE,
    "turning": SemanticClass.FRUIT_TURNING,
    "green": SemanticClass.FRUIT_GREEN,
}
CAMERA = CameraIntrinsics(width=640, height=480, fx=600.0, fy=600.0, cx=320.0, cy=240.0)
RADIUS = 0.035


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


def part(vertices: Float, faces: NDArray[np.int64]) -> MeshPart:
    return MeshPart(
        vertices=vertices.astype(np.float32),
        normals=np.tile(np.array([0, 0, 1], np.float32), (len(vertices), 1)),
        uvs=np.zeros((len(vertices), 2), np.float32),
        faces=faces.astype(np.int32),
        material="leaf",
    )


def ball(centre: Float, radius: float, columns: int, rows: int) -> MeshPart:
    """A closed sphere of quads with poles, wound outwards."""
    polar = np.linspace(0, np.pi, rows + 1)[:, None]
    around = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None]
    x, y = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)
    z = np.broadcast_to(np.cos(polar), x.shape)
    faces = []
    for i in range(rows):
        for j in range(columns):
            a, b = i * columns + j, i * columns + (j + 1) % columns
            c, d = a + columns, b + columns
            faces += [(a, c, d), (a, d, b)]
    return part(np.stack([x, y, z], -1).reshape(-1, 3) * radius + centre, np.array(faces))


def quad(*corners: tuple[float, float, float]) -> MeshPart:
    return part(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)]))


def make_plant(
    fruits: list[tuple[Float, Ripeness]],
    leaves: list[MeshPart] | None = None,
    radius: float = RADIUS,
    columns: int = 48,
) -> Plant:
    organs = [Organ(f"leaf_{i}", SemanticClass.LEAF, (leaf,)) for i, leaf in enumerate(leaves or [])]
    described = []
    for i, (centre, ripeness) in enumerate(fruits):
        described.append(Fruit(len(organs), centre.astype(np.float32), radius * 1.0001, ripeness))
        organs.append(
            Organ(f"fruit_{i}", FRUIT_CLASS[ripeness], (ball(centre, radius, columns, columns // 2),))
        )
    return Plant("made", 0, "training", tuple(organs), tuple(described))


def ahead(x: float = 0.0, y: float = 0.0, z: float = 0.5) -> Float:
    """A place in the optical frame, which is the world's in most tests here."""
    return np.array([x, y, z])


def look(
    plant: Plant,
    intrinsics: CameraIntrinsics = CAMERA,
    target: int = 0,
    device: str = "cpu",
    rays_per_side: int = 16,
) -> Visibility:
    """Looks along z from the origin of a plant frame that is the optical frame."""
    scene = RayScene([plant], intrinsics, rays_per_side=rays_per_side, device=device)
    eye = torch.eye(4, device=device)[None]
    return scene.visibility(eye, torch.tensor([target], device=device), eye)


def test_a_free_fruit_is_fully_visible_and_as_large_as_a_sphere_projects(device: str) -> None:
    seen = look(make_plant([(ahead(), "ripe")]), device=device)
    area = math.pi * RADIUS**2 / (0.5**2 - RADIUS**2) * 600**2
    assert seen.visible_fraction.tolist() == [1.0]
    assert seen.total.item() == pytest.approx(area, rel=0.02)
    assert seen.visible.item() == seen.total.item()
    assert seen.any_visible.tolist() == [True]


def test_half_a_fruit_behind_a_straight_leaf_edge_is_half_visible(device: str) -> None:
    leaf = quad((0.0, -1, 0.3), (1, -1, 0.3), (1, 1, 0.3), (0.0, 1, 0.3))
    seen = look(make_plant([(ahead(), "ripe")], [leaf]), device=device)
    assert seen.visible_fraction.item() == pytest.approx(0.5, abs=0.01)


def test_a_quarter_of_the_height_hidden_leaves_the_disc_without_its_segment() -> None:
    # The leaf's edge projects to half the silhouette's radius below its centre: it hides the segment of a disc
    # beyond 60 degrees to either side, (pi/3 - sqrt(3)/4) / pi of the area.
    edge = 0.5 * RADIUS / math.sqrt(0.5**2 - RADIUS**2) * 0.3
    leaf = quad((-1, edge, 0.3), (1, edge, 0.3), (1, 1, 0.3), (-1, 1, 0.3))
    seen = look(make_plant([(ahead(), "ripe")], [leaf]))
    assert seen.visible_fraction.item() == pytest.approx(
        1 - (math.pi / 3 - math.sqrt(3) / 4) / math.pi, abs=0.015
    )


def test_a_fruit_behind_a_leaf_is_not_visible(device: str) -> None:
    leaf = quad((-1, -1, 0.3), (1, -1, 0.3), (1, 1, 0.3), (-1, 1, 0.3))
    seen = look(make_plant([(ahead(), "ripe")], [leaf]), device=device)
    assert seen.visible_fraction.tolist() == [0.0]
    assert seen.any_visible.tolist() == [False]


def test_a_leaf_hides_from_its_back_as_well() -> None:
    leaf = quad((-1, 1, 0.3), (1, 1, 0.3), (1, -1, 0.3), (-1, -1, 0.3))
    assert look(make_plant([(ahead(), "ripe")], [leaf])).visible_fraction.item() == 0.0


def test_a_leaf_behind_the_fruit_hides_nothing() -> None:
    leaf = quad((-1, -1, 0.6), (1, -1, 0.6), (1, 1, 0.6), (-1, 1, 0.6))
    assert look(make_plant([(ahead(), "ripe")], [leaf])).visible_fraction.item() == 1.0


@pytest.mark.parametrize(("depth", "expected"), [(CAMERA_NEAR * 0.9, 1.0), (CAMERA_NEAR * 1.1, 0.0)])
def test_what_is_nearer_than_the_near_plane_hides_nothing(depth: float, expected: float) -> None:
    leaf = quad((-1, -1, depth), (1, -1, depth), (1, 1, depth), (-1, 1, depth))
    assert look(make_plant([(ahead(), "ripe")], [leaf])).visible_fraction.item() == expected


def test_another_fruit_in_front_hides(device: str) -> None:
    # Both lie on the optical axis, and the near one looks larger.
    plant = make_plant([(ahead(), "ripe"), (ahead(z=0.3), "green")], radius=RADIUS)
    seen = look(plant, device=device)
    assert seen.visible_fraction.item() == 0.0


@pytest.mark.parametrize(
    "camera",
    [
        CameraIntrinsics(width=640, height=480, fx=600.0, fy=600.0, cx=0.0, cy=240.0),
        CameraIntrinsics(width=640, height=480, fx=600.0, fy=600.0, cx=640.0, cy=240.0),
        CameraIntrinsics(width=640, height=480, fx=600.0, fy=600.0, cx=320.0, cy=0.0),
        CameraIntrinsics(width=640, height=480, fx=600.0, fy=600.0, cx=320.0, cy=480.0),
    ],
)
def test_the_part_outside_the_image_counts_as_hidden(camera: CameraIntrinsics, device: str) -> None:
    # The optical axis meets the image's edge, so the edge cuts a fruit on the axis in two.
    seen = look(make_plant([(ahead(), "ripe")]), camera, device=device)
    assert seen.visible_fraction.item() == pytest.approx(0.5, abs=0.01)
    assert seen.total.item() == pytest.approx(look(make_plant([(ahead(), "ripe")])).total.item())


@pytest.mark.parametrize("angle", [0.3, 0.8, 1.1])
def test_off_the_axis_the_silhouette_is_the_ellipse_of_the_tangent_cone(angle: float) -> None:
    # The cone of half-angle alpha about a direction at `angle` off the axis cuts the image plane in an ellipse with
    # the semi-axes below.
    alpha = math.asin(RADIUS / 0.5)
    across = (math.tan(angle + alpha) - math.tan(angle - alpha)) / 2
    along = math.sin(alpha) / math.sqrt(math.cos(alpha) ** 2 - math.sin(angle) ** 2)
    wide = CameraIntrinsics(width=6000, height=480, fx=600.0, fy=600.0, cx=3000.0, cy=240.0)
    centre = ahead(0.5 * math.sin(angle), 0.0, 0.5 * math.cos(angle))
    seen = look(make_plant([(centre, "ripe")]), wide)
    assert seen.visible_fraction.item() == 1.0
    assert seen.total.item() == pytest.approx(math.pi * across * along * 600**2, rel=0.02)


@pytest.mark.parametrize(
    "centre",
    [
        ahead(z=-0.5),
        ahead(x=0.5, z=-0.01),
        ahead(x=0.045, z=0.0),
        ahead(x=1.0, z=0.1),
        ahead(z=0.02),
        ahead(z=0.0),
        ahead(z=1000.0, x=5000.0),
    ],
)
def test_without_a_silhouette_in_the_image_nothing_is_seen_and_the_total_is_finite(centre: Float) -> None:
    seen = look(make_plant([(centre, "ripe")]))
    assert seen.visible_fraction.tolist() == [0.0]
    assert seen.visible.tolist() == [0.0]
    assert seen.any_visible.tolist() == [False]
    assert math.isfinite(seen.total.item()) and seen.total.item() > 0


def test_very_near_the_fruit_only_what_fits_into_the_image_is_visible() -> None:
    # At 41 mm from its centre the fruit is a disc of tangent radius 1.64: the image covers 1.07 x 0.8 of its area.
    seen = look(make_plant([(ahead(z=0.041), "ripe")]), rays_per_side=64)
    area = math.pi * RADIUS**2 / (0.041**2 - RADIUS**2)
    assert seen.visible_fraction.item() == pytest.approx((640 / 600) * (480 / 600) / area, rel=0.05)


def test_each_environment_sees_its_own_plant(device: str) -> None:
    leaf = quad((0.0, -1, 0.3), (1, -1, 0.3), (1, 1, 0.3), (0.0, 1, 0.3))
    first = make_plant([(ahead(x=3.0), "ripe"), (ahead(), "ripe")], [leaf])
    second = make_plant([(ahead(), "ripe")])
    scene = RayScene([first, second, first], CAMERA, device=device)
    eye = torch.eye(4, device=device).repeat(3, 1, 1)
    seen = scene.visibility(eye, torch.tensor([1, 0, 0], device=device), eye)
    assert seen.visible_fraction.tolist() == pytest.approx([0.5, 1.0, 0.0], abs=0.01)
    # In the third environment the target lies outside the image, but another ripe fruit is half visible.
    assert seen.any_visible.tolist() == [True, True, True]


def random_pose(rng: np.random.Generator) -> Float:
    pose = np.eye(4)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose[:3, :3] = q * np.linalg.det(q)
    pose[:3, 3] = rng.normal(size=3)
    return pose


def test_only_the_camera_s_pose_relative_to_the_plant_matters(device: str) -> None:
    rng = np.random.default_rng(5)
    leaf = quad((0.0, -1, 0.3), (1, -1, 0.3), (1, 1, 0.3), (0.0, 1, 0.3))
    scene = RayScene([make_plant([(ahead(x=0.01), "ripe")], [leaf])] * 8, CAMERA, device=device)
    moved = torch.tensor(np.stack([np.eye(4), *(random_pose(rng) for _ in range(7))]), device=device)
    seen = scene.visibility(moved, torch.zeros(8, dtype=torch.int64, device=device), moved)
    assert seen.visible_fraction[0].item() < 0.5
    torch.testing.assert_close(seen.visible_fraction, seen.visible_fraction[:1].expand(8), atol=0.01, rtol=0)


@pytest.mark.parametrize(
    ("fruits", "expected"),
    [
        ([(ahead(), "ripe"), (ahead(x=-0.1), "ripe")], True),
        ([(ahead(), "ripe"), (ahead(x=-0.1), "green")], False),
        ([(ahead(), "ripe"), (ahead(x=-0.1), "turning")], False),
        ([(ahead(), "ripe"), (ahead(x=0.1), "ripe")], False),
        ([(ahead(), "ripe"), (ahead(x=-2), "ripe"), (ahead(z=-1), "ripe")], False),
        ([(ahead(), "ripe"), (ahead(x=0.1), "ripe"), (ahead(x=-0.1), "ripe")], True),
    ],
)
def test_any_visible_asks_for_another_ripe_fruit_when_the_target_is_hidden(
    fruits: list[tuple[Float, Ripeness]], expected: bool, device: str
) -> None:
    # The leaf hides everything right of 40 mm left of the axis.
    leaf = quad((-0.04, -1, 0.3), (1, -1, 0.3), (1, 1, 0.3), (-0.04, 1, 0.3))
    seen = look(make_plant(fruits, [leaf]), device=device)
    assert seen.visible_fraction.tolist() == [0.0]
    assert seen.any_visible.tolist() == [expected]


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> tuple[Float, NDArray[np.int64]]:
    corners = np.array([[(low, high)[(k >> a) & 1][a] for a in range(3)] for k in range(8)], dtype=np.float64)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])


def link_poses(**where: tuple[float, float, float]) -> torch.Tensor:
    poses = torch.eye(4).repeat(1, len(LINK_NAMES), 1, 1)
    poses[:, :, :3, 3] = torch.tensor([0.0, 0.0, -5.0])
    for name, position in where.items():
        poses[0, LINK_NAMES.index(name), :3, 3] = torch.tensor(position)
    return poses


def test_a_robot_link_in_the_way_hides_and_without_link_poses_it_does_not(device: str) -> None:
    arm: LinkTriangles = {
        "link_3": box((-1.0, -1.0, -0.05), (0.0, 1.0, 0.05)),
        "link_6": box((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1)),
    }
    leaf = quad((0.0, -1, 0.4), (1, -1, 0.4), (1, 1, 0.4), (0.0, 1, 0.4))
    plant = make_plant([(ahead(), "ripe"), (ahead(x=-0.1), "ripe")], [leaf])
    scene = RayScene([plant], CAMERA, robot_meshes=arm, device=device)
    eye, target = torch.eye(4, device=device)[None], torch.zeros(1, dtype=torch.int64, device=device)

    def cast(poses: torch.Tensor | None) -> Visibility:
        return scene.visibility(eye, target, eye, None if poses is None else poses.to(device))

    # The leaf hides one half, link 3 the other; link 6 stands behind the fruit.
    seen = cast(link_poses(link_3=(0, 0, 0.25), link_6=(0, 0, 0.8)))
    assert seen.visible_fraction.item() == pytest.approx(0.0, abs=0.01)
    # Link 6 hides the target and the other fruit.
    seen = cast(link_poses(link_6=(0, 0, 0.25)))
    assert seen.visible_fraction.tolist() == [0.0]
    assert seen.any_visible.tolist() == [False]
    # All of it is out of the way, behind the fruit, or there is no robot at all.
    for poses in (link_poses(), link_poses(link_6=(0, 0, 0.8)), None):
        seen = cast(poses)
        assert seen.visible_fraction.item() == pytest.approx(0.5, abs=0.01)
        assert seen.any_visible.tolist() == [True]


def test_the_wrist_camera_does_not_see_its_own_housing() -> None:
    camera = color_intrinsics()
    hand = {name: mesh for name, mesh in link_meshes().items() if name in ("link_ee", "link_7", "link_6")}
    corners = [(u, v) for u in (0.05, 0.3, 0.5, 0.7, 0.95) for v in (0.05, 0.5, 0.95)]
    centres = [
        ahead(
            0.3 * (u * camera.width - camera.cx) / camera.fx,
            0.3 * (v * camera.height - camera.cy) / camera.fy,
            0.3,
        )
        for u, v in corners
    ]
    plant = make_plant([(centre, "ripe") for centre in centres], radius=0.005)
    scene = RayScene([plant] * len(centres), camera, robot_meshes=hand)
    links = link_transforms(torch.zeros(1, 7, dtype=torch.float64)).expand(len(centres), -1, -1, -1)
    optical = links[:, -1] @ torch.tensor(np.array(T_flange_camera_color_optical))
    seen = scene.visibility(optical, torch.arange(len(centres)), optical, links)
    assert seen.visible_fraction.tolist() == [1.0] * len(centres)


def first_hits(origin: Float, directions: Float, triangles: Float) -> Float:
    """Distance to the nearest triangle along each ray, inf without one: Moeller-Trumbore, one ray at a time."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    result = np.full(len(directions), np.inf)
    for k, direction in enumerate(directions):
        p = np.cross(direction, ac)
        determinant = np.einsum("ij,ij->i", ab, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origin - a
            u = np.einsum("ij,ij->i", s, p) / determinant
            q = np.cross(s, ab)
            v = q @ direction / determinant
            t = np.einsum("ij,ij->i", ac, q) / determinant
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > CAMERA_NEAR)
        if hit.any():
            result[k] = t[hit].min()
    return result


def fraction_by_loop(
    plant: Plant, target: int, T_plant_camera: Float, links: Float, per_side: int = 40
) -> float:
    """V / T by plain arithmetic, with rays through a fine grid of a square about the target."""
    fruit = plant.fruits[target]
    turn, origin = T_plant_camera[:3, :3], T_plant_camera[:3, 3]
    centre = turn.T @ (fruit.centre - origin)
    distance = np.linalg.norm(centre)
    reach = 1.1 * fruit.radius / (distance - fruit.radius) * (distance / centre[2]) ** 2
    steps = (np.arange(per_side) + 0.5) / per_side * 2 - 1
    x, y = np.meshgrid(centre[0] / centre[2] + reach * steps, centre[1] / centre[2] + reach * steps)
    tangents = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    directions = tangents @ turn.T
    triangles = plant.vertices.astype(np.float64)[plant.faces]
    own = plant.organ_of_face == fruit.organ_index
    depth = first_hits(origin, directions, triangles[own])
    hits = np.isfinite(depth)
    pixels = tangents[:, :2] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    inside = ((pixels >= 0) & (pixels <= [CAMERA.width, CAMERA.height])).all(axis=1)
    others = np.concatenate([triangles[~own], links])
    free = hits & inside
    free[free] = first_hits(origin, directions[free], others) > depth[free]
    return float(np.count_nonzero(free) / np.count_nonzero(hits))


def scattered_plant(rng: np.random.Generator) -> Plant:
    leaves = []
    for _ in range(14):
        pose = random_pose(rng)
        size, centre = rng.uniform(0.02, 0.06), rng.normal(size=3) * 0.08
        corners = np.array([(-1, -0.5, 0), (1, -0.6, 0.2), (1.2, 0.5, 0), (-1, 0.6, 0.3)]) * size
        leaves.append(part(corners @ pose[:3, :3].T + centre, np.array([(0, 1, 2), (0, 2, 3)])))
    return make_plant([(rng.normal(size=3) * 0.05, "ripe") for _ in range(3)], leaves, columns=20)


def test_random_scenes_agree_with_a_plain_loop_over_all_triangles(device: str) -> None:
    rng = np.random.default_rng(11)
    vertices, faces = box((-0.03, -0.05, -0.02), (0.02, 0.04, 0.05))
    expected, poses, targets, links, plants = [], [], [], [], []
    for k in range(20):
        plant, target = scattered_plant(rng), int(rng.integers(3))
        fruit = plant.fruits[target].centre
        outwards = rng.normal(size=3)
        eye = fruit + rng.uniform(0.2, 0.6) * outwards / np.linalg.norm(outwards)
        # Every third camera misses the target by so much that it is cut by the image's edge or lies outside.
        forward = fruit + rng.normal(size=3) * (0.12 if k % 3 == 0 else 0.02) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, rng.normal(size=3))
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = eye
        link = random_pose(rng)
        link[:3, 3] = fruit + (eye - fruit) * rng.uniform(0.2, 0.5) + rng.normal(size=3) * 0.04
        expected.append(
            fraction_by_loop(plant, target, pose, (vertices @ link[:3, :3].T + link[:3, 3])[faces])
        )
        plants.append(plant)
        poses.append(pose)
        targets.append(target)
        links.append(np.stack([link] * len(LINK_NAMES)))
    scene = RayScene(
        plants,
        CAMERA,
        robot_meshes={"link_4": (vertices, faces)},
        rays_per_side=36,
        device=device,
    )
    world = random_pose(rng)
    seen = scene.visibility(
        torch.tensor(world @ np.stack(poses), device=device),
        torch.tensor(targets, device=device),
        torch.tensor(np.tile(world, (20, 1, 1)), device=device),
        torch.tensor(world @ np.stack(links), device=device),
    )
    assert np.ptp(expected) > 0.8
    # About 1000 rays of either kind meet a target: fractions of both are good to about 1 %.
    np.testing.assert_allclose(seen.visible_fraction.cpu().numpy(), expected, atol=0.025)
    torch.testing.assert_close(seen.visible / seen.total, seen.visible_fraction)


def test_a_generated_plant_gives_the_same_answer_twice_and_on_a_fresh_scene(device: str) -> None:
    plant = generate_plant("three_tomatoes", 4, "training")
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, 3] = torch.from_numpy(plant.fruits[1].centre) + torch.tensor([-0.5, 0.1, 0.0])
    answers = []
    for _ in range(2):
        scene = RayScene([plant], CAMERA, device=device)
        for _ in range(2):
            eye = torch.eye(4, device=device)[None]
            answers.append(
                scene.visibility(pose[None].to(device), torch.tensor([1], device=device), eye).rows
            )
    for answer in answers[1:]:
        torch.testing.assert_close(answer, answers[0], atol=0, rtol=0)


def test_results_of_an_earlier_look_stay_as_they_were() -> None:
    scene = RayScene([make_plant([(ahead(), "ripe")])], CAMERA)
    eye, away = torch.eye(4)[None], torch.eye(4)[None].clone()
    away[0, :3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    first = scene.visibility(eye, torch.tensor([0]), eye)
    second = scene.visibility(away, torch.tensor([0]), eye)
    assert (first.visible_fraction.item(), second.visible_fraction.item()) == (1.0, 0.0)


def test_a_replaced_plant_is_seen_in_its_environment_only(device: str) -> None:
    wall = quad((-1, -1, 0.3), (1, -1, 0.3), (1, 1, 0.3), (-1, 1, 0.3))
    free, hidden = make_plant([(ahead(), "ripe")]), make_plant([(ahead(), "ripe")], [wall])
    many = make_plant([(ahead(x=0.1 * k), "ripe") for k in range(-2, 5)], [])
    scene = RayScene([free, free], CAMERA, device=device)
    eye = torch.eye(4, device=device).repeat(2, 1, 1)

    def fractions(*targets: int) -> list[float]:
        return scene.visibility(eye, torch.tensor(targets, device=device), eye).visible_fraction.tolist()

    assert fractions(0, 0) == [1.0, 1.0]
    scene.replace_plants({1: hidden})
    assert fractions(0, 0) == [1.0, 0.0]
    scene.replace_plants({0: many})
    assert scene.plant(0) is many
    assert fractions(2, 0) == [1.0, 0.0]
    scene.replace_plants({0: hidden})
    scene.replace_plants({1: free})
    assert fractions(0, 0) == [0.0, 1.0]


def test_plants_no_longer_shown_are_let_go(monkeypatch: pytest.MonkeyPatch, backend: Backend) -> None:
    first = make_plant([(ahead(), "ripe")])
    room = 9
    monkeypatch.setattr(PLANT_STORE, "_limit", lambda: room * PlantMeshes(first, "cpu", backend).size)
    scene = RayScene([first], CAMERA)
    shown = []
    for _ in range(room + 7):
        plant = make_plant([(ahead(), "ripe")])
        shown.append(weakref.ref(plant))
        scene.replace_plants({0: plant})
        del plant
    gc.collect()
    assert [ref() is not None for ref in shown] == [False] * 7 + [True] * room


def test_input_that_cannot_be_used_is_refused_with_a_reason() -> None:
    plant = make_plant([(ahead(), "ripe")])
    bare = Plant("bare", 0, "training", plant.organs, ())
    with pytest.raises(InvalidInputError, match="at least one environment"):
        RayScene([], CAMERA)
    with pytest.raises(InvalidInputError, match="at least one fruit"):
        RayScene([bare], CAMERA)
    with pytest.raises(InvalidInputError, match="rays_per_side must be at least 2, got 1"):
        RayScene([plant], CAMERA, rays_per_side=1)
    with pytest.raises(InvalidInputError, match="'link_0'.*got 'elbow'"):
        RayScene([plant], CAMERA, robot_meshes={"elbow": box((0, 0, 0), (1, 1, 1))})
    scene = RayScene([plant], CAMERA)
    eye, target = torch.eye(4)[None], torch.tensor([0])
    with pytest.raises(InvalidInputError, match=r"T_w_camera must have shape \(1, 4, 4\), got \(4, 4\)"):
        scene.visibility(torch.eye(4), target, eye)
    with pytest.raises(InvalidInputError, match=r"target_fruit must have shape \(1,\)"):
        scene.visibility(eye, torch.tensor([0, 0]), eye)
    with pytest.raises(InvalidInputError, match=r"T_w_links must have shape \(1, 9, 4, 4\)"):
        scene.visibility(eye, target, eye, torch.eye(4).repeat(1, 8, 1, 1))
    for wrong in (-1, 1):
        with pytest.raises(InvalidInputError, match=rf"target_fruit\[0\] must be from 0 to 0.*got {wrong}"):
            scene.visibility(eye, torch.tensor([wrong]), eye)
    with pytest.raises(InvalidInputError, match="plants must be keyed by environments from 0 to 0, got 1"):
        scene.replace_plants({1: plant})


@pytest.mark.gpu
def test_on_cuda_a_target_that_does_not_exist_gives_nan_there_only() -> None:
    plant = make_plant([(ahead(), "ripe")])
    scene = RayScene([plant, plant], CAMERA, device="cuda")
    eye = torch.eye(4, device="cuda").repeat(2, 1, 1)
    seen = scene.visibility(eye, torch.tensor([7, 0], device="cuda"), eye)
    assert torch.isnan(seen.visible_fraction).tolist() == [True, False]
