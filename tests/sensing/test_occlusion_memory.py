"""The occlusion memory against sampled rays, closed forms and what plants really hide."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import RANGE, RayLabel, ViewRays
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.sensing.occlusion_memory import (
    CELL_SIZE,
    GRID_CELLS,
    MAX_VISITS,
    TARGET_RADIUS,
    OcclusionMemory,
)

HALF = GRID_CELLS * CELL_SIZE / 2


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


def begun(target: tuple[float, float, float], device: str = "cpu", **options: float) -> OcclusionMemory:
    memory = OcclusionMemory(1, device, **options)
    memory.begin(torch.tensor([0], device=device), torch.tensor([target], device=device))
    return memory


def rays_to(points_w: Tensor, T_world_camera: Tensor, label: Tensor, device: str = "cpu") -> ViewRays:
    """One view whose rays end at points. Shapes (N, 3), (4, 4), (N,)."""
    towards = points_w - T_world_camera[:3, 3]
    distance = towards.norm(dim=-1)
    direction_c = (towards / distance[:, None]) @ T_world_camera[:3, :3]
    return ViewRays(
        direction_c[None].to(device), distance[None].to(device), label[None].to(torch.int8).to(device)
    )


def random_view(count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points in and around a grid at (0.7, 0.1, 1.0), a camera, and labels."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.tensor([0.7, 0.1, 1.0])
    points = target + 0.9 * HALF * (2 * torch.rand(count, 3, generator=generator) - 1) * 1.6
    camera = target + torch.tensor([-0.5, -0.2, 0.15])
    label = torch.randint(0, 4, (count,), generator=generator)
    return points, look_at_pose(camera, target, 0.7), label


def sampled_lengths(start: Tensor, end: Tensor, target: Tensor, samples: int = 8_000) -> Tensor:
    """Length of a line in each voxel, in voxel edges, by sampling it densely. Shape (32, 32, 32)."""
    share = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples
    points = start.double() + share[:, None] * (end - start).double()
    cells = torch.floor((points - target.double() + HALF) / CELL_SIZE).long()
    cells = cells[((cells >= 0) & (cells < GRID_CELLS)).all(dim=-1)]
    lengths = torch.zeros(GRID_CELLS**3, dtype=torch.float64)
    index = (cells[:, 0] * GRID_CELLS + cells[:, 1]) * GRID_CELLS + cells[:, 2]
    step = float((end - start).norm()) / samples / CELL_SIZE
    lengths.index_add_(0, index, torch.full((len(index),), step, dtype=torch.float64))
    return lengths.view(GRID_CELLS, GRID_CELLS, GRID_CELLS)


@pytest.mark.parametrize("seed", [0, 1])
def test_rays_leave_their_length_in_the_voxels_that_they_pass(device: str, seed: int) -> None:
    points, T_world_camera, label = random_view(40, seed)
    memory = begun((0.7, 0.1, 1.0), device)
    memory.integrate(T_world_camera[None].to(device), rays_to(points, T_world_camera, label, device))
    target = torch.tensor([0.7, 0.1, 1.0])
    expected = torch.zeros(GRID_CELLS, GRID_CELLS, GRID_CELLS, dtype=torch.float64)
    for point, kind in zip(points, label, strict=True):
        if kind != RayLabel.OUTSIDE:
            expected += sampled_lengths(T_world_camera[:3, 3], point, target)
    passed = memory.passed_length[0].cpu().double()
    # A length is kept to 1/256 of an edge, and a voxel near the camera is passed by several rays.
    assert float((passed - expected).abs().max()) < 0.03
    assert float(passed.sum()) == pytest.approx(float(expected.sum()), rel=2e-3)


def test_only_what_is_not_the_target_leaves_hits_and_only_where_it_is(device: str) -> None:
    points, T_world_camera, label = random_view(400, 2)
    memory = begun((0.7, 0.1, 1.0), device)
    memory.integrate(T_world_camera[None].to(device), rays_to(points, T_world_camera, label, device))
    cells = torch.floor((points - torch.tensor([0.7, 0.1, 1.0]) + HALF) / CELL_SIZE).long()
    inside = ((cells >= 0) & (cells < GRID_CELLS)).all(dim=-1) & (label == RayLabel.OTHER)
    expected = torch.zeros(GRID_CELLS, GRID_CELLS, GRID_CELLS, dtype=torch.int32)
    for x, y, z in cells[inside].tolist():
        expected[x, y, z] += 1
    assert 20 < int(expected.sum()) < 100
    assert_close(memory.hits[0].cpu(), expected)


@pytest.mark.parametrize("count", [1, 7, 8, 21])
def test_rays_taken_in_together_leave_what_each_leaves_by_itself(device: str, count: int) -> None:
    points, T_world_camera, label = random_view(count, count)
    together, alone = (begun((0.7, 0.1, 1.0), device) for _ in range(2))
    pose = T_world_camera[None].to(device)
    together.integrate(pose, rays_to(points, T_world_camera, label, device))
    for k in range(count):
        alone.integrate(pose, rays_to(points[k : k + 1], T_world_camera, label[k : k + 1], device))
    assert_close(together.hits, alone.hits)
    assert_close(together.passed_length, alone.passed_length)
    assert together.visits.tolist() == [1] and alone.visits.tolist() == [count]
    # Which densities are out of date is noted ray by ray.
    afresh = begun((0.0, 0.0, 0.0), device)
    afresh.load_state(together.state())
    together.begin(torch.tensor([0], device=device), torch.tensor([[0.7, 0.1, 1.0]], device=device))
    together.estimate()
    together.integrate(pose, rays_to(points, T_world_camera, label, device))
    assert torch.equal(together.density, afresh.density) and torch.equal(together.known, afresh.known)


def test_axis_parallel_rays_on_voxel_borders_and_rays_past_the_grid_are_no_trouble(device: str) -> None:
    target = torch.zeros(3)
    starts = [(-0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, -0.5), (-0.5, 0.4, 0.0)]
    ends = [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.5), (0.5, 0.4, 0.0)]
    memory = begun((0.0, 0.0, 0.0), device)
    for start, end in zip(starts, ends, strict=True):
        pose = torch.eye(4)
        pose[:3, 3] = torch.tensor(start)
        rays = rays_to(torch.tensor([end]), pose, torch.tensor([int(RayLabel.FREE)]), device)
        memory.integrate(pose[None].to(device), rays)
    assert float(memory.passed_length.sum()) == pytest.approx(3 * GRID_CELLS, rel=1e-3)
    assert int(memory.visits[0]) == 4
    assert_close(memory.visited[0, :4].cpu(), torch.tensor(starts))
    assert bool(memory.visited[0, 4:].isnan().all())
    assert_close(memory.target_position[0].cpu(), target)


def test_an_empty_memory_expects_what_its_prior_says(device: str) -> None:
    memory = begun((0.7, 0.1, 1.0), device, unknown_probability=0.05)
    camera = torch.tensor([[[0.7 - 0.2, 0.1, 1.0], [0.7 - 2.0, 0.1, 1.0]]], device=device)
    predicted = memory.predict(camera)[0].cpu()
    # From the front of the disc's sphere to the camera, or to the border of the grid.
    ring = TARGET_RADIUS * np.sqrt((np.arange(8) + 0.5) / 8)
    bulge = np.sqrt(TARGET_RADIUS**2 - ring**2)
    near = np.hypot(0.2 - bulge, ring) / CELL_SIZE
    far = (HALF - bulge) / CELL_SIZE
    for row, length in zip(predicted, (near, far), strict=True):
        assert float(row[0]) == pytest.approx(float(np.mean(0.95**length)), rel=3e-3)
        assert float(row[1]) == pytest.approx(1.0)


def wall_view(memory: OcclusionMemory, wall_y: tuple[float, float], label: RayLabel) -> None:
    """Many parallel-ish rays along +x that all end on the plane x = -0.1 (target at the origin)."""
    side = torch.linspace(-0.15, 0.15, 61)
    y, z = torch.meshgrid(side, side, indexing="ij")
    points = torch.stack([torch.full_like(y, -0.095), y, z], dim=-1).reshape(-1, 3)
    is_wall = (points[:, 1] > wall_y[0]) & (points[:, 1] < wall_y[1])
    free = points.clone()
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([-1.0, 0.0, 0.0])
    beyond = pose[:3, 3] + (free - pose[:3, 3]) * (1.4 / 0.905)
    ends = torch.where(is_wall[:, None], points, beyond)
    labels = torch.where(is_wall, int(label), int(RayLabel.FREE))
    device = str(memory.device)
    memory.integrate(pose[None].to(device), rays_to(ends, pose, labels, device))


def test_a_wall_hides_the_target_behind_it_and_free_space_does_not(device: str) -> None:
    memory = begun((0.0, 0.0, 0.0), device)
    wall_view(memory, (-1.0, 1.0), RayLabel.OTHER)
    front = torch.tensor([[[-0.5, 0.0, 0.0]]], device=device)
    behind = torch.tensor([[[0.5, 0.0, 0.0]]], device=device)
    hidden, unknown = memory.predict(front)[0, 0].tolist()
    assert hidden < 0.2 and unknown < 0.4
    # Nothing is known behind the wall.
    assert memory.predict(behind)[0, 0].tolist() == pytest.approx([0.99**14.5, 1.0], rel=0.02)

    memory = begun((0.0, 0.0, 0.0), device)
    wall_view(memory, (0.5, 1.0), RayLabel.OTHER)
    seen, unknown = memory.predict(front)[0, 0].tolist()
    assert seen > 0.98 and unknown < 0.02
    memory = begun((0.0, 0.0, 0.0), device)
    wall_view(memory, (-1.0, 1.0), RayLabel.TARGET)
    assert float(memory.predict(front)[0, 0, 0]) > 0.95


def test_what_stands_in_a_voxel_is_expected_beside_it_too_and_not_far_away(device: str) -> None:
    memory = begun((0.0, 0.0, 0.0), device)
    cameras = torch.tensor([[[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]], device=device)
    before = memory.predict(cameras)[0, :, 0].tolist()
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([-0.5, 0.0, 0.0])
    # All in the voxels just below the line from the target to the first camera, 3 cm beside it.
    points = torch.tensor([[-0.11, 0.03, -0.03]]).repeat(20, 1)
    labels = torch.full((20,), int(RayLabel.OTHER))
    memory.integrate(pose[None].to(device), rays_to(points, pose, labels, device))
    after = memory.predict(cameras)[0, :, 0].tolist()
    assert after[0] < before[0] - 0.1
    assert after[1] == pytest.approx(before[1], abs=1e-6)


def test_a_wall_that_covers_half_hides_half(device: str) -> None:
    memory = begun((0.0, 0.0, 0.0), device)
    wall_view(memory, (0.0, 1.0), RayLabel.OTHER)
    seen = float(memory.predict(torch.tensor([[[-0.5, 0.0, 0.0]]], device=device))[0, 0, 0])
    assert seen == pytest.approx(0.5, abs=0.15)


def plain_density(hits: Tensor, passed: Tensor, density: float, weights: dict[int, float]) -> Tensor:
    """Hits per voxel edge: blocks of 4 voxels along each edge, then 2, then 1, each beginning from the one before."""
    expected = torch.full_like(hits, density)
    for edge, weight in weights.items():
        blocks = [
            edge**3 * torch.nn.functional.avg_pool3d(values[None], edge)[0] for values in (hits, passed)
        ]
        all_hits, all_passed = (torch.kron(block, torch.ones(edge, edge, edge).double()) for block in blocks)
        expected = (all_hits + weight * expected) / (all_passed + weight)
    return expected


def plain_prediction(
    memory: OcclusionMemory, camera: Tensor, density: float, voxel_weight: float, block_weight: float
) -> list[float]:
    """The same prediction by sampling 8 rays densely in double precision."""
    target = memory.target_position[0].double()
    hits, passed = memory.hits[0].double(), memory.passed_length[0].double()
    weights = {4: block_weight, 2: block_weight, 1: voxel_weight}
    per_edge = plain_density(hits, passed, density, weights)
    is_unknown = (hits == 0) & (passed < 0.25)
    axes = look_at_pose(camera.double(), target)[:3, :3]
    right, up = axes[:, 0], -axes[:, 1]
    shares, unknown, whole = [], 0.0, 0.0
    for index in range(8):
        ring, angle = TARGET_RADIUS * math.sqrt((index + 0.5) / 8), index * math.pi * (3 - math.sqrt(5))
        bulge = math.sqrt(TARGET_RADIUS**2 - ring**2)
        start = target + ring * (math.cos(angle) * right + math.sin(angle) * up) - bulge * axes[:, 2]
        lengths = sampled_lengths(start, camera, target)
        shares.append(math.exp(-float((lengths * per_edge).sum())))
        unknown += float((lengths * is_unknown).sum())
        whole += float(lengths.sum())
    return [float(np.mean(shares)), unknown / whole]


def test_predictions_are_those_of_a_plain_loop() -> None:
    memory = begun((0.7, 0.1, 1.0), unknown_probability=0.02, voxel_weight=0.4, block_weight=1.5)
    for seed in range(3):
        points, T_world_camera, label = random_view(300, seed)
        near = memory.target_position + 0.3 * (points - memory.target_position)
        memory.integrate(T_world_camera[None], rays_to(near, T_world_camera, label))
    generator = torch.Generator().manual_seed(9)
    cameras = torch.tensor([0.7, 0.1, 1.0]) + 0.4 * torch.randn(12, 3, generator=generator)
    predicted = memory.predict(cameras[None])[0]
    assert float(predicted[:, 0].std()) > 0.1
    for camera, found in zip(cameras, predicted, strict=True):
        expected = plain_prediction(memory, camera, -math.log(0.98), 0.4, 1.5)
        # The fixed points of 1/256 voxel edge and the samples of the loop.
        assert found.tolist() == pytest.approx(expected, abs=4e-3)


def test_every_voxel_has_the_density_of_a_plain_loop(device: str) -> None:
    memory = begun((0.7, 0.1, 1.0), device, unknown_probability=0.02, voxel_weight=0.4, block_weight=1.5)
    points, T_world_camera, label = random_view(600, 4)
    memory.integrate(T_world_camera[None].to(device), rays_to(points, T_world_camera, label, device))
    hits, passed = memory.hits[0].cpu().double(), memory.passed_length[0].cpu().double()
    expected = plain_density(hits, passed, -math.log(0.98), {4: 1.5, 2: 1.5, 1: 0.4}) / CELL_SIZE
    assert_close(memory.density[0].cpu().double(), expected, rtol=2e-6, atol=0.0)
    is_known = (hits > 0) | (passed >= 0.25)
    assert torch.equal(memory.known[0].cpu(), is_known)
    assert 0.05 < float(is_known.double().mean()) < 0.95


def test_densities_that_are_read_between_views_are_those_of_all_views_at_once(device: str) -> None:
    often, once = begun((0.7, 0.1, 1.0), device), begun((0.0, 0.0, 0.0), device)
    for seed in range(5):
        points, pose, label = random_view(100, seed)
        often.integrate(pose[None].to(device), rays_to(points, pose, label, device))
        if seed == 2:
            saved = often.state()
            often.begin(torch.tensor([0], device=device), torch.tensor([[0.1, 0.1, 1.0]], device=device))
            assert float(often.density.std()) == 0.0 and not bool(often.known.any())
            often.load_state(saved)
        assert float(often.density.std()) > 0.0
    once.load_state(often.state())
    assert torch.equal(often.density, once.density) and torch.equal(often.known, once.known)


def test_environments_remember_on_their_own(device: str) -> None:
    targets = torch.tensor([[0.7, 0.1, 1.0], [0.6, -0.1, 0.9], [0.7, 0.1, 1.0]], device=device)
    memory = OcclusionMemory(3, device)
    memory.begin(torch.arange(3, device=device), targets)
    points, pose, label = random_view(100, 0)
    one = rays_to(points, pose, label, device)
    rays = ViewRays(*(t.repeat_interleave(3, 0) for t in (one.direction_c, one.distance, one.label)))
    poses = pose.to(device).expand(3, 4, 4)
    mask = torch.tensor([True, False, True], device=device)
    memory.integrate(poses, rays, mask)
    assert memory.visits.tolist() == [1, 0, 1]
    assert int(memory.hits[1].sum()) == 0 and int(memory.hits[0].sum()) > 0
    assert_close(memory.hits[0], memory.hits[2])
    memory.begin(torch.tensor([2], device=device), targets[1:2])
    assert int(memory.hits[2].sum()) == 0 and int(memory.hits[0].sum()) > 0
    assert_close(memory.target_position[2], targets[1])


def test_a_saved_memory_goes_on_as_it_would_have(device: str) -> None:
    first, other = begun((0.7, 0.1, 1.0), device), begun((0.0, 0.0, 0.0), device)
    for seed in range(2):
        points, pose, label = random_view(100, seed)
        first.integrate(pose[None].to(device), rays_to(points, pose, label, device))
    other.load_state(first.state())
    points, pose, label = random_view(100, 7)
    cameras = pose[:3, 3].to(device) + torch.rand(1, 20, 3, device=device)
    for memory in (first, other):
        memory.integrate(pose[None].to(device), rays_to(points, pose, label, device))
    assert torch.equal(first.predict(cameras), other.predict(cameras))
    assert torch.equal(first.visits, other.visits)
    three = OcclusionMemory(3, device)
    three.load_state(first.state(), torch.tensor([1], device=device))
    assert int(three.hits[0].sum()) == 0 and torch.equal(three.hits[1:2], first.hits)
    with pytest.raises(InvalidInputError, match=r"state\['hits'\] must have shape \(3, 32768\)"):
        three.load_state(first.state())
    with pytest.raises(InvalidInputError, match=r"state\['visits'\] must have shape \(1,\), got nothing"):
        first.load_state({k: v for k, v in first.state().items() if k != "visits"})


def test_more_views_than_are_remembered_replace_the_first(device: str) -> None:
    memory = begun((0.7, 0.1, 1.0), device)
    points, pose, label = random_view(4, 0)
    rays = rays_to(points, pose, label, device)
    for step in range(MAX_VISITS + 2):
        moved = pose.clone()
        moved[0, 3] = float(step)
        memory.integrate(moved[None].to(device), rays)
    assert memory.visited[0, :3, 0].tolist() == [MAX_VISITS, MAX_VISITS + 1, 2.0]


def test_the_fraction_of_every_view_is_kept_beside_where_it_was_taken(device: str) -> None:
    memory = OcclusionMemory(2, device)
    memory.begin(torch.arange(2, device=device), torch.tensor([[0.7, 0.1, 1.0]] * 2, device=device))
    points, pose, label = random_view(4, 0)
    one = rays_to(points, pose, label, device)
    rays = ViewRays(*(t.repeat_interleave(2, 0) for t in (one.direction_c, one.distance, one.label)))
    poses = pose.to(device).expand(2, 4, 4)
    memory.integrate(poses, rays, visible_fraction=torch.tensor([0.25, 0.5], device=device))
    mask = torch.tensor([False, True], device=device)
    memory.integrate(poses, rays, mask, visible_fraction=torch.tensor([0.75, 0.125], device=device))
    memory.integrate(poses, rays)
    told = [[value for value in row if math.isfinite(value)] for row in memory.fractions.tolist()]
    assert told == [[0.25], [0.5, 0.125]] and memory.visits.tolist() == [2, 3]
    with pytest.raises(InvalidInputError, match=r"visible_fraction must have shape \(2,\), got \(1,\)"):
        memory.integrate(poses, rays, visible_fraction=torch.ones(1, device=device))
    memory.begin(torch.tensor([1], device=device), torch.zeros(1, 3, device=device))
    assert bool(memory.fractions[1].isnan().all()) and float(memory.fractions[0, 0]) == 0.25


def test_what_is_predicted_agrees_with_what_is_seen_the_better_the_more_views() -> None:
    correlations: dict[int, list[float]] = {1: [], 6: []}
    rng = np.random.default_rng(0)
    for seed in range(8):
        plant = generate_plant("full", seed, "training")
        scene = RayScene([plant], color_intrinsics())
        target = next(i for i, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe")
        centre = torch.from_numpy(plant.fruits[target].centre)
        offset = torch.from_numpy(rng.normal(size=(300, 3)) * (0.1, 0.25, 0.2) + (-0.45, 0, 0)).float()
        cameras = look_at_pose(centre + offset, centre.expand(300, 3))
        truth = scene.visible_fraction_from(cameras, target, torch.eye(4))
        memory = begun(tuple(centre.tolist()))
        for k in range(6):
            rays = scene.view_rays(
                cameras[k : k + 1], torch.tensor([target]), centre[None], torch.eye(4)[None]
            )
            memory.integrate(cameras[k : k + 1], rays)
            if k + 1 in correlations:
                predicted = memory.predict(cameras[None, 6:, :3, 3])[0, :, 0]
                together = torch.corrcoef(torch.stack([predicted, truth[6:]]))
                correlations[k + 1].append(float(together[0, 1]))
    assert np.nanmean(correlations[6]) > 0.75
    assert np.nanmean(correlations[6]) > np.nanmean(correlations[1]) + 0.1


def test_inputs_that_cannot_be_used_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"unknown_probability must lie in \[0, 1\), got 1.0"):
        OcclusionMemory(1, unknown_probability=1.0)
    memory = OcclusionMemory(2)
    with pytest.raises(InvalidInputError, match=r"camera_positions must have shape \(2, K, 3\)"):
        memory.predict(torch.zeros(1, 5, 3))
    with pytest.raises(InvalidInputError, match=r"target_position must have shape \(1, 3\)"):
        memory.begin(torch.tensor([0]), torch.zeros(2, 3))
    label = torch.zeros(2, 4, dtype=torch.int8)
    rays = ViewRays(torch.zeros(2, 4, 3), torch.full((2, 4), RANGE), label)
    with pytest.raises(InvalidInputError, match=r"mask must have shape \(2,\)"):
        memory.integrate(torch.eye(4).expand(2, 4, 4), rays, torch.tensor([True]))
    assert memory.predict(torch.zeros(2, 0, 3)).shape == (2, 0, 2)
