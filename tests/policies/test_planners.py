"""The planners in a small world: real plants, a camera that flies freely in a box in front of them, no robot."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.assets import asset_path
from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.learning.imitation.imitation_config import RegressionConfig
from maniskill_tomato.learning.imitation.move_to_see_training import MoveToSeeData, train_move_network
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.policies import baselines, moves
from maniskill_tomato.policies.baselines import FixedSweep, LookAtServoing, RandomStep, RandomViewpoint, Stay
from maniskill_tomato.policies.deep_move_to_see import (
    DeepMoveToSee,
    MoveNetwork,
    load_deep_move_to_see,
    network_input,
    save_deep_move_to_see,
)
from maniskill_tomato.policies.gradient_view import GradientView, expected_visible_share
from maniskill_tomato.policies.greedy_truth import GreedyTruth, greedy_directions
from maniskill_tomato.policies.lattice_planner import Candidates
from maniskill_tomato.policies.move_to_see import MoveToSee, MoveToSeeOnMemory, camera_array, size_gradient
from maniskill_tomato.policies.next_best_view import NextBestDirection, NextBestView
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.oracle import Oracle, OracleSearch
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.policies.registry import PLANNERS, PRIVILEGED
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import ray_pattern
from maniskill_tomato.robot.camera_reach import CameraReach
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.look_at import camera_to_viewpoint, look_at_pose, look_frame
from maniskill_tomato.robot.look_at_move import MAX_MOVE, MIN_DISTANCE, moved_position
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.observation import ObservationLayout, ViewpointObserver

HORIZON = 20
GOOD = 0.8
SEEDS = (3, 5, 8, 13)
"""Plants of the world."""


@dataclass(frozen=True)
class Box:
    """Where the camera may fly, in [m]."""

    low: tuple[float, float, float] = (-0.1, -0.6, 0.3)
    high: tuple[float, float, float] = (0.55, 0.6, 1.5)

    def holds(self, positions: Tensor, target: Tensor | None = None) -> Tensor:
        low, high = positions.new_tensor(self.low), positions.new_tensor(self.high)
        return ((positions >= low) & (positions <= high)).all(dim=-1)


class Truth:
    """A ground truth without an arm: every way can be followed."""

    threshold = GOOD

    def visible_fraction(
        self, T_world_camera: Tensor, env_index: int = 0, qpos: Tensor | None = None
    ) -> Tensor:
        raise NotImplementedError

    def clearance(self, start_qpos: Tensor, end_qpos: Tensor, env_index: int = 0) -> Tensor:
        raise NotImplementedError

    def can_follow(
        self, start: Tensor, way: Tensor, target: Tensor, env_index: int = 0, *, contact_free: bool = False
    ) -> bool:
        return True


class FreeWorld(Truth):
    """A camera flies within a box before plants and sees a tomato; episodes as the general task has them."""

    num_envs = 1
    device = torch.device("cpu")
    keeps_belief = True

    def __init__(self, plants: list[Plant], box: Box = Box()) -> None:
        self._plants = plants
        self._box = box
        self._scene = RayScene(plants[:1], color_intrinsics())
        self._observer = ViewpointObserver(1, layout=ObservationLayout.without_memory(), max_moves=HORIZON)
        self._T_world_plant = torch.eye(4)
        self._T_world_plant[0, 3] = 0.85
        self.agent = SimpleNamespace(robot=SimpleNamespace(get_qpos=lambda: torch.zeros(1, 7)))
        self.ground_truth = self

    @property
    def unwrapped(self) -> "FreeWorld":
        return self

    @property
    def belief(self) -> Belief:
        belief = self._observer.belief
        candidates = belief.lattice.positions(belief.target_position)
        values = {**vars(belief), "reachable": self._box.holds(candidates)}
        return Belief(**values)

    def visible_fraction(
        self, T_world_camera: Tensor, env_index: int = 0, qpos: Tensor | None = None
    ) -> Tensor:
        return self._scene.visible_fraction_from(
            T_world_camera, self._fruit, self._T_world_plant, env_idx=env_index
        )

    def reset(self, *, seed: int, options: Any = None) -> tuple[Tensor, dict[str, Tensor]]:
        rng = np.random.default_rng(seed)
        plant = self._plants[int(rng.integers(len(self._plants)))]
        self._scene.replace_plants({0: plant})
        ripe = [i for i, f in enumerate(plant.fruits) if f.ripeness == "ripe" and 0.4 < f.centre[2] < 1.2]
        while True:
            self._fruit = int(rng.choice(ripe))
            self._target = torch.from_numpy(plant.fruits[self._fruit].centre) + self._T_world_plant[:3, 3]
            position = torch.from_numpy(rng.uniform((0.0, -0.4, 0.5), (0.35, 0.4, 1.2))).float()
            pose = look_at_pose(position, self._target)[None]
            if float(self.visible_fraction(pose, 0)) < 0.3:
                break
        self._position, self._elapsed, self._held = position, 0, False
        self._observer.begin(torch.zeros(1, dtype=torch.int64), self._target[None])
        return self._look()

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Tensor]]:
        goal = moved_position(self._position, self._target, action[0])
        self._held = not bool(self._box.holds(goal))
        self._position = self._position if self._held else goal
        self._elapsed += 1
        observation, info = self._look()
        truncated = torch.tensor([self._elapsed >= HORIZON])
        return observation, info["visible_fraction"], info["success"], truncated, info

    def _look(self) -> tuple[Tensor, dict[str, Tensor]]:
        pose = look_at_pose(self._position, self._target)[None]
        fruit, plant = torch.tensor([self._fruit]), self._T_world_plant[None]
        seen = self._scene.visibility(pose, fruit, plant).visible_fraction
        rays = self._scene.view_rays(pose, fruit, self._target[None], plant)
        viewpoint = camera_to_viewpoint(pose, torch.tensor([[0.0, math.pi / 2, 0.0]]))
        left = torch.tensor([HORIZON - self._elapsed])
        observation = self._observer.observe(viewpoint, pose, rays, seen, left)
        info = {
            "visible_fraction": seen,
            "success": seen > GOOD,
            "reachability": torch.tensor([2 if self._held else 0]),
        }
        return observation, info


@pytest.fixture(scope="module")
def world() -> FreeWorld:
    return FreeWorld([generate_plant("full", seed) for seed in SEEDS])


def anywhere(positions: Tensor, target: Tensor) -> Tensor:
    return Box().holds(positions)


def camera_of(episode: EpisodeRecord) -> Any:
    """Where the camera was at every view. Shape (T + 1, 3)."""
    assert episode.camera is not None
    return episode.camera


def run(world: FreeWorld, planner: Planner, episodes: range) -> list[EpisodeRecord]:
    world_as_env: Any = world
    return [run_episode(world_as_env, planner, i) for i in episodes]


def belief_at(position: Tensor, target: Tensor, world: FreeWorld) -> Belief:
    """The world's present belief with camera and target elsewhere."""
    values = {**vars(world.belief), "camera_position": position[None], "target_position": target[None]}
    return Belief(**values)


# ------------------------------------------------------------------- moves


def test_a_move_brings_the_camera_to_a_near_goal_and_a_full_move_towards_a_far_one() -> None:
    position, target = torch.tensor([[0.2, 0.1, 0.8]]), torch.tensor([[0.8, 0.0, 0.9]])
    for shift in (torch.tensor([[0.03, -0.05, 0.02]]), torch.tensor([[-0.3, 0.4, 0.1]])):
        action = moves.move_towards(position, target, position + shift)
        moved = (look_frame(position, target) @ action[..., None])[..., 0] * MAX_MOVE
        length = min(float(shift.norm()), MAX_MOVE)
        torch.testing.assert_close(moved, shift / shift.norm() * length)


def test_stops_are_equal_moves_that_end_at_the_goal() -> None:
    start, goal = torch.zeros(3), torch.tensor([0.0, 0.3, 0.0])
    way = moves.stops(start, goal)
    torch.testing.assert_close(way[:, 1], torch.tensor([0.1, 0.2, 0.3]))
    assert len(moves.stops(start, torch.tensor([0.12, 0.0, 0.0]))) == 1
    assert len(moves.stops(start, torch.tensor([0.1201, 0.0, 0.0]))) == 2


# --------------------------------------------------------------- baselines


def test_stay_stays_and_a_random_step_is_a_full_one_that_its_seed_repeats(world: FreeWorld) -> None:
    world.reset(seed=0)
    assert float(Stay().act(world.belief).abs().max()) == 0.0
    planner = RandomStep(seed=4)
    first = [planner.act(world.belief) for _ in range(3)]
    assert all(float(step.norm()) == pytest.approx(1.0) for step in first)
    planner.reseed(4)
    torch.testing.assert_close([planner.act(world.belief) for _ in range(3)], first)


def test_a_random_viewpoint_is_one_of_the_reachable_candidates(world: FreeWorld) -> None:
    ends = 0
    for seed in range(6):
        episode = run(world, RandomViewpoint(), range(seed, seed + 1))[0]
        world.reset(seed=seed)
        belief = world.belief
        allowed = belief.lattice.positions(belief.target_position)[0][belief.reachable[0]].double()
        gaps = torch.cdist(torch.from_numpy(camera_of(episode)[1:]), allowed).min(dim=1).values.numpy()
        full = np.linalg.norm(np.diff(camera_of(episode), axis=0), axis=1) > 0.999 * MAX_MOVE
        # A move is a full one, or ends at a candidate, or was cut short by the smallest distance.
        near = np.linalg.norm(camera_of(episode)[1:] - episode.target[1:], axis=1) < MIN_DISTANCE + 1e-4
        assert np.all(full | (gaps < 1e-4) | near)
        ends += int((gaps < 1e-4).sum())
    assert ends > 3


def test_the_fixed_sweep_visits_its_pattern_from_the_nearest_corner(world: FreeWorld) -> None:
    world.reset(seed=1)
    planner = FixedSweep()
    target = world.belief.target_position[0]
    offsets = baselines.sweep_offsets(target)
    assert offsets.norm(dim=1).numpy() == pytest.approx(np.full(9, baselines.SWEEP_DISTANCE))
    # All are on the robot's side, the middle column straight towards its base.
    assert bool(((offsets[:, :2] @ -target[:2]) > 0).all())
    middle = offsets[1::3, :2] / offsets[1::3, :2].norm(dim=1, keepdim=True)
    torch.testing.assert_close(middle, (-target[:2] / target[:2].norm()).expand(3, 2))
    planner.begin(world.belief, torch.tensor([0]))
    route = planner._route[0]
    start = world.belief.camera_position[0]
    corners = route[[0, 2, 6, 8]]
    assert int((corners - start).norm(dim=1).argmin()) == 0
    # Each step of the route goes to a neighbour in the pattern, never across it.
    assert float(route.diff(dim=0).norm(dim=1).max()) < 0.75 * float(torch.pdist(route).max())


def test_look_at_servoing_moves_away_from_what_covers_one_side(world: FreeWorld) -> None:
    world.reset(seed=0)
    belief = world.belief
    pattern = torch.from_numpy(ray_pattern())
    near = pattern.norm(dim=1) < 0.03
    label = torch.where(near & (pattern[:, 0] > 0), 2, torch.where(near, 3, 1)).to(torch.int8)[None]
    rays = type(belief.rays)(belief.rays.direction_c, belief.rays.distance, label)
    position = belief.target_position + torch.tensor([[-0.6, 0.0, 0.0]])
    changed = Belief(**{**vars(belief), "rays": rays, "camera_position": position})
    right, up, forward = LookAtServoing().act(changed)[0].tolist()
    assert right > 0.6
    assert abs(up) < 0.1
    assert forward > 0.6


# ------------------------------------------------------- 3D Move To See


def test_the_gradient_of_a_linear_size_is_found_exactly() -> None:
    offsets = camera_array()
    slope = torch.tensor([0.8, -2.0, 1.1])
    outer = 0.3 * (1.0 + offsets @ slope)[None]
    found = size_gradient(torch.tensor([0.3]), outer, offsets)[0]
    torch.testing.assert_close(found, slope, atol=1e-4, rtol=1e-4)


def test_the_camera_array_has_the_published_radius_and_tilt() -> None:
    offsets = camera_array()
    assert offsets.shape == (8, 3)
    assert sorted({round(abs(float(x)), 4) for x in offsets[:, :2].flatten()}) == [0.0, 0.07]
    edges = offsets[offsets[:, :2].norm(dim=1) < 0.08]
    sphere_centre = torch.tensor([0.0, 0.0, 0.14])
    inwards = sphere_centre - edges
    tilt = torch.rad2deg(torch.acos(inwards[:, 2] / inwards.norm(dim=1)))
    torch.testing.assert_close(tilt, torch.full((4,), 30.0), atol=1e-3, rtol=0.0)


def test_cameras_that_see_nothing_give_no_gradient() -> None:
    offsets = camera_array()
    assert float(size_gradient(torch.tensor([0.0]), torch.ones(1, 8), offsets).abs().max()) == 0.0
    some = torch.tensor([[0.5, 0.5, 0.0, 0.5, 0.5, 0.0, 0.5, 0.5]])
    assert float(size_gradient(torch.tensor([0.5]), some, offsets).abs().max()) < 1e-5


def test_move_to_see_approaches_a_target_that_nothing_covers(world: FreeWorld) -> None:
    class Unhidden(Truth):
        def visible_fraction(
            self, T_world_camera: Tensor, env_index: int = 0, qpos: Tensor | None = None
        ) -> Tensor:
            return torch.ones(len(T_world_camera))

    world.reset(seed=0)
    right, up, forward = MoveToSee(Unhidden()).act(world.belief)[0].tolist()
    assert forward > 0.95
    assert abs(right) < 0.1 and abs(up) < 0.1


# ---------------------------------------------------------- gradient view


def test_the_differentiable_map_agrees_with_the_memorys_prediction(world: FreeWorld) -> None:
    world.reset(seed=3)
    for action in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.3]):
        world.step(torch.tensor([action]))
    belief = world.belief
    candidates = belief.lattice.positions(belief.target_position)[:, 1::4]
    expected = belief.memory.predict(candidates)[0, :, 0]
    count = candidates.shape[1]
    density = belief.memory.density.expand(count, -1, -1, -1)
    found = expected_visible_share(density, candidates[0], belief.target_position.expand(count, 3))
    # One walks from voxel to voxel, the other interpolates between their centres along 9 other rays.
    assert float(torch.corrcoef(torch.stack([found, expected]))[0, 1]) > 0.9
    assert float((found - expected).abs().mean()) < 0.1


def test_the_maps_gradient_agrees_with_finite_differences(world: FreeWorld) -> None:
    world.reset(seed=3)
    world.step(torch.tensor([[1.0, 0.0, 0.0]]))
    density = world.belief.memory.density.double()
    target = world.belief.target_position.double()
    place = (world.belief.camera_position.double() + 0.01).requires_grad_()
    (gradient,) = torch.autograd.grad(expected_visible_share(density, place, target).sum(), place)
    for axis in range(3):
        step = torch.zeros(1, 3, dtype=torch.float64)
        step[0, axis] = 1e-6
        up = expected_visible_share(density, place.detach() + step, target)
        down = expected_visible_share(density, place.detach() - step, target)
        # The disc of rays turns with the look frame, in the gradient as in the differences.
        assert float(gradient[0, axis]) == pytest.approx(float((up - down) / 2e-6), abs=1e-4, rel=1e-3)


def test_a_gradient_step_raises_the_expected_share(world: FreeWorld) -> None:
    raised = 0
    for seed in range(6):
        world.reset(seed=seed)
        belief = world.belief
        density = belief.memory.density
        planner = GradientView(reachable=anywhere)
        planner.begin(belief, torch.tensor([0]))
        action = planner.act(belief)
        frame = look_frame(belief.camera_position, belief.target_position)
        moved = belief.camera_position + MAX_MOVE * (frame @ action[..., None])[..., 0]
        before = expected_visible_share(density, belief.camera_position, belief.target_position)
        raised += int(expected_visible_share(density, moved, belief.target_position) > before)
    assert raised >= 5


# ------------------------------------------------------- next-best view


def test_a_costly_way_keeps_the_next_best_view_near(world: FreeWorld) -> None:
    world.reset(seed=7)
    ways = []
    for cost in (0.0, 10.0):
        planner = NextBestView(move_cost=cost)
        planner.begin(world.belief, torch.tensor([0]))
        planner.act(world.belief)
        candidates = world.belief.lattice.positions(world.belief.target_position)[0]
        way = (candidates[planner.tried.chosen] - world.belief.camera_position).norm()
        ways.append(float(way))
    candidates = world.belief.lattice.positions(world.belief.target_position)[0]
    allowed = candidates[world.belief.reachable[0]]
    assert ways[1] == pytest.approx(
        float((allowed - world.belief.camera_position).norm(dim=1).min()), abs=1e-5
    )
    assert ways[0] > ways[1]


def test_a_view_that_was_looked_from_is_worth_what_was_measured(world: FreeWorld) -> None:
    world.reset(seed=7)
    belief = world.belief
    planner = NextBestView(move_cost=0.0)
    planner.begin(belief, torch.tensor([0]))
    planner.act(belief)
    here = belief.camera_position[:, None]
    assert float(planner.worth(belief, here)) == pytest.approx(float(belief.visible_fraction), abs=1e-4)
    opposite = 2.0 * belief.target_position[:, None] - here
    predicted = float(belief.memory.predict(opposite)[0, 0, 0])
    assert float(planner.worth(belief, opposite)) == pytest.approx(predicted, abs=1e-4)


def test_the_next_best_direction_keeps_its_distance(world: FreeWorld) -> None:
    for episode in run(world, NextBestDirection(), range(4)):
        distance = np.linalg.norm(camera_of(episode) - episode.target, axis=1)
        # A straight move between two points of a sphere stops inside it.
        assert distance.max() <= distance[0] + 1e-4
        assert distance[-1] > 0.6 * distance[0]


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="move_cost"):
        NextBestView(move_cost=math.nan)
    with pytest.raises(InvalidInputError, match="batch_size"):
        RegressionConfig(batch_size=0)


# ------------------------------------------------------------ with the truth


def test_greedy_takes_the_best_of_26_moves(world: FreeWorld) -> None:
    world.reset(seed=5)
    belief = world.belief
    position, target = belief.camera_position[0], belief.target_position[0]
    planner = GreedyTruth(world, reachable=anywhere)
    planner.begin(belief, torch.tensor([0]))
    action = planner.act(belief)[0]
    best, best_seen = None, -1.0
    for direction in greedy_directions():
        place = position + MAX_MOVE * look_frame(position, target) @ direction
        if not bool(anywhere(place[None], target)) or float((place - target).norm()) < MIN_DISTANCE:
            continue
        seen = float(world.visible_fraction(look_at_pose(place, target)[None], 0))
        if seen > best_seen:
            best, best_seen = direction, seen
    assert best is not None
    torch.testing.assert_close(action, best)


def test_the_oracles_way_keeps_to_reachable_stops_and_bends_where_it_must() -> None:
    """V_f is good only behind a wall in which no move may end."""

    class BehindTheWall(Truth):
        def visible_fraction(
            self, T_world_camera: Tensor, env_index: int = 0, qpos: Tensor | None = None
        ) -> Tensor:
            place = T_world_camera[:, :3, 3]
            near: Tensor = (place - torch.tensor([0.3, 0.3, 1.0])).norm(dim=1) < 0.06
            return near.float()

    def allowed(positions: Tensor, target: Tensor) -> Tensor:
        free: Tensor = (positions[:, 1] - 0.15).abs() > 0.04
        return free

    start, target = torch.tensor([0.3, 0.0, 1.0]), torch.tensor([1.2, 0.0, 1.0])
    solution = OracleSearch(BehindTheWall(), reachable=allowed).solve(start, target)
    assert solution is not None
    way = torch.cat([start[None], solution.stops])
    assert float(way.diff(dim=0).norm(dim=1).max()) <= MAX_MOVE * 1.0001
    assert bool(allowed(solution.stops, target).all())
    # The good places begin 0.24 m away, two moves, the first of which would end in the wall (0.11 m to 0.19 m).
    assert solution.moves == 3
    no_wall = OracleSearch(BehindTheWall(), reachable=lambda p, t: torch.ones(len(p), dtype=torch.bool))
    straight = no_wall.solve(start, target)
    # 0.24 m is exactly two moves, and no sample stands exactly there.
    assert straight is not None and straight.moves in (2, 3)


def test_the_oracle_says_where_nothing_can_be_seen() -> None:
    class Hidden(Truth):
        def visible_fraction(
            self, T_world_camera: Tensor, env_index: int = 0, qpos: Tensor | None = None
        ) -> Tensor:
            return torch.zeros(len(T_world_camera))

    search = OracleSearch(Hidden(), reachable=lambda p, t: Box().holds(p))
    assert search.solve(torch.tensor([0.2, 0.0, 0.8]), torch.tensor([0.85, 0.0, 0.9]), most_moves=4) is None


@pytest.mark.parametrize(("count", "fewest"), [(4, 3), pytest.param(8, 6, marks=pytest.mark.slow)])
def test_no_planner_needs_fewer_moves_than_the_oracle(world: FreeWorld, count: int, fewest: int) -> None:
    episodes = range(count)
    oracle = run(world, Oracle(OracleSearch(world, reachable=anywhere)), episodes)
    assert sum(e.success for e in oracle) >= fewest
    planners = [
        RandomViewpoint(),
        FixedSweep(),
        MoveToSee(world),
        MoveToSeeOnMemory(),
        GradientView(reachable=anywhere),
        NextBestView(),
        NextBestDirection(),
        GreedyTruth(world, reachable=anywhere),
        LookAtServoing(),
    ]
    for planner in planners:
        for episode, best in zip(run(world, planner, episodes), oracle, strict=True):
            if episode.success:
                assert best.success, (planner.name, episode.seed)
                assert best.steps <= episode.steps, (planner.name, episode.seed)


def test_planning_on_memory_beats_random_motion(world: FreeWorld) -> None:
    episodes = range(100, 130)
    solved = {
        planner.name: sum(e.success for e in run(world, planner, episodes))
        for planner in (Stay(), RandomStep(), NextBestView(), NextBestDirection())
    }
    assert solved["stay"] == 0
    assert solved["nbv"] >= solved["random_step"] + 8
    assert solved["nbv_direction"] >= solved["random_step"] + 8


def test_episodes_do_not_depend_on_the_ones_before(world: FreeWorld) -> None:
    for planner in (RandomViewpoint(), NextBestView(), GradientView(reachable=anywhere), FixedSweep()):
        alone = run(world, planner, range(9, 10))[0]
        after = run(world, planner, range(7, 10))[-1]
        np.testing.assert_allclose(camera_of(after), camera_of(alone), atol=1e-6)


def test_reach_is_that_of_the_lattice(world: FreeWorld) -> None:
    world.reset(seed=0)
    lattice, target = world.belief.lattice, world.belief.target_position
    expected = lattice.reachable(target)[0]
    found = CameraReach().reachable(lattice.positions(target)[0], target[0])
    # The moves keep the flange off the floor and the robot's base besides.
    assert not bool((found & ~expected).any())
    assert float((found == expected).float().mean()) > 0.97
    assert 0.1 < float(found.float().mean()) < 0.95


# ---------------------------------------------------------- deep variant


def test_the_network_learns_the_moves_and_keeps_them_on_disk(world: FreeWorld, tmp_path: Any) -> None:
    pictures, distances, wanted = [], [], []
    teacher = MoveToSee(world)
    walk = RandomStep(seed=1)
    for seed in range(20):
        world.reset(seed=seed)
        for _ in range(8):
            picture, distance = network_input(world.belief)
            pictures.append(picture)
            distances.append(distance)
            wanted.append(teacher.act(world.belief))
            world.step(walk.act(world.belief))
    data = MoveToSeeData(torch.cat(pictures), torch.cat(distances), torch.cat(wanted))
    told: list[tuple[float, float]] = []
    network = train_move_network(
        data, RegressionConfig(epochs=12, batch_size=16), lambda epoch, loss, held: told.append((loss, held))
    )
    assert told[-1][0] < 0.6 * told[0][0]
    mean_only = float((data.moves - data.moves.mean(dim=0)).square().mean())
    assert told[-1][0] < 0.8 * mean_only

    save_deep_move_to_see(tmp_path / "network.pt", DeepMoveToSee(network))
    again = open_policy(tmp_path / "network.pt", env_id="TomatoViewpoint-v1")
    world.reset(seed=30)
    torch.testing.assert_close(again.act(world.belief), DeepMoveToSee(network).act(world.belief))
    assert float(again.act(world.belief).norm()) <= 1.0 + 1e-6


def test_a_file_that_is_no_network_is_refused(tmp_path: Any) -> None:
    (tmp_path / "x.pt").write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load_deep_move_to_see(tmp_path / "x.pt")
    with pytest.raises(CheckpointError, match=r"no network of deep_3dmts; .*train-deep-3dmts"):
        load_deep_move_to_see(asset_path("policies/TomatoViewpoint-v1.pt"))
    few = MoveToSeeData(torch.zeros(5, 4, 16, 16), torch.ones(5), torch.zeros(5, 3))
    with pytest.raises(InvalidInputError, match="too few"):
        train_move_network(few)
    assert MoveNetwork()(torch.zeros(2, 4, 16, 16), torch.ones(2)).shape == (2, 3)


# -------------------------------------------------------------- by name


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_is_opened_by_name_and_gives_moves(world: FreeWorld, name: str) -> None:
    world.reset(seed=4)
    planner = open_policy(name, env_id="TomatoViewpoint-v1", ground_truth=world)
    assert planner.name == name
    assert planner.needs_truth == (name in PRIVILEGED)
    planner.begin(world.belief, torch.tensor([0]))
    move = planner.act(world.belief)
    assert move.shape == (1, 3)
    assert bool(torch.isfinite(move).all()) and float(move.norm()) <= 1.0 + 1e-5


def test_a_view_that_was_taken_is_not_taken_again(world: FreeWorld) -> None:
    world.reset(seed=4)
    belief = world.belief
    tried = Candidates()
    tried.begin(belief, torch.tensor([0]))
    here = belief.camera_position[:, None]
    positions = torch.cat(
        [here + torch.tensor([0.0, 0.02, 0.0]), here + torch.tensor([0.0, 0.05, 0.0])], dim=1
    )
    tried.refused = torch.zeros(1, 2, dtype=torch.bool)
    allowed = tried.choosable(belief, positions, torch.ones(1, 2, dtype=torch.bool))
    tried.move_to_best(belief, positions, torch.tensor([[9.0, 1.0]]).where(allowed, -math.inf))
    assert int(tried.chosen[0]) == 1  # 2 cm away the camera sees what it sees here, 5 cm away it does not.


def test_after_a_refusal_the_directions_round_it_wait_until_the_camera_has_moved(world: FreeWorld) -> None:
    world.reset(seed=4)
    belief = world.belief
    tried = Candidates()
    tried.begin(belief, torch.tensor([0]))
    tried.refused = torch.zeros(1, 4, dtype=torch.bool)
    directions = [math.radians(degrees) for degrees in (0.0, 20.0, 40.0, 180.0)]
    steps = torch.tensor([[math.cos(a), math.sin(a), 0.0] for a in directions])
    positions = belief.camera_position[:, None] + 0.3 * steps[None]
    worth, allowed = torch.tensor([[4.0, 3.0, 2.0, 1.0]]), torch.ones(1, 4, dtype=torch.bool)

    def choose() -> int:
        choosable = tried.choosable(belief, positions, allowed)
        tried.move_to_best(belief, positions, worth.where(choosable, -math.inf))
        return int(tried.chosen[0])

    assert choose() == 0
    tried.note_refusals(belief)  # The camera is where it was.
    assert choose() == 2  # 20 degrees is within 30 of the refused one.
    moved = replace(belief, camera_position=belief.camera_position + 0.05)
    tried.note_refusals(moved)
    assert choose() == 1  # Only the refused candidate itself is given up for good.
