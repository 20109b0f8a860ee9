"""Ways that planners follow by kinematics, against the moves that a world's arm really makes."""

import math

import numpy as np
import pytest
import torch

from maniskill_tomato.policies.followed_ways import SAME_PLACE, WayFollower
from maniskill_tomato.policies.lattice_planner import FOLLOWED, LatticePlanner, way_to
from maniskill_tomato.policies.moves import move_towards, moves_needed
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.tasks.making import make_world
from maniskill_tomato.tasks.world import World

ONE = torch.tensor([0])


@pytest.fixture(scope="module")
def world() -> World:
    return make_world("TomatoViewpoint-v1", plant={"seed": 1})


def really_made(world: World, seed: int, goal: torch.Tensor) -> float:
    """Moves of the world's own arm straight to a goal; infinite if it refuses one."""
    world.reset(seed)
    for count in range(1, 11):
        before = world.belief.camera_position
        world.step(move_towards(before, world.belief.target_position, goal[None]))
        after = world.belief.camera_position
        if int(world.state.reach[0]) == Reach.UNREACHABLE or float((after - before).norm()) < 0.1 * MAX_MOVE:
            return math.inf
        if float((goal - after[0]).norm()) < SAME_PLACE:
            return float(count)
    return math.nan


@pytest.mark.parametrize("seed", [3, 5])
def test_ways_are_those_that_the_arm_makes(world: World, seed: int) -> None:
    world.reset(seed)
    belief = world.belief
    qpos, position, target = world.state.qpos, belief.camera_position, belief.target_position
    near = (way_to(belief, belief.lattice.positions(target))[0] < 8 * MAX_MOVE).nonzero()[:, 0]
    picked = near[torch.as_tensor(np.random.default_rng(seed).permutation(len(near))[:14])]
    goals = belief.lattice.positions(target)[0, picked]
    qpos, position, target = (tensor.expand(len(goals), -1) for tensor in (qpos, position, target))
    moves = WayFollower().moves_along(qpos, position, target, goals).tolist()
    assert moves == [really_made(world, seed, goal) for goal in goals]
    assert any(math.isinf(count) for count in moves) and any(math.isfinite(count) for count in moves)


class OneWish(LatticePlanner):
    """Wants one candidate much and the others by their nearness."""

    name = "one_wish"

    def __init__(self, wish: int) -> None:
        super().__init__()
        self._wish = wish

    def worth(self, belief: Belief, views: torch.Tensor) -> torch.Tensor:
        worth = -moves_needed(way_to(belief, views))
        worth[:, self._wish] = 100.0
        return worth


def test_a_planner_spends_no_move_on_a_way_that_the_arm_cannot_go(world: World) -> None:
    world.reset(3)
    belief = world.belief
    views = belief.lattice.positions(belief.target_position)
    count = belief.lattice.size
    now = (world.state.qpos, belief.camera_position, belief.target_position)
    qpos, position, target = (tensor.expand(count, -1) for tensor in now)
    moves = WayFollower().moves_along(qpos, position, target, views[0])
    blocked = (belief.reachable[0] & moves.isinf() & (way_to(belief, views)[0] > 0.06)).nonzero()[:, 0]
    free = (belief.reachable[0] & moves.isfinite() & (way_to(belief, views)[0] > 0.06)).nonzero()[:, 0]
    for wish, is_taken in ((int(blocked[0]), False), (int(free[0]), True)):
        planner = OneWish(wish)
        planner.begin(belief, ONE)
        planner.act(belief)
        assert (int(planner.tried.chosen[0]) == wish) is is_taken
        assert math.isfinite(float(moves[planner.tried.chosen[0]]))


class Wishes(LatticePlanner):
    """Wants some candidates more than all others."""

    name = "wishes"

    def __init__(self, wishes: torch.Tensor) -> None:
        super().__init__()
        self._wishes = wishes

    def worth(self, belief: Belief, views: torch.Tensor) -> torch.Tensor:
        worth = -moves_needed(way_to(belief, views))
        worth[:, self._wishes] += 100.0
        return worth


def moves_to_all(world: World) -> torch.Tensor:
    """Moves that the arm needs to each candidate, infinite where it refuses one. Shape (K,)."""
    belief = world.belief
    now = (world.state.qpos, belief.camera_position, belief.target_position)
    qpos, position, target = (tensor.expand(belief.lattice.size, -1) for tensor in now)
    return WayFollower().moves_along(
        qpos, position, target, belief.lattice.positions(belief.target_position)[0]
    )


def out_of_the_arms_way(world: World) -> torch.Tensor:
    """Candidates within its reach to which the arm cannot go straight from here. Shape (n,)."""
    belief = world.belief
    away = way_to(belief, belief.lattice.positions(belief.target_position))[0]
    return (belief.reachable[0] & moves_to_all(world).isinf() & (away > 0.06)).nonzero()[:, 0]


def test_a_planner_looks_for_a_way_that_the_arm_can_go_however_many_it_cannot(world: World) -> None:
    seed = 0
    world.reset(seed)
    while len(out_of_the_arms_way(world)) <= 2 * FOLLOWED:
        seed += 1
        assert seed < 40
        world.reset(seed)
    planner = Wishes(out_of_the_arms_way(world))
    planner.begin(world.belief, ONE)
    planner.act(world.belief)
    assert math.isfinite(float(moves_to_all(world)[planner.tried.chosen[0]]))
