"""Other arms than the iiwa 14, through the entry points: judged by their own limits, shapes and kinematics, or refused.

The packages are real ones: a module and its `entry_points.txt` on the path, as pip leaves them.
"""

import ast
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from maniskill_tomato.deploy.arm_shapes import check_arm_shapes
from maniskill_tomato.deploy.check import check, print_findings
from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.collision import Box, CollisionChecker
from maniskill_tomato.deploy.deploy_errors import FaultError, ProfileError, RefusedError
from maniskill_tomato.deploy.drivers import DriverContext, arm_model, driver_names, make_arm
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import ArmState, Float64, JointMove
from maniskill_tomato.deploy.move_choice import MoveChooser, MoveRequest
from maniskill_tomato.deploy.policy_run import RunConfig, run
from maniskill_tomato.deploy.profile import Profile, parse_profile
from maniskill_tomato.deploy.run_replay import load_recording, replay
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.kinematics import forward_kinematics

EXAMPLE = Path(__file__).parents[2] / "examples" / "make_it_yours"

DRIVER = '''
"""Another maker's arm: it is at once where it is sent."""

from pathlib import Path

import numpy as np

from maniskill_tomato.deploy.interface import Arm, ArmState, Camera, JointMove
from maniskill_tomato.robot.arm_urdf import read_arm_model
from maniskill_tomato.robot.iiwa14 import IIWA14

MODEL = read_arm_model(
    Path(__file__).parent / "arm.urdf",
    name="narrow",
    flange_link="link_ee",
    acceleration_limits=(8.0,) * 7,
    spheres=IIWA14.spheres,
    ready_qpos=(0.0, -0.894598, 0.0, -1.691162, 0.0, 0.774233, 0.0),
)


class NarrowArm(Arm):
    name = "narrow"
    model = MODEL
    simulated = True
    can_stop = True
    connects = 0

    def __init__(self, options, context):
        self.clock = context.clock
        self.joints = np.array(options.get("start", MODEL.ready_qpos))
        self.sent = []

    @property
    def is_connected(self):
        return True

    def connect(self):
        type(self).connects += 1

    def disconnect(self):
        pass

    def read(self, max_age_s=0.5):
        return ArmState(joint_positions=self.joints, joint_velocities=np.zeros(7), stamp=self.clock.now())

    def command(self, move):
        self.sent.append(move)
        self.joints = np.array(move.joint_positions)
        self.clock.sleep(self.move_seconds(np.zeros(7), 0.1) + 10.0)
        return move

    def wait(self, timeout_s):
        return True

    def stop(self):
        return True


class Undeclared(NarrowArm):
    """A driver of before models were declared."""

    name = "undeclared"
    model = None


class Misdeclared(NarrowArm):
    name = "misdeclared"
    model = "iiwa14"
'''


def installed(folder: Path, monkeypatch: pytest.MonkeyPatch, module: str, entries: str) -> None:
    """Says that a package is there, as pip would."""
    facts = folder / f"{module}-1.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text(f"[maniskill_tomato.drivers]\n{entries}\n")
    monkeypatch.syspath_prepend(str(folder))


@pytest.fixture
def makers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Installs the drivers above; joint 4 of their arm bends from -110 to 100 degrees, at half its speed."""
    folder = tmp_path / "site"
    folder.mkdir()
    urdf = (EXAMPLE / "tomato_extras" / "iiwa7.urdf").read_text()
    a4 = 'lower="-2.0943951" upper="2.0943951" effort="110" velocity="2.2689280"'
    assert urdf.count(a4) == 1
    urdf = urdf.replace(a4, 'lower="-1.9198622" upper="1.7453293" effort="110" velocity="1.1344640"')
    (folder / "arm.urdf").write_text(urdf)
    entries = "\n".join(
        f"{name} = other_makers_arm:{what}"
        for name, what in {
            "arm.narrow": "NarrowArm",
            "model.narrow": "MODEL",
            "arm.undeclared": "Undeclared",
            "arm.misdeclared": "Misdeclared",
            "model.stray": "NarrowArm",
        }.items()
    )
    (folder / "other_makers_arm.py").write_text(DRIVER)
    installed(folder, monkeypatch, "other_makers_arm", entries)
    yield folder
    sys.modules.pop("other_makers_arm", None)


def profile(driver: str, extra: str = "") -> Profile:
    text = f"""
description = "another arm"
[arm]
driver = "{driver}"
{extra}
[camera]
driver = "mock"
[twin]
width = 160
height = 120
depth_noise = 0.0
[perception]
segmenter = "ground_truth"
sight = "rays"
[target]
source = "twin"
"""
    return parse_profile(text, Path("other.toml"))


def guarded(driver: str = "narrow", **options: Any) -> tuple[Any, GuardedArm]:
    arm = make_arm(driver, options, DriverContext(clock=SimulatedClock(100.0)))
    arm.connect()
    safety = Safety(SafetyConfig(max_joint_step=3.0, max_flange_step=2.0), model=arm.model)
    return arm, GuardedArm(arm, safety, arm.clock)  # type: ignore[attr-defined]


def posture(model: Any, **joints: float) -> Float64:
    q = np.array(model.ready_qpos)
    for name, value in joints.items():
        q[int(name[1:]) - 1] = value
    return q


def to(joints: Float64, speed: float = 0.1) -> JointMove:
    return JointMove(joint_positions=joints, speed_fraction=speed)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"joint_origins": IIWA14.joint_origins * 1.2}, "kinematics have link_1"),
        ({"joint_axes": -IIWA14.joint_axes}, "kinematics have link_1"),
        ({"flange_height": IIWA14.flange_height + 0.1}, "kinematics have link_ee 100 mm"),
        ({"link_turns": np.stack([np.eye(3), *[2.0 * np.eye(3)] * 7, np.eye(3)])}, "kinematics have link_1"),
        ({"joint_upper": IIWA14.joint_upper + 0.1}, "joint_1 may turn 0.1 rad beyond its limits"),
        ({"joint_lower": IIWA14.joint_lower * 1.5}, "rad beyond its limits"),
    ],
)
def test_a_model_that_is_not_of_its_urdf_is_refused(changed: dict[str, Any], words: str) -> None:
    check_arm_shapes(IIWA14)
    check_arm_shapes(replace(IIWA14, joint_upper=IIWA14.joint_upper - 0.3))
    with pytest.raises(InvalidInputError, match=words):
        check_arm_shapes(replace(IIWA14, **changed))


def test_the_guard_holds_another_arm_to_its_own_limits(makers: Path) -> None:
    arm, guard = guarded()
    within_the_iiwas = posture(arm.model, j4=np.deg2rad(-112.0))
    assert (np.abs(within_the_iiwas) < IIWA14.joint_upper - 0.03).all()
    with pytest.raises(
        RefusedError, match=r"joint_limit: A4 must stay from -108\.28 to 98\.28 deg, got -112\.00 deg"
    ):
        guard.command(to(within_the_iiwas))
    assert arm.sent == []
    guard.command(to(posture(arm.model, j4=np.deg2rad(-100.0))))
    assert len(arm.sent) == 1 and guard.wait(0.1)
    arm.joints = posture(arm.model, j4=np.deg2rad(102.0))
    arm.clock.sleep(100.0)
    with pytest.raises(
        FaultError, match=r"A4 at 102\.0 deg, 2\.00 deg outside its limits of -110\.0 to 100\.0 deg"
    ):
        guard.read()


def test_the_guard_knows_how_fast_another_arm_turns(makers: Path) -> None:
    arm, guard = guarded()
    start = guard.read().joint_positions
    arm.clock.sleep(0.1)
    # 0.12 rad in 0.1 s: the iiwa's A4 makes 1.31 rad/s, this one 1.13.
    arm.joints = start + np.array([0.0, 0.0, 0.0, 0.1345, 0.0, 0.0, 0.0])
    assert IIWA14.velocity_limits[3] * 0.1 + 0.02 > 0.1345 > arm.model.velocity_limits[3] * 0.1 + 0.02
    with pytest.raises(FaultError, match=r"A4 jumped by 0\.13"):
        guard.read()


def test_collisions_and_zones_are_those_of_the_other_arms_geometry(makers: Path) -> None:
    arm, guard = guarded()
    goal = posture(arm.model, j1=0.3)
    ours = forward_kinematics(torch.as_tensor(goal), arm.model)[:3, 3].numpy()
    theirs = forward_kinematics(torch.as_tensor(goal))[:3, 3].numpy()
    assert np.linalg.norm(ours - theirs) > 0.02

    def box(at: Float64, size: float) -> Box:
        low, high = (at - size).tolist(), (at + size).tolist()
        return Box(low=tuple(low), high=tuple(high))

    state = ArmState(joint_positions=arm.joints, joint_velocities=np.zeros(7), stamp=100.0)
    for zone, refused in ((box(ours, 0.008), True), (box(theirs, 0.008), False)):
        safety = Safety(SafetyConfig(forbidden=(zone,)), model=arm.model)
        refusal = safety.check(to(goal), state, 100.0)
        assert (refusal is not None and refusal.reason == "forbidden_zone") is refused
    # Spheres and MuJoCo's shapes stand on the same links.
    near = Safety(SafetyConfig(plant_clearance=0.0), model=arm.model)
    leaf = np.repeat((ours + 0.03 * np.array([0.0, 0.0, 1.0]))[None], 12, axis=0)
    refusal = near.check(to(goal), state, 100.0, points_w=leaf)
    assert refusal is not None and refusal.reason == "plant"
    wall = Safety(SafetyConfig(obstacles=(box(ours, 0.02),), obstacle_clearance=0.01), model=arm.model)
    refusal = wall.check(to(goal), state, 100.0)
    assert refusal is not None and refusal.reason == "obstacle" and "link" in refusal.detail


def test_mujoco_has_the_shapes_of_the_other_arm_where_they_are(makers: Path) -> None:
    upright, level = np.zeros(7), np.zeros(7)
    level[1] = np.pi / 2
    # Upright the iiwa 14 ends 40 mm higher; level its upper arm is 20 mm higher and 8 mm thicker.
    above = Box(low=(-0.1, -0.1, 1.345), high=(0.1, 0.1, 1.5))
    below = Box(low=(0.13, -0.02, 0.2), high=(0.2, 0.02, 0.272))
    for joints, box, hits_ours, hits_theirs in ((upright, above, True, False), (level, below, False, True)):
        for model, hits in ((IIWA14, hits_ours), (arm_model("narrow"), hits_theirs)):
            checker = CollisionChecker(obstacles=(box,), obstacle_clearance=0.001, model=model)
            contact = checker.nearest(joints[None])
            assert (contact is not None and contact.second == "obstacle 0") is hits, (
                model.name,
                box,
                contact,
            )


def test_moves_of_the_policy_are_solved_by_the_other_arms_kinematics(makers: Path) -> None:
    arm, guard = guarded()
    chooser = MoveChooser(guard.safety, T_flange_camera_color_optical)
    mount = T_flange_camera_color_optical

    def camera(joints: Float64) -> Float64:
        pose: Float64 = forward_kinematics(torch.tensor(joints), arm.model).numpy() @ mount
        return pose

    start = camera(arm.joints)
    target = start[:3, 3] + 0.5 * start[:3, 2]
    request = MoveRequest(
        joint_positions=arm.joints,
        camera_position=start[:3, 3],
        target_position=target,
        action=(1.0, 0.0, 0.0),
    )
    state = guard.read()
    choice = chooser.choose(request, chooser.own_goal(request), state, 100.0, 100.0, np.zeros((0, 3)))
    assert choice.move is not None and choice.refusal is None
    end = camera(choice.move.joint_positions)
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) == pytest.approx(0.12, abs=0.005)
    to_target = target - end[:3, 3]
    np.testing.assert_allclose(end[:3, 2], to_target / np.linalg.norm(to_target), atol=1e-5)
    guard.command(choice.move)


@pytest.mark.parametrize("name", ["undeclared", "misdeclared"])
def test_an_arm_that_declares_no_model_is_refused_before_anything_connects(makers: Path, name: str) -> None:
    with pytest.raises(ProfileError, match=f"the driver {name} declares no model of its arm"):
        make_workcell(profile(name))
    findings = list(check(profile(name), "random", 0, None))
    assert [f.what for f in findings if not f.good] == ["drivers"]
    assert not print_findings(iter(findings), lambda text: None)
    assert sys.modules["other_makers_arm"].NarrowArm.connects == 0


UNSERVED: dict[str, tuple[Callable[[str], str], str]] = {
    "six joints": (lambda t: t.replace('"A3" type="revolute"', '"A3" type="fixed"'), "6 joints turn between"),
    "an offset elbow": (
        lambda t: t.replace('xyz="0 0.0105', 'xyz="0.08 0.0105'),
        "the axis of A4 passes the z axis",
    ),
    "limits without end": (
        lambda t: t.replace('upper="1.7453293"', 'upper="inf"'),
        "must have a limit with a finite",
    ),
    "a link without shapes": (
        lambda t: (
            t[: t.index("<collision>", t.index('name="link_3"'))]
            + t[t.index("</link>", t.index('name="link_3"')) :]
        ),
        "no collision shapes on link_3",
    ),
    "a shape that MuJoCo cannot have": (
        lambda t: t.replace('<sphere radius="0.0792"/>', '<mesh filename="package://arm/link.stl"/>'),
        "MuJoCo cannot",
    ),
    "no spheres": (lambda t: t, "no spheres cover link_5"),
    "spheres that miss their link": (
        lambda t: t.replace(
            'xyz="0 0.0621 0" rpy="1.5707963267948966 0 0"', 'xyz="0 0.1621 0" rpy="1.5708 0 0"'
        ),
        "the spheres of link_6 leave a corner of its collision shapes",
    ),
}


@pytest.mark.parametrize("what", list(UNSERVED))
def test_an_arm_whose_model_cannot_be_served_is_refused_before_anything_connects(
    makers: Path, what: str
) -> None:
    edit, words = UNSERVED[what]
    urdf = makers / "arm.urdf"
    changed = edit(urdf.read_text())
    urdf.write_text(changed)
    if what == "no spheres":
        driver = makers / "other_makers_arm.py"
        driver.write_text(driver.read_text().replace("spheres=IIWA14.spheres", "spheres={}"))
    with pytest.raises(ProfileError, match=words) as refused:
        make_workcell(profile("narrow"))
    assert "arm.narrow" in str(refused.value)


def test_the_guard_takes_no_envelope_of_another_arm(makers: Path) -> None:
    arm = make_arm("narrow", {}, DriverContext(clock=SimulatedClock(100.0)))
    with pytest.raises(ProfileError, match="moves a 'narrow', but the safety checks are those of a 'iiwa14'"):
        GuardedArm(arm, Safety(), arm.clock)  # type: ignore[attr-defined]


def test_deploy_check_judges_another_arm_by_its_own_limits(makers: Path) -> None:
    start = [0.0, -0.894598, 0.0, -1.91, 0.0, 0.774233, 0.0]
    inside = next(f for f in check(profile("narrow"), "random", 3, None) if f.what == "limits")
    assert inside.good and inside.detail == "the narrow stands inside the envelope"
    outside = next(
        f for f in check(profile("narrow", f"start = {start}"), "random", 3, None) if f.what == "limits"
    )
    assert not outside.good and "A4 must stay from -108.28 to 98.28 deg, got -109.43 deg" in outside.detail


def test_models_are_found_by_name(makers: Path, extras: Path) -> None:
    assert driver_names("model") == ("iiwa14", "iiwa7", "narrow", "stray")
    assert arm_model("iiwa14") is IIWA14 and arm_model("iiwa7").name == "iiwa7"
    with pytest.raises(
        ProfileError, match="no package registers a model of the arm 'other'; there are iiwa14, iiwa7"
    ):
        arm_model("other")
    with pytest.raises(ProfileError, match=r"model\.stray must name an ArmModel called 'stray', it names a"):
        arm_model("stray")


def test_the_twin_moves_another_arm_in_mujoco_from_a_profile_to_its_replay(
    extras: Path, tmp_path: Path
) -> None:
    file = EXAMPLE / "iiwa7_twin.toml"
    short = parse_profile(file.read_text() + "\n[loop]\nmax_moves = 3\n", file)
    result = run(RunConfig(profile=short, out=tmp_path / "run", policy="nbv", seed=3))
    assert not result.is_fault, result.detail
    assert result.moves >= 1
    recorded = load_recording(tmp_path / "run" / "run.mcap")
    assert recorded.info["arm_model"] == "iiwa7"
    model = arm_model("iiwa7")
    for step in recorded.steps:
        joints = torch.tensor(step.facts["joint_positions"], dtype=torch.float64)
        assert (joints.abs() <= torch.as_tensor(model.joint_upper.copy())).all()
        camera = forward_kinematics(joints, model).numpy() @ T_flange_camera_color_optical
        np.testing.assert_allclose(np.array(step.facts["T_world_camera"])[:3, 3], camera[:3, 3], atol=1e-5)
    again = replay(recorded)
    assert again.differences == ()


MODEL_PLACE = {
    "ArmDynamics": 1,
    "CollisionChecker": 0,
    "InverseKinematics": 2,
    "LookAtMover": 2,
    "McapRecorder": 4,
    "MoveWatch": 4,
    "PlantPoints": 2,
    "Postures": 2,
    "RobotBelief": 3,
    "Safety": 2,
    "TransitPlanner": 1,
    "ViewLattice": 1,
    "WholeRow": 3,
    "arm_spec": 3,
    "cut_way": 3,
    "flange_pose": 1,
    "forward_kinematics": 1,
    "link_frames": 2,
    "link_meshes": 0,
    "link_transforms": 1,
    "load_episode": 3,
    "make_episode": 2,
    "simple_urdf": 0,
    "sphere_distances": 3,
    "sphere_table": 1,
    "swept_distances": 5,
}
"""What is an iiwa 14's unless a model is given, and after how many other arguments it may be given."""

OF_THE_IIWA = ("iiwa_readings.py", "libiiwa", "sunrise")
"""The drivers of the iiwa in `deploy`, which may take its numbers as they are."""


def test_nothing_in_deploy_but_the_iiwas_drivers_forgets_which_arm_it_is_about() -> None:
    deploy = Path(__file__).parents[2] / "deploy"
    calls, forgot = set(), []
    for path in sorted(deploy.rglob("*.py")):
        where = path.relative_to(deploy)
        if where.parts[0] in OF_THE_IIWA:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "maniskill_tomato.robot.iiwa14":
                forgot += [f"{where}: {a.name}" for a in node.names if a.name not in ("IIWA14", "LINK_NAMES")]
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
                continue
            name = node.func.id
            if name in MODEL_PLACE:
                calls.add(name)
                has_model = len(node.args) > MODEL_PLACE[name] or any(k.arg == "model" for k in node.keywords)
                forgot += [] if has_model else [f"{where}:{node.lineno}: {name}"]
    assert forgot == []
    assert calls == set(MODEL_PLACE)
