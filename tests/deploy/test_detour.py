"""Ways round an obstacle: found where there is one, and free of contacts by a calculation of their own."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.collision import Box
from maniskill_tomato.deploy.detour import MAX_MOVES, DetourPlanner
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import Arm, ArmState, Float64, JointMove
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.move_choice import MoveChooser, MoveRequest
from maniskill_tomato.deploy.profile import parse_profile
from maniskill_tomato.deploy.run_records import KeptSteps
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14, LINK_NAMES, READY_QPOS
from maniskill_tomato.robot.kinematics import forward_kinematics, link_transforms
from maniskill_tomato.robot.robot_description import link_meshes, urdf_path
from maniskill_tomato.sensing.belief import Belief
from twin_profile import TWIN_PROFILE

mj: Any = mujoco

NOTHING = np.zeros((0, 3))


def standing(joints: Float64) -> ArmState:
    return ArmState(joint_positions=joints, joint_velocities=np.zeros(7), stamp=0.0)


def camera(joints: Float64) -> Float64:
    """The optical frame. Shape (4, 4)."""
    pose: Float64 = forward_kinematics(torch.as_tensor(joints)).numpy() @ T_flange_camera_color_optical
    return pose


def leaf(rng: np.random.Generator, centre: Float64) -> Float64:
    """Points of a blade of 12 x 8 cm at any angle, in [m]. Shape (N, 3)."""
    u, v = np.meshgrid(np.arange(-0.06, 0.06, 0.015), np.arange(-0.04, 0.04, 0.015))
    flat = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=-1)
    points: Float64 = flat @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T + centre
    return points


def refused_moves(safety: Safety, count: int) -> list[tuple[Float64, Float64, Float64]]:
    """Starts, goals and leaves between them of moves that are refused for the leaf, both ends clear of it."""
    found: list[tuple[Float64, Float64, Float64]] = []
    rng = np.random.default_rng(3)
    while len(found) < count:
        start, goal = (READY_QPOS + 0.12 * rng.normal(size=7) for _ in range(2))
        middle = camera((start + goal) / 2)
        points = leaf(rng, middle[:3, 3] + 0.03 * middle[:3, 2] + 0.06 * rng.normal(size=3))
        if any(safety.stands_in_collision(joints, points) for joints in (start, goal)):
            continue
        move = JointMove(joint_positions=goal, speed_fraction=0.1)
        refusal = safety.check(move, standing(start), 0.0, 0.0, points)
        if refusal is not None and refusal.reason == "plant":
            found.append((start, goal, points))
    return found


def along(start: Float64, way: list[JointMove]) -> Iterator[Float64]:
    """Joint positions on the straight lines of a way, in [rad]."""
    at = start
    for move in way:
        yield from (at + share * (move.joint_positions - at) for share in np.linspace(0.0, 1.0, 12))
        at = move.joint_positions


def depths_in_links(postures: Iterable[Float64], points: Float64) -> Float64:
    """How deep each point gets into the hull of a link from the forearm on in any of the postures, in [m]."""
    deepest = np.full(len(points), -np.inf)
    hulls = {name: link_meshes()[name][0] for name in LINK_NAMES[5:]}
    solids = {name: trimesh.convex.convex_hull(vertices) for name, vertices in hulls.items()}
    for joints in postures:
        links = link_transforms(torch.as_tensor(joints)[None])[0].numpy()
        for name, solid in solids.items():
            T = np.linalg.inv(links[LINK_NAMES.index(name)])
            local = points @ T[:3, :3].T + T[:3, 3]
            planes = solid.face_normals
            offsets = (planes * solid.triangles[:, 0]).sum(-1)
            inside = (offsets[:, None] - planes @ local.T).min(axis=0)
            deepest = np.maximum(deepest, inside)
    return deepest


def test_most_moves_that_a_leaf_stops_get_a_way_round_it_that_touches_nothing() -> None:
    safety = Safety()
    planner = DetourPlanner(safety, T_flange_camera_color_optical)
    found = 0
    for start, goal, points in refused_moves(safety, 5):
        way = planner.plan(standing(start), goal, 0.0, 0.0, points)
        if way is None:
            continue
        found += 1
        assert 2 <= len(way) <= MAX_MOVES
        np.testing.assert_allclose(way[-1].joint_positions, goal)
        assert (
            int((depths_in_links(along(start, way), points) > 0.0).sum()) < safety.config.plant_points_needed
        )
    assert found >= 3


def test_a_way_round_a_post_keeps_its_distance_all_along_by_mujoco() -> None:
    start, goal = (np.array([turn, 0.2, 0.0, -1.4, 0.0, 0.9, 0.0]) for turn in (-0.5, 0.5))
    x, _, z = camera((start + goal) / 2)[:3, 3]
    post = Box(low=(x, -0.02, z - 0.1), high=(x + 0.03, 0.02, z + 0.1))
    safety = Safety(SafetyConfig(obstacles=(post,), max_flange_step=1.0))
    straight = JointMove(joint_positions=goal, speed_fraction=0.1)
    refusal = safety.check(straight, standing(start), 0.0, 0.0, None)
    assert refusal is not None and refusal.reason == "obstacle"
    way = DetourPlanner(safety, T_flange_camera_color_optical).plan(standing(start), goal, 0.0, 0.0, NOTHING)
    assert way is not None and len(way) >= 2

    spec = mj.MjSpec.from_file(urdf_path())
    half, middle = (np.array(post.high) - post.low) / 2, (np.array(post.high) + post.low) / 2
    spec.worldbody.add_geom(name="post", type=mj.mjtGeom.mjGEOM_BOX, size=half.tolist(), pos=middle.tolist())
    model = spec.compile()
    data = mj.MjData(model)
    links = [g for g in range(model.ngeom) if model.geom_bodyid[g] > 0]
    at, nearest = start, np.inf
    for move in way:
        for share in np.linspace(0.0, 1.0, 60):
            data.qpos[:] = at + share * (move.joint_positions - at)
            mj.mj_forward(model, data)
            nearest = min(
                nearest,
                *(mj.mj_geomDistance(model, data, g, model.geom("post").id, 1.0, None) for g in links),
            )
        at = move.joint_positions
    # Between the joint positions that the checks look at, 0.02 rad apart, a link may come a little nearer.
    assert nearest > safety.config.obstacle_clearance - 0.003


def test_there_is_no_way_to_a_goal_inside_a_leaf() -> None:
    safety = Safety()
    goal = READY_QPOS + np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    points = leaf(np.random.default_rng(0), camera(goal)[:3, 3])
    planner = DetourPlanner(safety, T_flange_camera_color_optical)
    assert planner.plan(standing(READY_QPOS.copy()), goal, 0.0, 0.0, points) is None


class Instant(Arm):
    """An arm that is where it is sent at once."""

    name = "instant"
    model = IIWA14
    simulated = True
    can_stop = True

    @property
    def is_connected(self) -> bool:
        return True

    def __init__(self, joints: Float64, clock: SimulatedClock) -> None:
        self.joints, self.clock = joints, clock

    def read(self, max_age_s: float = 0.5) -> ArmState:
        return ArmState(joint_positions=self.joints, joint_velocities=np.zeros(7), stamp=self.clock.now())

    def command(self, move: JointMove) -> JointMove:
        self.clock.sleep(10.0)
        self.joints = move.joint_positions
        return move

    def wait(self, timeout_s: float) -> bool:
        return True

    def stop(self) -> bool:
        return True

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...


def test_a_chosen_way_passes_the_guard_move_by_move_and_ends_at_the_tasks_own_posture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    safety = Safety(SafetyConfig(max_frame_age=1000.0))
    start, goal, points = refused_moves(safety, 1)[0]
    chooser = MoveChooser(safety, T_flange_camera_color_optical)
    monkeypatch.setattr("maniskill_tomato.deploy.move_choice.OTHERS_TRIED", 0)
    request = MoveRequest(
        joint_positions=start,
        camera_position=camera(start)[:3, 3],
        target_position=np.array([0.8, 0.0, 0.9]),
        action=(0.0, 0.0, 0.0),
    )
    chosen = chooser.choose(request, goal, standing(start), 0.0, 0.0, points)
    assert chosen.refusal is None and chosen.move is not None and chosen.then
    clock = SimulatedClock(0.0)
    arm = Instant(start, clock)
    guarded = GuardedArm(arm, safety, clock)
    for move in (chosen.move, *chosen.then):
        guarded.command(move, 0.0, points)
        assert guarded.wait(0.0)
    np.testing.assert_allclose(arm.joints, goal)


class Scripted(Planner):
    """Actions that were written down."""

    name = "scripted"

    def __init__(self, actions: list[tuple[float, float, float]]) -> None:
        self.actions = iter(actions)

    def act(self, belief: Belief) -> Tensor:
        return torch.tensor([next(self.actions)])


LEAVES = (
    TWIN_PROFILE
    + """
[loop]
threshold = 0.95
max_moves = 4
[safety]
plant_clearance = 0.02
"""
)


def test_the_loop_goes_round_the_leaves_that_stop_a_move_without_touching_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In held-out episode 0 three moves uncover leaves that stop the fourth in every posture that is tried."""
    workcell = make_workcell(parse_profile(LEAVES, Path("leaves.toml")), 0)
    guard, device, twin = workcell.guarded_arm, workcell.arm, cast(Any, workcell.arm)._world
    passed: list[tuple[ArmState, JointMove, Float64]] = []
    driven: list[JointMove] = []
    positions: list[Float64] = []
    guard_command, device_command, advance = guard.command, device.command, twin.advance

    def through_the_guard(move: JointMove, frame_stamp: float, points_w: Float64) -> JointMove:
        state = guard.read()
        sent = guard_command(move, frame_stamp, points_w)
        passed.append((state, sent, points_w))
        return sent

    def to_the_device(move: JointMove) -> JointMove:
        driven.append(move)
        return device_command(move)

    def advanced() -> float:
        now: float = advance()
        positions.append(twin.arm.joint_positions)
        return now

    monkeypatch.setattr(guard, "command", through_the_guard)
    monkeypatch.setattr(device, "command", to_the_device)
    monkeypatch.setattr(twin, "advance", advanced)
    policy = Scripted([(-0.12, 0.35, 0.93), (-0.14, 0.42, 0.9), (-0.06, 0.37, 0.93), (0.32, 0.42, 0.85)])
    kept = KeptSteps()
    with device, workcell.camera, Stops() as stops:
        result = Loop(workcell, policy, stops, "unattended", [kept]).run()

        assert (result.reason, result.moves, result.refused_moves) == ("budget", 4, 0), result.detail
        # Three moves at once, the fourth in parts; each went out through the guard.
        parts = passed[3:]
        assert 2 <= len(parts) <= MAX_MOVES
        assert [move.joint_positions.tolist() for move in driven] == [
            move.joint_positions.tolist() for _, move, _ in passed
        ]
        before, goal, points = parts[0][0], parts[-1][1], parts[0][2]
        refusal = guard.safety.check(goal, before, before.stamp, before.stamp, points)
        assert refusal is not None and refusal.reason == "plant"
        last = kept.steps[3]
        assert last.outcome == "moved" and last.commanded is not None
        np.testing.assert_array_equal(last.commanded, goal.joint_positions)
        np.testing.assert_allclose(guard.read().joint_positions, goal.joint_positions, atol=1e-3)
    # Where the twin's joints really were on the way, by the links' own hulls.
    apart = [np.abs(joints - before.joint_positions).max() for joints in positions]
    way = positions[int(np.flatnonzero(np.array(apart) < 1e-9)[-1]) :]
    assert len(way) > 50
    assert int((depths_in_links(way, points) > 0.0).sum()) == 0


def test_a_move_that_nothing_stops_is_made_at_once() -> None:
    chooser = MoveChooser(Safety(), T_flange_camera_color_optical)
    goal = READY_QPOS + np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    request = MoveRequest(
        joint_positions=READY_QPOS.copy(),
        camera_position=camera(READY_QPOS)[:3, 3],
        target_position=np.array([0.8, 0.0, 0.9]),
        action=(0.0, 0.0, 0.0),
    )
    chosen = chooser.choose(request, goal, standing(READY_QPOS.copy()), 0.0, 0.0, NOTHING)
    assert chosen.move is not None and chosen.then == () and chosen.refusal is None
    np.testing.assert_allclose(chosen.move.joint_positions, goal)
