"""The lattice of camera positions: places worked out by hand, neighbours, and the arm's reach."""

import math

import pytest
import torch
from torch.testing import assert_close

from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, camera_to_flange, flange_to_camera, look_at_pose
from maniskill_tomato.sensing.view_lattice import (
    AZIMUTHS,
    DISTANCE_RATIO,
    DISTANCES,
    ELEVATIONS,
    FIRST_DISTANCE,
    ViewLattice,
)

TARGET = torch.tensor([[0.75, 0.05, 0.9]])


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def lattice(request: pytest.FixtureRequest) -> ViewLattice:
    return ViewLattice(request.param)


def test_candidates_stand_where_their_angles_and_distance_say(lattice: ViewLattice) -> None:
    positions = lattice.positions(TARGET.to(lattice.device))[0].cpu() - TARGET[0]
    assert positions.shape == (lattice.size, 3)
    front = int(lattice.index(AZIMUTHS // 2, ELEVATIONS // 2, 0))
    assert_close(positions[front], torch.tensor([-FIRST_DISTANCE, 0.0, 0.0]), atol=1e-6, rtol=0)
    right = int(lattice.index(AZIMUTHS - 1, ELEVATIONS // 2, 1))
    assert_close(
        positions[right], torch.tensor([0.0, -FIRST_DISTANCE * DISTANCE_RATIO, 0.0]), atol=1e-6, rtol=0
    )
    highest = int(lattice.index(AZIMUTHS // 2, ELEVATIONS - 1, 0))
    up = FIRST_DISTANCE * torch.tensor([-math.cos(math.pi / 3), 0.0, math.sin(math.pi / 3)])
    assert_close(positions[highest], up, atol=1e-6, rtol=0)


def test_coordinates_and_the_nearest_candidate_find_every_candidate_again(lattice: ViewLattice) -> None:
    target = TARGET.to(lattice.device)
    positions = lattice.positions(target)
    coordinates = lattice.coordinates(target, positions)[0].cpu()
    steps = torch.cartesian_prod(torch.arange(AZIMUTHS), torch.arange(ELEVATIONS), torch.arange(DISTANCES))
    assert_close(coordinates, steps.float(), atol=1e-3, rtol=0)
    assert lattice.nearest(target, positions)[0].tolist() == list(range(lattice.size))
    far = target[:, None] + torch.tensor([[[-9.0, 0.0, 0.0]]], device=lattice.device)
    assert int(lattice.nearest(target, far)) == int(
        lattice.index(AZIMUTHS // 2, ELEVATIONS // 2, DISTANCES - 1)
    )


def test_neighbours_are_one_step_away_and_mutual(lattice: ViewLattice) -> None:
    neighbours = lattice.neighbours.cpu()
    steps = torch.cartesian_prod(torch.arange(AZIMUTHS), torch.arange(ELEVATIONS), torch.arange(DISTANCES))
    missing = 0
    for k in range(lattice.size):
        for slot, axis in enumerate((0, 0, 1, 1, 2, 2)):
            other = int(neighbours[k, slot])
            if other < 0:
                missing += 1
                continue
            difference = steps[other] - steps[k]
            assert difference.abs().sum() == 1 and int(difference[axis]) == (-1, 1)[slot % 2]
            assert int(neighbours[other, slot ^ 1]) == k
    assert missing == 2 * (ELEVATIONS * DISTANCES + AZIMUTHS * DISTANCES + AZIMUTHS * ELEVATIONS)


def test_coordinates_count_steps_of_angle_and_of_log_distance(lattice: ViewLattice) -> None:
    generator = torch.Generator().manual_seed(0)
    where = torch.rand(200, 3, generator=generator) * (torch.tensor(lattice.shape) - 1)
    azimuth = torch.deg2rad(15.0 * (where[:, 0] - AZIMUTHS // 2))
    elevation = torch.deg2rad(15.0 * (where[:, 1] - ELEVATIONS // 2))
    distance = FIRST_DISTANCE * DISTANCE_RATIO ** where[:, 2]
    level = distance * torch.cos(elevation)
    offset = torch.stack(
        [-level * torch.cos(azimuth), -level * torch.sin(azimuth), distance * torch.sin(elevation)], dim=-1
    )
    found = lattice.coordinates(TARGET.to(lattice.device), (TARGET + offset)[None].to(lattice.device))
    assert_close(found[0].cpu(), where, atol=2e-4, rtol=0)


def test_reachable_candidates_are_those_that_single_solves_reach_with_some_roll(lattice: ViewLattice) -> None:
    targets = torch.cat([TARGET, torch.tensor([[0.6, -0.2, 1.2]])]).to(lattice.device)
    reachable = lattice.reachable(targets)
    assert reachable.shape == (2, lattice.size)
    inverse_kinematics = InverseKinematics(lattice.device)
    positions = lattice.positions(targets)
    rescued = 0
    for b in range(2):
        for k in range(0, lattice.size, 23):
            poses = torch.stack([look_at_pose(positions[b, k], targets[b], roll) for roll in CAMERA_ROLLS])
            qpos_ref = torch.zeros(len(CAMERA_ROLLS), 7, device=lattice.device)
            solution = inverse_kinematics.solve(camera_to_flange(poses.double()), qpos_ref, neighbour=False)
            reached = solution.reach == Reach.REACHABLE
            assert bool(reachable[b, k]) == bool(reached.any())
            rescued += int(bool(reached.any()) and not bool(reached[0]))
            if reached.any():
                # The joints do put the camera there.
                best = int(reached.int().argmax())
                camera = flange_to_camera(forward_kinematics(solution.qpos[best : best + 1]))[0]
                assert_close(camera[:3, 3].float(), positions[b, k], atol=1e-5, rtol=0)
    assert 0.2 < float(reachable.float().mean()) < 0.9
    assert rescued > 0
