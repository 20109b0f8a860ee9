"""Inverse kinematics: solved poses against forward kinematics, refused ones against independent searches."""

import itertools
import math
from typing import Any

import mink
import mujoco
import numpy as np
import numpy.typing as npt
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import iiwa14
from maniskill_tomato.robot.inverse_kinematics import IkConfig, IkSolution, InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics

Array = npt.NDArray[np.float64]

UPPER = torch.from_numpy(iiwa14.JOINT_UPPER.copy())
TEN_DEGREES = math.radians(10.0)
BOX_LOWER = (-0.1, -0.35, 0.65, 0.0, 0.45 * math.pi, -math.pi / 8)
BOX_UPPER = (0.2, 0.25, 1.15, 0.0, 0.7 * math.pi, math.pi / 4)
"""The start poses of both tasks, x, y, z, roll, pitch, yaw: near the base axis some are out of reach."""


@pytest.fixture(scope="module")
def ik() -> InverseKinematics:
    return InverseKinematics()


def rpy_to_matrix(rpy: Tensor) -> Tensor:
    return torch.from_numpy(Rotation.from_euler("xyz", rpy.numpy()).as_matrix())


def uniform(count: int, columns: int, seed: int) -> Tensor:
    return torch.rand(count, columns, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_qpos(count: int, seed: int) -> Tensor:
    return (2 * uniform(count, 7, seed) - 1) * UPPER


def pose(position: Tensor, rotation: Tensor) -> Tensor:
    T = torch.eye(4, dtype=torch.float64).repeat(position.shape[0], 1, 1)
    T[:, :3, :3] = rotation
    T[:, :3, 3] = position
    return T


def box_poses(count: int, seed: int) -> Tensor:
    lower = torch.tensor(BOX_LOWER, dtype=torch.float64)
    upper = torch.tensor(BOX_UPPER, dtype=torch.float64)
    viewpoints = lower + (upper - lower) * uniform(count, 6, seed)
    return pose(viewpoints[:, :3], rpy_to_matrix(viewpoints[:, 3:]))


def home(count: int) -> Tensor:
    return torch.zeros(count, 7, dtype=torch.float64)


def pose_errors(T: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Distance in [m] and angle in [rad] between poses."""
    distance = (T[:, :3, 3] - wanted[:, :3, 3]).norm(dim=-1)
    turns = T[:, :3, :3].transpose(-1, -2) @ wanted[:, :3, :3]
    return distance, torch.from_numpy(Rotation.from_matrix(turns.numpy()).magnitude())


def assert_reached(solution: IkSolution, wanted: Tensor, position_atol: float, angle_atol: float) -> None:
    assert (solution.reach == Reach.REACHABLE).all(), torch.bincount(solution.reach, minlength=3)
    assert (solution.qpos.abs() <= UPPER).all()
    reached = forward_kinematics(solution.qpos)
    distance, angle = pose_errors(reached, wanted)
    assert distance.max() <= position_atol
    assert angle.max() <= angle_atol
    assert_close(solution.T_base_ee, reached, rtol=0, atol=1e-13)


def random_offsets(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Displacements within 5 cm and rotations within 10 degrees, most of them near the largest."""
    generator = torch.Generator().manual_seed(seed)

    def draw(columns: int) -> Tensor:
        return torch.randn(count, columns, generator=generator, dtype=torch.float64)

    lengths = torch.rand(count, 2, generator=generator, dtype=torch.float64) ** (1 / 6)
    direction, axis = draw(3), draw(3)
    shift = 0.05 * lengths[:, :1] * direction / direction.norm(dim=-1, keepdim=True)
    turns = TEN_DEGREES * lengths[:, 1:] * axis / axis.norm(dim=-1, keepdim=True)
    return shift, torch.from_numpy(Rotation.from_rotvec(turns.numpy()).as_matrix())


# --- Reachable poses --------------------------------------------------------------------------------------


@pytest.mark.parametrize("reference", ["home", "another", "the same"])
def test_ten_thousand_poses_of_random_joint_angles_are_all_solved(
    ik: InverseKinematics, reference: str
) -> None:
    qpos = random_qpos(10_000, seed=0)
    wanted = forward_kinematics(qpos)
    references = {"home": home(10_000), "another": random_qpos(10_000, seed=1), "the same": qpos}
    solution = ik.solve(wanted, references[reference])
    assert_reached(solution, wanted, 1e-9, 1e-9)


@pytest.mark.parametrize("reference", ["home", "another", "the same"])
def test_poses_at_every_corner_and_centre_of_the_joint_limits_are_solved(
    ik: InverseKinematics, reference: str
) -> None:
    # All of -limit, 0 and limit: stretched arm, straight shoulder and wrist, wrist on the base axis, all at once.
    levels = torch.tensor(list(itertools.product([-1.0, 0.0, 1.0], repeat=7)), dtype=torch.float64)
    qpos = levels * UPPER
    wanted = forward_kinematics(qpos)
    references = {"home": home(len(qpos)), "another": random_qpos(len(qpos), seed=1), "the same": qpos}
    assert_reached(ik.solve(wanted, references[reference]), wanted, 1e-9, 1e-9)


SINGULAR_POSES = {
    "home": (0, 0, 0, 0, 0, 0, 0),
    "straight wrist": (10, 50, -20, 70, 30, 0, 40),
    "straight shoulder": (10, 0, -20, 70, 30, 50, 40),
    "straight shoulder and wrist": (10, 0, -20, 70, 30, 0, 40),
    "stretched arm": (10, 50, -20, 0, 30, 60, 40),
    "stretched arm, straight wrist": (10, 50, -20, 0, 30, 0, 40),
    "stretched arm, straight shoulder": (10, 0, -20, 0, 30, 60, 40),
    # With the elbow at 90 degrees the wrist stands over the shoulder when tan(q2) = 0.4 / 0.42.
    "wrist on the base axis": (10, math.degrees(math.atan2(0.40, 0.42)), 0, 90, 30, 50, 40),
    "folded to the elbow's limit": (10, 30, -20, 120, 30, 50, 40),
}


@pytest.mark.parametrize("name", SINGULAR_POSES)
def test_round_trips_through_singular_poses_return_to_the_pose_and_to_the_joints(
    ik: InverseKinematics, name: str
) -> None:
    qpos = torch.deg2rad(torch.tensor([SINGULAR_POSES[name]], dtype=torch.float64))
    wanted = forward_kinematics(qpos)
    if name == "wrist on the base axis":
        wrist = wanted[0, :3, 3] - 0.126 * wanted[0, :3, 2]
        assert_close(wrist[:2], torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-12)
    elsewhere = ik.solve(wanted, random_qpos(1, seed=2))
    assert_reached(elsewhere, wanted, 1e-9, 1e-9)
    same = ik.solve(wanted, qpos)
    assert_reached(same, wanted, 1e-9, 1e-9)
    if name != "folded to the elbow's limit":
        # At full reach q4 is the root of what rounding leaves of the distance: 1e-8 for 1e-16.
        assert_close(same.qpos, qpos, rtol=0, atol=1e-7)


def test_nearly_singular_poses_are_solved_as_exactly(ik: InverseKinematics) -> None:
    generator = torch.Generator().manual_seed(3)
    qpos = random_qpos(3000, seed=4)
    tiny = 10.0 ** (-12 * torch.rand(qpos.shape, generator=generator, dtype=torch.float64))
    qpos = torch.where(torch.rand(qpos.shape, generator=generator) < 0.4, tiny, qpos)
    wanted = forward_kinematics(qpos)
    assert_reached(ik.solve(wanted, home(3000)), wanted, 1e-9, 1e-9)


def test_single_precision_poses_are_accepted_and_solved_in_double(ik: InverseKinematics) -> None:
    wanted = forward_kinematics(torch.cat([home(1), random_qpos(1000, seed=5)]))
    solution = ik.solve(wanted.float(), home(1001).float())
    assert solution.qpos.dtype == torch.float64 and solution.T_base_ee.dtype == torch.float64
    assert solution.reach.dtype == torch.int64
    # float32 rounds positions of 1 m by 6e-8; home, at full reach, is off by as much as the tolerance allows.
    assert_reached(solution, wanted, 1e-6, 2e-6)


def test_a_pose_of_the_reference_away_from_limits_gives_the_reference(ik: InverseKinematics) -> None:
    qpos = random_qpos(2000, seed=6)
    qpos = qpos[(qpos.abs() < UPPER - IkConfig().limit_margin).all(dim=-1)]
    assert len(qpos) > 500
    assert_close(ik.solve(forward_kinematics(qpos), qpos).qpos, qpos, rtol=0, atol=1e-9)


def test_a_small_change_of_pose_gives_a_small_change_of_the_joints(ik: InverseKinematics) -> None:
    qpos = random_qpos(4000, seed=7)
    regular = (qpos.abs() < UPPER - 0.3).all(dim=-1) & (torch.sin(qpos[:, [1, 3, 5]]).abs() > 0.3).all(dim=-1)
    qpos = qpos[regular]
    assert len(qpos) > 500
    wanted = forward_kinematics(qpos)
    shift, turn = random_offsets(len(qpos), seed=8)
    largest = []
    for scale in (1e-3, 1e-5):
        moved = wanted.clone()
        moved[:, :3, 3] += scale * shift / 0.05
        moved[:, :3, :3] = rpy_to_matrix(scale * torch.ones(1, 3, dtype=torch.float64)) @ wanted[:, :3, :3]
        solution = ik.solve(moved, qpos)
        assert_reached(solution, moved, 1e-9, 1e-9)
        largest.append((solution.qpos - qpos).abs().max().item())
    # Joint rates per metre stay below 1 / (0.4 m x 0.3 x 0.3) and a few more for the rotation.
    assert largest[0] < 0.05
    assert largest[1] < 5e-4


def test_a_pose_moved_by_a_nanometre_never_gives_another_posture(ik: InverseKinematics) -> None:
    # Elbows of these references stand in a plane, where several of the solver's special arm angles coincide.
    generator = torch.Generator().manual_seed(1)
    reference = 0.8 * UPPER * (2.0 * torch.rand(20_000, 7, generator=generator, dtype=torch.float64) - 1.0)
    reference[:, [0, 2]] = 0.0
    qpos = reference + 0.5 * torch.randn(reference.shape, generator=generator, dtype=torch.float64)
    T = forward_kinematics(qpos.clamp(-0.95 * UPPER, 0.95 * UPPER))
    moved = T.clone()
    moved[:, :3, 3] += 1e-9 * torch.randn(len(T), 3, generator=generator, dtype=torch.float64)
    before, after = (ik.solve(pose, reference, neighbour=False).qpos for pose in (T, moved))
    assert float((before - after).abs().max()) < 1e-3


def test_joints_follow_a_straight_path_of_the_camera_without_jumps(ik: InverseKinematics) -> None:
    qpos = torch.deg2rad(torch.tensor([[0.0, 20.0, 0.0, -70.0, 0.0, 90.0, 0.0]], dtype=torch.float64))
    start = forward_kinematics(qpos)
    for step in range(1, 101):
        wanted = start.clone()
        wanted[0, :3, 3] += step * torch.tensor([-0.001, 0.002, 0.001], dtype=torch.float64)
        solution = ik.solve(wanted, qpos)
        assert_reached(solution, wanted, 1e-9, 1e-9)
        # Steps of 2.4 mm at half a metre from the base; a change of configuration would be a jump of 1 rad.
        assert (solution.qpos - qpos).abs().max() < 0.02
        qpos = solution.qpos


def test_the_arm_moves_away_from_limits_as_far_as_the_weight_says() -> None:
    qpos = torch.deg2rad(torch.tensor([[20.0, 60.0, 168.0, 60.0, 40.0, 50.0, 10.0]], dtype=torch.float64))
    wanted = forward_kinematics(qpos)
    distances = []
    for weight in (0.0, 0.25, 10.0):
        solution = InverseKinematics(config=IkConfig(limit_weight=weight)).solve(wanted, qpos)
        assert_reached(solution, wanted, 1e-9, 1e-9)
        distances.append((UPPER[2] - solution.qpos[0, 2].abs()).item())
    assert distances[0] == pytest.approx(math.radians(2.0), abs=1e-6)
    assert distances[0] < distances[1] < distances[2]
    assert distances[2] > 0.2


def test_solving_one_by_one_gives_what_a_batch_gives(ik: InverseKinematics) -> None:
    wanted = box_poses(50, seed=9)
    batch = ik.solve(wanted, home(50))
    for i in range(50):
        single = ik.solve(wanted[i : i + 1], home(1))
        # Vector units may round the last bit of a sine otherwise in a batch of another size.
        assert_close(single.qpos[0], batch.qpos[i], rtol=0, atol=1e-9)
        assert single.reach[0] == batch.reach[i]


def test_a_batch_too_large_to_keep_buffers_for_gives_the_same(ik: InverseKinematics) -> None:
    wanted = box_poses(4200, seed=10)
    large = ik.solve(wanted, home(4200))
    small = ik.solve(wanted[:100], home(100))
    assert_close(large.qpos[:100], small.qpos, rtol=0, atol=1e-9)


def test_a_later_solve_leaves_earlier_results_alone(ik: InverseKinematics) -> None:
    first = ik.solve(box_poses(3, seed=11), home(3))
    before = first.qpos.clone(), first.reach.clone(), first.T_base_ee.clone()
    ik.solve(box_poses(3, seed=12), home(3))
    for kept, value in zip(before, (first.qpos, first.reach, first.T_base_ee), strict=True):
        assert torch.equal(kept, value)


# --- Independent searches ---------------------------------------------------------------------------------


def searched_solutions(T: Array, arm_angles: int) -> Array:
    """All eight solutions at equally spaced arm angles, limits or not. Shape (8 * arm_angles, 7).

    Goes from joint to joint along the arm, with rotations undone one after the other.
    """
    rotation, position = T[:3, :3], T[:3, 3]
    line = position - 0.126 * rotation[:, 2] - np.array([0.0, 0.0, 0.36])
    distance = np.linalg.norm(line)
    cosine = (distance**2 - 0.42**2 - 0.40**2) / (2 * 0.42 * 0.40)
    if abs(cosine) > 1.0:
        return np.empty((0, 7))
    q4 = np.arccos(cosine)
    line = line / distance
    shoulder_angle = np.arccos((distance**2 + 0.42**2 - 0.40**2) / (2 * distance * 0.42))
    helper = np.eye(3)[np.argmin(np.abs(line))]
    first = np.cross(line, helper)
    first /= np.linalg.norm(first)
    second = np.cross(line, first)
    psi = np.linspace(-np.pi, np.pi, arm_angles, endpoint=False)[:, None]
    circle = np.cos(psi) * first + np.sin(psi) * second
    upper_arm = np.cos(shoulder_angle) * line + np.sin(shoulder_angle) * circle
    solutions = []
    for sign_2, sign_4, sign_6 in itertools.product([1, -1], repeat=3):
        q1 = np.arctan2(sign_2 * upper_arm[:, 1], sign_2 * upper_arm[:, 0])
        q2 = sign_2 * np.arccos(np.clip(upper_arm[:, 2], -1, 1))
        after_2 = about_z(q1) @ about_y(q2)
        wrist_2 = np.einsum("nji,j->ni", after_2, line)
        # In frame 3 the wrist lies at -x for positive q4.
        q3 = np.arctan2(-sign_4 * wrist_2[:, 1], -sign_4 * wrist_2[:, 0])
        signed_q4 = np.full_like(q1, sign_4 * q4)
        after_4 = after_2 @ about_z(q3) @ about_y(-signed_q4)
        hand = np.swapaxes(after_4, 1, 2) @ rotation
        q6 = sign_6 * np.arccos(np.clip(hand[:, 2, 2], -1, 1))
        q5 = np.arctan2(sign_6 * hand[:, 1, 2], sign_6 * hand[:, 0, 2])
        q7 = np.arctan2(sign_6 * hand[:, 2, 1], -sign_6 * hand[:, 2, 0])
        solutions.append(np.stack([q1, q2, q3, signed_q4, q5, q6, q7], axis=-1))
    return np.concatenate(solutions)


def about_z(angle: Array) -> Array:
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def about_y(angle: Array) -> Array:
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    rows = [[c, zero, s], [zero, zero + 1, zero], [-s, zero, c]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def test_the_dense_search_of_these_tests_is_itself_right() -> None:
    wanted = forward_kinematics(random_qpos(20, seed=13))
    for T in wanted:
        found = searched_solutions(T.numpy(), 90)
        reached = forward_kinematics(torch.from_numpy(found))
        assert_close(reached, T.expand_as(reached), rtol=0, atol=1e-7)


def test_reachable_is_what_a_dense_search_over_the_arm_angle_reaches(ik: InverseKinematics) -> None:
    wanted = box_poses(1500, seed=14)
    reachable = (ik.solve(wanted, home(1500), neighbour=False).reach == Reach.REACHABLE).numpy()
    refused = np.flatnonzero(~reachable)
    accepted = np.flatnonzero(reachable)
    assert len(refused) >= 200
    for i in refused:
        found = searched_solutions(wanted[i].numpy(), 1440)
        assert not (np.abs(found) <= iiwa14.JOINT_UPPER).all(axis=-1).any()
    # The search does find what there is: it misses only intervals of the arm angle under 0.25 degrees.
    confirmed = [
        (np.abs(searched_solutions(wanted[i].numpy(), 1440)) <= iiwa14.JOINT_UPPER).all(axis=-1).any()
        for i in accepted[:300]
    ]
    assert np.mean(confirmed) > 0.99


def test_no_solution_of_a_dense_search_is_cheaper(ik: InverseKinematics) -> None:
    config = IkConfig()

    def cost(qpos: Array, reference: Array) -> Array:
        excess = (
            np.maximum(np.abs(qpos) - iiwa14.JOINT_UPPER + config.limit_margin, 0.0) / config.limit_margin
        )
        return np.asarray(np.sum((qpos - reference) ** 2 + config.limit_weight * excess**2, axis=-1))

    wanted = forward_kinematics(random_qpos(200, seed=15))
    references = random_qpos(200, seed=16)
    solution = ik.solve(wanted, references).qpos.numpy()
    gaps = []
    for T, q, reference in zip(wanted.numpy(), solution, references.numpy(), strict=True):
        found = searched_solutions(T, 720)
        found = found[(np.abs(found) <= iiwa14.JOINT_UPPER).all(axis=-1)]
        if len(found):
            gaps.append(cost(q[None], reference)[0] - cost(found, reference).min())
    assert len(gaps) > 190
    # A grid of 15 degrees may start the refinement beside the lowest valley, where two are nearly as low.
    assert np.median(gaps) <= 1e-6
    assert np.mean(np.array(gaps) > 1e-3) < 0.03
    assert max(gaps) < 0.5


def mujoco_model() -> Any:
    body, closing = "", ""
    for j in range(7):
        origin, axis = iiwa14.JOINT_ORIGINS[j], iiwa14.JOINT_AXES[j]
        limit = float(iiwa14.JOINT_UPPER[j])
        body += (
            f'<body pos="{origin[0]} {origin[1]} {origin[2]}"><joint name="{iiwa14.JOINT_NAMES[j]}" '
            f'axis="{axis[0]} {axis[1]} {axis[2]}" limited="true" range="{-limit} {limit}"/>'
            '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        )
        closing += "</body>"
    site = f'<site name="link_ee" pos="0 0 {iiwa14.EE_ORIGIN[2]}"/>'
    loader: Any = mujoco
    return loader.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><worldbody>{body}{site}{closing}</worldbody></mujoco>'
    )


def mink_reaches(model: Any, T: Array, starts: Array) -> bool:
    """Whether mink's differential inverse kinematics gets to 3e-6 m and 3e-6 rad from one of the starts."""
    task = mink.FrameTask("link_ee", "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-4)
    task.set_target(mink.SE3.from_matrix(T))
    limits = [mink.ConfigurationLimit(model)]
    for start in starts:
        configuration = mink.Configuration(model, start)
        for _ in range(60):
            velocity = mink.solve_ik(configuration, [task], 1.0, "daqp", limits=limits)
            configuration.integrate_inplace(velocity, 1.0)
            error = task.compute_error(configuration)
            if np.abs(error).max() < 3e-6:
                return True
    return False


def test_mink_reaches_no_pose_that_is_called_unreachable(ik: InverseKinematics) -> None:
    model = mujoco_model()
    wanted = box_poses(400, seed=17)
    solution = ik.solve(wanted, home(400), neighbour=False)
    refused = torch.nonzero(solution.reach == Reach.UNREACHABLE)[:40, 0].tolist()
    accepted = torch.nonzero(solution.reach == Reach.REACHABLE)[:25, 0].tolist()
    starts = 0.9 * random_qpos(4, seed=18).numpy()
    assert len(refused) == 40
    assert not any(mink_reaches(model, wanted[i].numpy(), starts) for i in refused)
    # The same effort does reach most poses that are called reachable, so that it would have shown a mistake.
    assert np.mean([mink_reaches(model, wanted[i].numpy(), starts) for i in accepted]) > 0.8


# --- Neighbour and unreachable poses ----------------------------------------------------------------------


def above_home(height: float) -> Tensor:
    """The pose straight above the shoulder, at a height above the highest the flange gets to (1.306 m)."""
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, 2, 3] = 1.306 + height
    return T


def test_three_centimetres_beyond_full_reach_the_neighbour_is_full_reach(ik: InverseKinematics) -> None:
    solution = ik.solve(above_home(0.03), home(1))
    assert solution.reach.tolist() == [Reach.NEIGHBOUR]
    # Nothing is nearer than the top of the workspace, to which any tilt of the hand adds.
    assert_close(solution.T_base_ee, above_home(0.0), rtol=0, atol=1e-5)


def test_seven_centimetres_beyond_full_reach_there_is_no_neighbour(ik: InverseKinematics) -> None:
    reference = random_qpos(1, seed=19)
    solution = ik.solve(above_home(0.07), reference)
    assert solution.reach.tolist() == [Reach.UNREACHABLE]
    assert torch.equal(solution.qpos, reference)
    assert_close(solution.T_base_ee, forward_kinematics(reference), rtol=0, atol=1e-13)


@pytest.mark.parametrize(("height", "reach"), [(0.0499, Reach.NEIGHBOUR), (0.0501, Reach.UNREACHABLE)])
def test_neighbours_end_at_five_centimetres(ik: InverseKinematics, height: float, reach: Reach) -> None:
    assert ik.solve(above_home(height), home(1)).reach.tolist() == [reach]


def test_where_neighbours_end_is_an_option() -> None:
    wide = InverseKinematics(config=IkConfig(neighbour_distance=0.08))
    assert wide.solve(above_home(0.07), home(1)).reach.tolist() == [Reach.NEIGHBOUR]


def test_a_wrist_bent_a_little_too_far_has_a_neighbour(ik: InverseKinematics) -> None:
    # The arm stretched along x and the hand folded back by 123 degrees, 3 more than joint 6 allows.
    angle = math.radians(90.0 + 123.0)
    wrist = torch.tensor([[0.82, 0.0, 0.36]], dtype=torch.float64)
    rotation = rpy_to_matrix(torch.tensor([[0.0, angle, 0.0]], dtype=torch.float64))
    wanted = pose(wrist + 0.126 * rotation[:, :, 2], rotation)
    assert ik.solve(wanted, home(1), neighbour=False).reach.tolist() == [Reach.UNREACHABLE]
    solution = ik.solve(wanted, home(1))
    assert solution.reach.tolist() == [Reach.NEIGHBOUR]
    distance, turned = pose_errors(solution.T_base_ee, wanted)
    # Folding back 3 degrees less about the wrist is one neighbour; the nearest is at least as near.
    one = math.hypot(2 * 0.126 * math.sin(math.radians(1.5)) / 0.05, 3.0 / 10.0)
    assert math.hypot(distance.item() / 0.05, turned.item() / TEN_DEGREES) <= one + 1e-9


def test_without_neighbours_the_same_pose_is_unreachable(ik: InverseKinematics) -> None:
    assert ik.solve(above_home(0.03), home(1), neighbour=False).reach.tolist() == [Reach.UNREACHABLE]


@pytest.mark.parametrize("position", [(2.0, 0.0, 0.5), (0.0, 0.0, 0.4), (0.0, 0.0, -1.0), (1e6, 0.0, 0.0)])
def test_poses_far_out_and_inside_the_arm_are_unreachable(
    ik: InverseKinematics, position: tuple[float, ...]
) -> None:
    wanted = torch.eye(4, dtype=torch.float64)[None].clone()
    wanted[0, :3, 3] = torch.tensor(position)
    assert ik.solve(wanted, home(1)).reach.tolist() == [Reach.UNREACHABLE]


def test_neighbour_poses_are_reached_within_the_limits_and_lie_in_the_allowed_box(
    ik: InverseKinematics,
) -> None:
    wanted = box_poses(5000, seed=20)
    solution = ik.solve(wanted, home(5000))
    is_neighbour = solution.reach == Reach.NEIGHBOUR
    assert is_neighbour.sum() > 300
    distance, angle = pose_errors(solution.T_base_ee[is_neighbour], wanted[is_neighbour])
    assert distance.max() <= 0.05 and angle.max() <= TEN_DEGREES
    assert (solution.qpos.abs() <= UPPER).all()
    assert_close(solution.T_base_ee, forward_kinematics(solution.qpos), rtol=0, atol=1e-13)
    # What was reached is reachable, also to the solver itself.
    again = ik.solve(solution.T_base_ee[is_neighbour], solution.qpos[is_neighbour], neighbour=False)
    assert (again.reach == Reach.REACHABLE).all()


@pytest.mark.parametrize("population", ["start poses", "joints beyond their limits"])
def test_a_dense_random_search_finds_no_neighbour_where_none_was_found_and_none_nearer(
    ik: InverseKinematics, population: str
) -> None:
    if population == "start poses":
        wanted = box_poses(20_000, seed=21)
    else:
        wanted = forward_kinematics(1.3 * random_qpos(2000, seed=24))
    solution = ik.solve(wanted, home(len(wanted)))
    # Poses farther from the reachable shell of the wrist than a neighbour may be need no search.
    wrist = wanted[:, :3, 3] - 0.126 * wanted[:, :3, 2] - torch.tensor([0.0, 0.0, 0.36])
    near_shell = (wrist.norm(dim=-1) > 0.4104 - 0.072) & (wrist.norm(dim=-1) < 0.82 + 0.072)
    refused = torch.nonzero((solution.reach == Reach.UNREACHABLE) & near_shell)[:40, 0].tolist()
    taken = torch.nonzero(solution.reach == Reach.NEIGHBOUR)[:40, 0].tolist()
    assert len(refused) >= 20
    for i in refused + taken:
        shift, turn = random_offsets(2000, seed=22 + i)
        tried = wanted[i].repeat(2000, 1, 1)
        tried[:, :3, 3] += shift
        tried[:, :3, :3] = turn @ tried[:, :3, :3]
        reachable = ik.solve(tried, home(2000), neighbour=False).reach == Reach.REACHABLE
        if i in refused:
            assert not reachable.any()
        elif reachable.any():
            distance, angle = pose_errors(tried[reachable], wanted[i].expand(int(reachable.sum()), 4, 4))
            nearest = torch.hypot(distance / 0.05, angle / TEN_DEGREES).min()
            own_distance, own_angle = pose_errors(solution.T_base_ee[i : i + 1], wanted[i : i + 1])
            assert torch.hypot(own_distance / 0.05, own_angle / TEN_DEGREES).item() < nearest


# --- Bad input --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("T", "reference", "message"),
    [
        (torch.eye(4), torch.zeros(1, 7), r"T_base_ee must be .* \(B, 4, 4\)"),
        (torch.eye(3)[None], torch.zeros(1, 7), r"T_base_ee must be .* \(B, 4, 4\)"),
        (torch.eye(4, dtype=torch.int64)[None], torch.zeros(1, 7), "floating-point"),
        (torch.eye(4)[None], torch.zeros(2, 7), r"qpos_ref must be .* \(1, 7\)"),
        (torch.eye(4)[None], torch.zeros(7), r"qpos_ref must be .* \(1, 7\)"),
        (torch.full((1, 4, 4), math.nan), torch.zeros(1, 7), "rigid"),
        (torch.eye(4)[None], torch.full((1, 7), math.nan), "finite"),
        (torch.eye(4)[None], torch.full((1, 7), math.inf), "finite"),
        (torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))[None], torch.zeros(1, 7), "rigid"),
        (torch.diag(torch.tensor([1.1, 1.0, 1.0, 1.0]))[None], torch.zeros(1, 7), "rigid"),
        (torch.zeros(1, 4, 4), torch.zeros(1, 7), "rigid"),
    ],
)
def test_bad_input_is_refused(ik: InverseKinematics, T: Tensor, reference: Tensor, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        ik.solve(T, reference)


def test_the_message_names_the_row_that_is_wrong(ik: InverseKinematics) -> None:
    wanted = forward_kinematics(home(3))
    wanted[1, 0, 3] = math.nan
    with pytest.raises(InvalidInputError, match="row 1"):
        ik.solve(wanted, home(3))


def test_an_empty_batch_is_solved(ik: InverseKinematics) -> None:
    solution = ik.solve(torch.zeros(0, 4, 4), torch.zeros(0, 7))
    assert (
        solution.qpos.shape == (0, 7)
        and solution.reach.shape == (0,)
        and solution.T_base_ee.shape == (0, 4, 4)
    )


@pytest.mark.parametrize(
    "options",
    [{"limit_margin": 0.0}, {"limit_weight": -1.0}, {"tolerance": 0.1}, {"neighbour_distance": 1.0}],
)
def test_options_out_of_range_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(options))):
        IkConfig(**options)


@pytest.mark.gpu
def test_cuda_gives_the_same_as_the_cpu(ik: InverseKinematics) -> None:
    wanted = box_poses(3000, seed=23)
    expected = ik.solve(wanted, home(3000))
    solution = InverseKinematics(device="cuda").solve(wanted.cuda(), home(3000).cuda())
    assert torch.equal(solution.reach.cpu(), expected.reach)
    reachable = expected.reach == Reach.REACHABLE
    assert_reached(
        ik.solve(solution.T_base_ee.cpu()[reachable], home(int(reachable.sum()))),
        wanted[reachable],
        1e-9,
        1e-9,
    )
