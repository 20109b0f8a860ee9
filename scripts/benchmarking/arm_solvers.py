# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Libraries that solve the inverse kinematics of the iiwa 14, on the same poses from the same seeds.

Every pose is the forward kinematics of joint angles within the limits, so that a solver that misses one misses a pose
that can be reached. The seed of a pose is those angles, each moved by about 0.25 rad, as between two views of a search.
"""

import importlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import mink
import mujoco
import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from benchmarking.turns import four_digits
from maniskill_tomato.robot import iiwa14
from maniskill_tomato.robot.ik_chain import vec7d
from maniskill_tomato.robot.ik_circle import elbow_circle, evaluate, feasible_configurations
from maniskill_tomato.robot.ik_solve import Solver, position_of, rotation_of
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics

Array = NDArray[np.float64]
Solve = Callable[[Array, Array], Array | None]
"""A pose of shape (4, 4) and a seed of shape (7,) to joint angles of shape (7,), or None."""

NARROW_DEG: Final = 5.0
"""A pose is narrow where fewer degrees of the arm angle keep the joint limits."""
ARM_ANGLES: Final = 2880
"""Arm angles that a pose's free range is counted over."""
SEED_SPREAD: Final = 0.25
"""Standard deviation of a seed's joints about the pose's own, in [rad]."""
LOCKED: Final = np.radians(np.arange(-165.0, 166.0, 10.0))
"""Angles of joint 3 that EAIK is asked with."""
REACHED: Final = 1e-4
"""A solution counts if the pose it gives is off by no more, in [m] and as the largest element of the rotation."""
SLOW_POSES: Final = 300
"""Poses for a solver that takes milliseconds."""
MINK_STEPS: Final = 60


@dataclass(frozen=True)
class Poses:
    """What the solvers are asked."""

    T_base_ee: Array
    """Shape (B, 4, 4), in [m]."""
    seeds: Array
    """Shape (B, 7), in [rad]."""


@wp.kernel(enable_backward=False)  # type: ignore[untyped-decorator]
def count_free(solver: Solver, poses: wp.array[wp.mat44d], free: wp.array[wp.int32]):  # type: ignore[no-untyped-def]
    """How many of `ARM_ANGLES` arm angles keep all joint limits in some configuration."""
    i = wp.tid()
    pose = poses[i]
    circle = elbow_circle(
        solver.chain, position_of(pose), rotation_of(pose), vec7d(), wp.float64(1.0e-9), wp.float64(1.0e-9)
    )
    count = wp.int32(0)
    for k in range(ARM_ANGLES):
        psi = wp.float64(6.283185307179586) * wp.float64(k) / wp.float64(ARM_ANGLES)
        values = evaluate(circle, wp.cos(psi), wp.sin(psi))
        if feasible_configurations(solver.chain, values, wp.float64(0.0)) != 0:
            count += 1
    free[i] = count


def free_degrees(T_base_ee: Array) -> Array:
    """How many degrees of the arm angle keep the joint limits at each pose. Shape (B,)."""
    poses = wp.array(T_base_ee, dtype=wp.mat44d, device="cpu")
    free = wp.zeros(len(T_base_ee), dtype=wp.int32, device="cpu")
    wp.launch(count_free, len(T_base_ee), [InverseKinematics().solver, poses, free], device="cpu")
    return np.asarray(free.numpy()) * (360.0 / ARM_ANGLES)


def random_poses(count: int) -> Poses:
    """Poses of joint angles that are uniform within the limits."""
    rng = np.random.default_rng(0)
    return _poses_of(rng.uniform(iiwa14.JOINT_LOWER, iiwa14.JOINT_UPPER, (count, 7)), rng)


def narrow_poses(count: int) -> Poses:
    """Poses that leave under `NARROW_DEG` of the arm angle: joints near their limits, and picked."""
    rng = np.random.default_rng(1)
    found: list[Array] = []
    while sum(len(some) for some in found) < count:
        qpos = rng.uniform(iiwa14.JOINT_LOWER, iiwa14.JOINT_UPPER, (20_000, 7))
        at_limit = rng.random(qpos.shape) < 0.4
        side = np.where(qpos > 0.0, iiwa14.JOINT_UPPER, iiwa14.JOINT_LOWER)
        qpos = np.where(at_limit, side * (1.0 - rng.uniform(0.0, 0.01, qpos.shape)), qpos)
        free = free_degrees(forward_kinematics(torch.from_numpy(qpos)).numpy())
        found.append(qpos[(free > 0.0) & (free < NARROW_DEG)])
    return _poses_of(np.concatenate(found)[:count], rng)


def _poses_of(qpos: Array, rng: np.random.Generator) -> Poses:
    seeds = np.clip(qpos + rng.normal(0.0, SEED_SPREAD, qpos.shape), iiwa14.JOINT_LOWER, iiwa14.JOINT_UPPER)
    return Poses(forward_kinematics(torch.from_numpy(qpos)).numpy(), seeds)


def ours() -> Solve:
    """This package's, one pose a call."""
    solver = InverseKinematics()

    def solve(T: Array, seed: Array) -> Array | None:
        solution = solver.solve(torch.from_numpy(T)[None], torch.from_numpy(seed)[None], neighbour=False)
        return solution.qpos[0].numpy() if int(solution.reach[0]) == Reach.REACHABLE else None

    return solve


def ssik() -> Solve:
    """ssik's prebuilt iiwa 14: the solution nearest to the seed by the summed move, of those within the limits."""
    arm = importlib.import_module("ssik.prebuilt.iiwa14_ik")

    def solve(T: Array, seed: Array) -> Array | None:
        found = arm.solve(T, q_seed=seed, max_solutions=1, seed_metric="wrap_l2")
        return np.asarray(found[0].q) if found else None

    return solve


def eaik() -> Solve:
    """EAIK, which wants six joints: joint 3 is locked, at the angle of `LOCKED` that is nearest to the seed's and has a
    solution within the limits."""
    origins = np.concatenate([iiwa14.JOINT_ORIGINS, np.asarray(iiwa14.EE_ORIGIN)[None]])
    axes = np.asarray(iiwa14.JOINT_AXES, np.float64)
    robot = importlib.import_module("eaik.IK_HP").HPRobot
    arms = [robot(axes, origins, [(2, float(angle))]) for angle in LOCKED]

    def solve(T: Array, seed: Array) -> Array | None:
        for k in np.argsort(np.abs(LOCKED - seed[2])):
            solution = arms[k].IK(T)
            found = np.asarray(solution.Q).reshape(-1, 7)[~np.asarray(solution.is_LS, bool)]
            within = found[(np.abs(found) <= iiwa14.JOINT_UPPER).all(axis=1)]
            if len(within):
                best: Array = within[np.linalg.norm(within - seed, axis=1).argmin()]
                return best
        return None

    return solve


def pytracik() -> Solve:
    """TRAC-IK with its defaults: the first solution within 5 ms."""
    solver = importlib.import_module("trac_ik").TracIK("link_0", "link_ee", str(iiwa14.IIWA14.urdf))

    def solve(T: Array, seed: Array) -> Array | None:
        found = solver.ik(T[:3, 3], T[:3, :3], seed)
        return None if found is None else np.asarray(found)

    return solve


def by_mink() -> Solve:
    """mink's differential inverse kinematics with the joint limits, `MINK_STEPS` steps at most from the seed."""
    loader: Any = mujoco
    model = loader.MjModel.from_xml_string(_mujoco_arm())
    task = mink.FrameTask("link_ee", "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-4)
    limits = [mink.ConfigurationLimit(model)]

    def solve(T: Array, seed: Array) -> Array | None:
        task.set_target(mink.SE3.from_matrix(T))
        configuration = mink.Configuration(model, seed)
        for _ in range(MINK_STEPS):
            velocity = mink.solve_ik(configuration, [task], 1.0, "daqp", limits=limits)
            configuration.integrate_inplace(velocity, 1.0)
            if np.abs(task.compute_error(configuration)).max() < 1e-6:
                return np.array(configuration.q)
        return None

    return solve


def _mujoco_arm() -> str:
    bodies = "".join(
        f'<body pos="{" ".join(map(str, origin))}"><joint axis="{" ".join(map(str, axis))}" limited="true" '
        f'range="{low} {high}"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        for origin, axis, low, high in zip(
            iiwa14.JOINT_ORIGINS, iiwa14.JOINT_AXES, iiwa14.JOINT_LOWER, iiwa14.JOINT_UPPER, strict=True
        )
    )
    site = f'<site name="link_ee" pos="{" ".join(map(str, iiwa14.EE_ORIGIN))}"/>'
    arm = bodies + site + "</body>" * 7
    return f'<mujoco><compiler angle="radian"/><worldbody>{arm}</worldbody></mujoco>'


SOLVERS: Final[dict[str, tuple[str, Callable[[], Solve], int | None]]] = {
    "ours, one pose a call": ("maniskill_tomato", ours, None),
    "ssik": ("ssik", ssik, None),
    "EAIK, joint 3 locked": ("eaik", eaik, None),
    "pytracik": ("trac_ik", pytracik, None),
    "mink": ("mink", by_mink, SLOW_POSES),
}
"""Module, maker, and how many poses are enough; None for all."""


def compare_solvers(poses: int) -> list[dict[str, Any]]:
    """Solves a second of processor time, what was solved, how exactly, and how near to the seed.

    Args:
        poses: How many random ones; a tenth as many are narrow.
    """
    random, narrow = random_poses(poses), narrow_poses(max(poses // 10, 1))
    rows = [_batch_row(random, narrow)]
    for name, (module, make, enough) in SOLVERS.items():
        try:
            importlib.import_module(module)
        except ImportError:
            continue
        solve = make()
        next(_answers(solve, random, 1))
        start = time.process_time()
        answers = list(_answers(solve, random, enough))
        spent = time.process_time() - start
        row = {"solver": name, "poses": len(answers), "solves_per_s": four_digits(len(answers) / spent)}
        narrow_answers = list(_answers(solve, narrow, enough))
        rows.append({**row, **_quality(answers, random), "narrow_solved": _solved(narrow_answers, narrow)})
    return rows


def _answers(solve: Solve, poses: Poses, enough: int | None) -> Iterator[Array | None]:
    for T, seed in zip(poses.T_base_ee[:enough], poses.seeds[:enough], strict=True):
        yield solve(T, seed)


def _batch_row(random: Poses, narrow: Poses) -> dict[str, Any]:
    solver = InverseKinematics()

    def solve(poses: Poses) -> list[Array | None]:
        T, seeds = torch.from_numpy(poses.T_base_ee), torch.from_numpy(poses.seeds)
        solution = solver.solve(T, seeds, neighbour=False)
        reached = (solution.reach == Reach.REACHABLE).tolist()
        return [q if ok else None for q, ok in zip(solution.qpos.numpy(), reached, strict=True)]

    solve(random)
    start = time.process_time()
    answers = solve(random)
    spent = time.process_time() - start
    row = {
        "solver": "ours, all at once",
        "poses": len(answers),
        "solves_per_s": four_digits(len(answers) / spent),
    }
    return {**row, **_quality(answers, random), "narrow_solved": _solved(solve(narrow), narrow)}


def _errors(answers: list[Array | None], poses: Poses) -> tuple[Array, Array]:
    """Distance and rotation by which each answer misses, infinite where there is none or it breaks a limit."""
    given = np.array([np.full(7, np.nan) if answer is None else answer for answer in answers])
    reached = forward_kinematics(torch.from_numpy(given)).numpy()
    wanted = poses.T_base_ee[: len(answers)]
    kept = (given >= iiwa14.JOINT_LOWER - 1e-9) & (given <= iiwa14.JOINT_UPPER + 1e-9)
    far = np.linalg.norm(reached[:, :3, 3] - wanted[:, :3, 3], axis=1)
    turned = np.abs(reached[:, :3, :3] - wanted[:, :3, :3]).max(axis=(1, 2))
    usable = kept.all(axis=1)
    return np.where(usable, far, np.inf), np.where(usable, turned, np.inf)


def _quality(answers: list[Array | None], poses: Poses) -> dict[str, Any]:
    far, turned = _errors(answers, poses)
    good = (far < REACHED) & (turned < REACHED)
    moves = [
        float(np.linalg.norm(answer - seed))
        for answer, seed, ok in zip(answers, poses.seeds[: len(answers)], good, strict=True)
        if ok and answer is not None
    ]
    return {
        "solved": float(good.mean()),
        "largest_error_m": float(f"{far[good].max():.1e}"),
        "median_move_from_seed_rad": round(float(np.median(moves)), 3),
        "mean_move_from_seed_rad": round(float(np.mean(moves)), 3),
    }


def _solved(answers: list[Array | None], poses: Poses) -> float:
    far, turned = _errors(answers, poses)
    return float(((far < REACHED) & (turned < REACHED)).mean())
