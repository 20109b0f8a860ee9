"""The observation vector, part by part, against values worked out by hand and the public memory and lattice."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator
from torch import Tensor
from torch.testing import assert_close

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import RAYS_PER_SIDE, RayLabel, ViewRays
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.look_at import camera_to_viewpoint, look_at_pose, look_frame
from maniskill_tomato.sensing.observation import (
    MAP_SIDE,
    NEAR_MAP_SIDE,
    PART_SHAPES,
    PATCH_SIDE,
    WORKSPACE_HALF_SIZE,
    WORKSPACE_MIDDLE,
    ObservationLayout,
    ViewpointObserver,
)
from maniskill_tomato.sensing.perception_kinds import Part
from maniskill_tomato.sensing.view_lattice import ViewLattice

RAYS = RAYS_PER_SIDE**2
T_WORLD_PLANT = torch.eye(4)
T_WORLD_PLANT[:3, 3] = torch.tensor([0.85, 0.1, 0.0])


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


class Episode:
    """Looks of one or two environments at a ripe fruit of one plant."""

    def __init__(
        self, device: str = "cpu", num_envs: int = 1, layout: ObservationLayout | None = None
    ) -> None:
        plant = generate_plant("full", 4, "training")
        self.fruit = next(i for i, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe")
        centre = torch.from_numpy(plant.fruits[self.fruit].centre) + T_WORLD_PLANT[:3, 3]
        self.num_envs, self.device = num_envs, device
        self.target = centre.to(device).expand(num_envs, 3)
        self._scene = RayScene([plant] * num_envs, color_intrinsics(), device=device)
        self.observer = ViewpointObserver(num_envs, device, layout)
        self.observer.begin(torch.arange(num_envs, device=device), self.target)

    def poses(self, offset: tuple[float, float, float], roll: float = 0.0) -> Tensor:
        return look_at_pose(self.target + torch.tensor(offset, device=self.device), self.target, roll)

    def view(self, poses: Tensor) -> ViewRays:
        fruits = torch.full((self.num_envs,), self.fruit, device=self.device)
        plant_poses = T_WORLD_PLANT.to(self.device).expand(self.num_envs, 4, 4)
        return self._scene.view_rays(poses, fruits, self.target, plant_poses)

    def look(
        self,
        offset: tuple[float, float, float],
        roll: float = 0.0,
        moves_left: int = 20,
        mask: Tensor | None = None,
    ) -> Tensor:
        poses = self.poses(offset, roll)
        viewpoint = camera_to_viewpoint(poses, torch.zeros(self.num_envs, 3, device=self.device))
        fraction = torch.full((self.num_envs,), 0.25, device=self.device)
        left = torch.full((self.num_envs,), moves_left, device=self.device)
        return self.observer.observe(viewpoint, poses, self.view(poses), fraction, left, mask)

    def part(self, observation: Tensor, name: Part) -> Tensor:
        """A part of the first environment's vector in its own shape."""
        return observation[0, self.observer.layout.slices[name]].view(PART_SHAPES[name]).cpu()


def test_the_parts_fill_the_vector_without_gaps() -> None:
    layout = ObservationLayout()
    start = 0
    for name in layout.parts:
        assert layout.slices[name] == slice(start, start + int(np.prod(PART_SHAPES[name])))
        start = layout.slices[name].stop
    assert layout.size == start
    assert ObservationLayout.blind().size == 9
    assert ObservationLayout.without_memory().size == 12 + 3 * PATCH_SIDE**2


def test_numbers_are_scaled_poses_target_visible_fraction_and_time(device: str) -> None:
    every = ObservationLayout(parts=tuple(PART_SHAPES))
    episode = Episode(device, layout=every)
    observation = episode.look((-0.3, -0.4, 0.0), roll=0.5, moves_left=15)
    target = episode.target[0].cpu()
    middle, half = torch.tensor(WORKSPACE_MIDDLE), torch.tensor(WORKSPACE_HALF_SIZE)
    pose = [-0.6, -0.8, 0.0, 0.5 / 0.5 - 1.0, -0.6, -0.8, 0.0]
    assert episode.part(observation, "pose").tolist() == pytest.approx(pose, abs=1e-5)
    assert_close(episode.part(observation, "target"), (target - middle) / half)
    assert episode.part(observation, "visible_fraction").tolist() == [-0.5]
    assert episode.part(observation, "time").tolist() == [0.5]
    viewpoint = camera_to_viewpoint(episode.poses((-0.3, -0.4, 0.0), 0.5), torch.zeros(1, 3, device=device))
    viewpoint = viewpoint[0].cpu()
    by_hand = torch.cat([(viewpoint[:3] - middle) / half, viewpoint[3:] / math.pi])
    assert_close(episode.part(observation, "viewpoint"), by_hand)


def plain_patch(rays: ViewRays, away: float, forward_c: Tensor) -> Tensor:
    """The patch by a plain loop over its cells."""
    patch = torch.zeros(3, PATCH_SIDE, PATCH_SIDE)
    label = rays.label[0].view(RAYS_PER_SIDE, RAYS_PER_SIDE).cpu()
    depth = (rays.distance[0] * (rays.direction_c[0] @ forward_c)).view(RAYS_PER_SIDE, RAYS_PER_SIDE).cpu()
    for row in range(PATCH_SIDE):
        for column in range(PATCH_SIDE):
            gaps = []
            for i in (2 * row, 2 * row + 1):
                for j in (2 * column, 2 * column + 1):
                    patch[0, row, column] += 0.25 * (label[i, j] == RayLabel.TARGET)
                    patch[0, row, column] -= 0.25 * (label[i, j] == RayLabel.OUTSIDE)
                    if label[i, j] == RayLabel.OTHER:
                        gap = away - float(depth[i, j])
                        patch[1, row, column] += 0.25 * (gap > 0)
                        gaps.append(min(max(gap / 0.32, -1.0), 1.0))
            if gaps:
                patch[2, row, column] = float(np.mean(gaps))
    return patch


@pytest.mark.parametrize("offset", [(-0.45, 0.1, 0.05), (-0.3, -0.3, 0.2)])
def test_the_patch_pools_the_rays(device: str, offset: tuple[float, float, float]) -> None:
    episode = Episode(device)
    observation = episode.look(offset)
    rays = episode.view(episode.poses(offset))
    # The camera looks straight at the target.
    forward_c = torch.tensor([0.0, 0.0, 1.0], device=device)
    patch = episode.part(observation, "patch")
    assert_close(patch, plain_patch(rays, float(np.linalg.norm(offset)), forward_c), atol=1e-4, rtol=0)
    assert float(patch[0].min()) <= -0.5
    assert float(patch[1].max()) == 1.0
    assert float(patch[2].max()) > 0.1 and float(patch[2].min()) < -0.1


def test_the_patch_and_the_maps_do_not_turn_with_the_camera(device: str) -> None:
    # At this roll the image covers other rays; those that both see must be the same.
    upright, turned = Episode(device), Episode(device)
    first = upright.view(upright.poses((-0.45, 0.1, 0.05)))
    second = turned.view(turned.poses((-0.45, 0.1, 0.05), roll=math.pi))
    both = (first.label != RayLabel.OUTSIDE) & (second.label != RayLabel.OUTSIDE)
    assert int(both.sum()) > 100
    assert_close(first.label[both], second.label[both])
    one = upright.look((-0.45, 0.1, 0.05))
    two = turned.look((-0.45, 0.1, 0.05), roll=math.pi)
    assert_close(upright.part(one, "map")[3], turned.part(two, "map")[3], atol=1e-5, rtol=0)


def turned_positions(position: Tensor, target: Tensor, side: int, step_deg: float, distance: float) -> Tensor:
    """Camera positions of a map, row by row from the upper left. Shape (side^2, 3)."""
    right, up, forward = look_frame(position, target).unbind(-1)
    positions = []
    for row in range(side):
        for column in range(side):
            across = math.radians(step_deg) * (column - side // 2)
            above = math.radians(step_deg) * (side // 2 - row)
            angle = math.hypot(across, above)
            sideways = (across * right + above * up) / angle if angle > 0 else torch.zeros(3)
            direction = -math.cos(angle) * forward + math.sin(angle) * sideways
            positions.append(target + distance * direction)
    return torch.stack(positions)


def out_of_reach(lattice: ViewLattice, reachable: Tensor, target: Tensor, cameras: Tensor) -> Tensor:
    """Share of candidates out of reach by SciPy's linear interpolation; 1 more than half a step outside."""
    where, last = lattice.coordinates(target, cameras)[0].cpu(), torch.tensor(lattice.shape) - 1
    table = (~reachable[0]).cpu().numpy().reshape(lattice.shape).astype(np.float32)
    interpolator = RegularGridInterpolator([np.arange(n) for n in lattice.shape], table)
    inside = interpolator(torch.minimum(where.clamp_min(0), last).numpy())
    outside = ((where < -0.5) | (where > last + 0.5)).any(dim=-1)
    return torch.where(outside, 1.0, torch.from_numpy(inside).float())


def test_the_maps_hold_what_memory_visits_and_lattice_say_of_cameras_turned_about_the_target(
    device: str,
) -> None:
    episode = Episode(device)
    offsets = [(-0.5, -0.2, -0.1), (-0.4, 0.25, 0.1), (-0.35, 0.05, 0.15)]
    for offset in offsets[:-1]:
        episode.look(offset)
    observation = episode.look(offsets[-1])
    target = episode.target[0].cpu()
    memory, lattice = episode.observer.memory, episode.observer.lattice
    reachable = episode.observer.belief.reachable
    visited = torch.stack([target + torch.tensor(offset) for offset in offsets])
    distance = float(np.linalg.norm(offsets[-1]))
    for name, side, step, away in (
        ("map", MAP_SIDE, 10.0, distance),
        ("near_map", NEAR_MAP_SIDE, 15.0, max(0.6 * distance, 0.22)),
    ):
        where = turned_positions(target + torch.tensor(offsets[-1]), target, side, step, away)
        there = where[None].to(device)
        found = episode.part(observation, "map" if name == "map" else "near_map").flatten(1)
        predicted = memory.predict(there)[0].cpu()
        assert_close(found[0], 2 * predicted[:, 0] - 1, atol=2e-3, rtol=0)
        unreachable = out_of_reach(lattice, reachable, episode.target, there)
        assert_close(found[-1], unreachable, atol=1e-3, rtol=0)
        assert float(unreachable.min()) < 0.1 and float(unreachable.max()) > 0.9
        assert float(predicted[:, 0].std()) > 0.1
        if name == "map":
            assert_close(found[1], predicted[:, 1], atol=2e-3, rtol=0)
            nearest = torch.cdist(where, visited).amin(dim=-1)
            assert_close(found[2], torch.exp(-0.5 * (nearest / 0.08) ** 2), atol=1e-4, rtol=0)
            assert float(found[2].view(side, side)[side // 2, side // 2]) == pytest.approx(1.0)


def test_numbers_stay_about_within_one(device: str) -> None:
    episode = Episode(device)
    for k in range(5):
        observation = episode.look((-0.6 + 0.08 * k, 0.3 - 0.15 * k, -0.1 + 0.08 * k))
        assert bool(observation.isfinite().all())
        assert float(observation.abs().max()) < 1.5


def test_a_smaller_layout_is_a_part_of_the_whole_vector(device: str) -> None:
    whole, small = Episode(device), Episode(device, layout=ObservationLayout(parts=("patch", "time")))
    for offset in ((-0.5, -0.2, -0.1), (-0.4, 0.25, 0.1)):
        complete, reduced = whole.look(offset), small.look(offset)
    for name in small.observer.layout.parts:
        assert_close(small.part(reduced, name), whole.part(complete, name))


def test_the_belief_holds_what_planners_need(device: str) -> None:
    episode = Episode(device)
    with pytest.raises(InvalidInputError, match="no belief before the first observe"):
        _ = episode.observer.belief
    observation = episode.look((-0.5, -0.2, -0.1), moves_left=7)
    belief = episode.observer.belief
    assert_close(belief.observation, observation)
    assert_close(belief.camera_position, episode.target + torch.tensor([-0.5, -0.2, -0.1], device=device))
    assert belief.moves_left.tolist() == [7]
    assert int(belief.memory.visits[0]) == 1
    assert_close(belief.reachable, belief.lattice.reachable(episode.target))
    kept = belief.camera_position.clone()
    episode.look((-0.4, 0.25, 0.1))
    assert_close(belief.camera_position, kept)


def test_environments_that_did_not_look_remember_nothing_new(device: str) -> None:
    episode = Episode(device, num_envs=2)
    episode.look((-0.5, -0.2, -0.1))
    first = episode.observer.memory.hits.clone()
    before = episode.observer.belief.observation
    after = episode.look((-0.4, 0.25, 0.1), mask=torch.tensor([True, False], device=device))
    assert torch.equal(after[1], before[1]) and not torch.equal(after[0], before[0])
    assert episode.observer.memory.visits.tolist() == [2, 1]
    assert_close(episode.observer.memory.hits[1], first[1])
    assert int((episode.observer.memory.hits[0] - first[0]).sum()) > 0


def test_a_saved_observer_goes_on_as_it_would_have(device: str) -> None:
    first, other = Episode(device), Episode(device)
    first.look((-0.5, -0.2, -0.1))
    other.observer.begin(torch.tensor([0], device=device), other.target + 0.3)
    other.observer.load_state_dict(first.observer.state_dict())
    for offset in ((-0.4, 0.25, 0.1), (-0.35, 0.05, 0.15)):
        assert torch.equal(first.look(offset), other.look(offset))
    with pytest.raises(
        InvalidInputError, match=r"state\['reachable'\] must have shape \(1, 468\), got nothing"
    ):
        other.observer.load_state_dict({})


def test_observers_and_layouts_that_make_no_sense_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="a part of the observation must be one of"):
        ObservationLayout(parts=("pose", "smell"))  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="each part once"):
        ObservationLayout(parts=("pose", "pose"))
    with pytest.raises(InvalidInputError, match="max_moves must be at least 1, got 0"):
        ViewpointObserver(max_moves=0)
    episode = Episode()
    poses = episode.poses((-0.5, 0.0, 0.0))
    with pytest.raises(InvalidInputError, match=r"viewpoint must have shape \(1, 6\), got \(1, 3\)"):
        episode.observer.observe(
            torch.zeros(1, 3), poses, episode.view(poses), torch.zeros(1), torch.zeros(1)
        )
