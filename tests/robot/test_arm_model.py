"""Models of other arms: kinematics by MuJoCo on their own URDF, narrower limits, and what is refused."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.arm_urdf import read_arm_model
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics, link_transforms
from maniskill_tomato.robot.look_at_move import LookAtMover
from maniskill_tomato.robot.spheres import CAMERA_SPHERES, sphere_table
from maniskill_tomato.robot.transit import TransitPlanner

mj: Any = mujoco

OTHER_URDF = Path(__file__).parents[2] / "examples" / "make_it_yours" / "tomato_extras" / "iiwa7.urdf"
LENGTHS = (0.34, 0.4, 0.4, 0.126)
"""Of the iiwa 7 by its data sheet, in [m]."""

READY = (0.0, -0.9, 0.0, -1.7, 0.0, 0.8, 0.0)


def read(urdf: Path, **changed: Any) -> ArmModel:
    given: dict[str, Any] = {
        "name": "other",
        "flange_link": "link_ee",
        "acceleration_limits": (10.0,) * 7,
        "spheres": IIWA14.spheres,
        "ready_qpos": READY,
    }
    return read_arm_model(urdf, **{**given, **changed})


def edited(folder: Path, edit: Callable[[str], str]) -> Path:
    path = folder / "edited.urdf"
    path.write_text(edit(OTHER_URDF.read_text()))
    return path


def turned_frames(folder: Path) -> Path:
    """The same arm, its link frames turned at random and joints 2, 4 and 7 the other way round."""
    root = ElementTree.parse(OTHER_URDF).getroot()
    turns = [np.eye(3), *Rotation.random(7, rng=np.random.default_rng(0)).as_matrix(), np.eye(3)]
    for i, joint in enumerate(root.findall("joint")):
        origin: Any = joint.find("origin")
        xyz = np.array([float(v) for v in origin.attrib["xyz"].split()])
        origin.attrib["xyz"] = " ".join(str(v) for v in turns[i].T @ xyz)
        rpy = Rotation.from_matrix(turns[i].T @ turns[i + 1]).as_euler("xyz")
        origin.attrib["rpy"] = " ".join(str(v) for v in rpy)
        axis: Any = joint.find("axis")
        if axis is not None:
            sense = -1.0 if i in (1, 3, 6) else 1.0
            turned = sense * turns[i + 1].T @ np.array([float(v) for v in axis.attrib["xyz"].split()])
            axis.attrib["xyz"] = " ".join(str(v) for v in turned)
    path = folder / "turned.urdf"
    ElementTree.ElementTree(root).write(path)
    return path


def narrow(folder: Path) -> Path:
    """Joint 4 only half as far to the one side and a third to the other, joint 6 three quarters."""
    root = ElementTree.parse(OTHER_URDF).getroot()
    for joint, lower, upper in ((3, -1.05, 0.7), (5, -1.57, 1.57)):
        limit: Any = root.findall("joint")[joint].find("limit")
        limit.attrib["lower"], limit.attrib["upper"] = str(lower), str(upper)
    path = folder / "narrow.urdf"
    ElementTree.ElementTree(root).write(path)
    return path


def random_qpos(model: ArmModel, n: int, seed: int) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return torch.as_tensor(rng.uniform(model.joint_lower, model.joint_upper, (n, 7)))


def by_mujoco(urdf: Path, qpos: NDArray[np.float64], links: tuple[str, ...]) -> NDArray[np.float64]:
    """T_base_link of each link at joint angles, by MuJoCo's own reader. Shape (N, L, 4, 4)."""
    spec = mj.MjSpec.from_file(str(urdf))
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mj.MjData(model)
    poses = np.tile(np.eye(4), (len(qpos), len(links), 1, 1))
    for n, q in enumerate(qpos):
        data.qpos[:] = q
        mj.mj_kinematics(model, data)
        for k, name in enumerate(links):
            body = data.body(name)
            poses[n, k, :3, :3], poses[n, k, :3, 3] = body.xmat.reshape(3, 3), body.xpos
    return poses


def test_the_shipped_urdf_reads_as_the_numbers_of_the_iiwa_14() -> None:
    model = read(IIWA14.urdf, ready_qpos=IIWA14.ready_qpos)
    assert (model.joint_names, model.link_names) == (IIWA14.joint_names, IIWA14.link_names)
    for name in (
        "joint_lower",
        "joint_upper",
        "velocity_limits",
        "torque_limits",
        "joint_origins",
        "joint_axes",
    ):
        np.testing.assert_array_equal(getattr(model, name), getattr(IIWA14, name))
    assert model.flange_height == IIWA14.flange_height
    assert model.link_turns is None and model.flips is None


@pytest.mark.parametrize("make", [lambda folder: OTHER_URDF, turned_frames, narrow])
def test_links_of_another_arm_stand_where_mujoco_has_them(
    make: Callable[[Path], Path], tmp_path: Path
) -> None:
    urdf = make(tmp_path)
    model = read(urdf, ready_qpos=(0.0,) * 7)
    assert (
        model.base_to_shoulder,
        model.shoulder_to_elbow,
        model.elbow_to_wrist,
        model.wrist_to_flange,
    ) == LENGTHS
    qpos = random_qpos(model, 50, seed=1)
    expected = by_mujoco(urdf, qpos.numpy(), model.link_names)
    np.testing.assert_allclose(link_transforms(qpos, model).numpy(), expected, atol=1e-9)
    np.testing.assert_allclose(forward_kinematics(qpos, model).numpy(), expected[:, -1], atol=1e-9)


@pytest.mark.parametrize("make", [lambda folder: OTHER_URDF, turned_frames])
def test_another_arm_reaches_the_poses_that_it_can_take(make: Callable[[Path], Path], tmp_path: Path) -> None:
    urdf = make(tmp_path)
    model = read(urdf, ready_qpos=(0.0,) * 7)
    wanted = by_mujoco(urdf, random_qpos(model, 300, seed=2).numpy(), ("link_ee",))[:, 0]
    solution = InverseKinematics(model=model).solve(torch.as_tensor(wanted), random_qpos(model, 300, seed=3))
    assert (solution.reach == int(Reach.REACHABLE)).all()
    assert (solution.qpos.numpy() >= model.joint_lower).all()
    assert (solution.qpos.numpy() <= model.joint_upper).all()
    reached = by_mujoco(urdf, solution.qpos.numpy(), ("link_ee",))[:, 0]
    np.testing.assert_allclose(reached, wanted, atol=1e-8)
    np.testing.assert_allclose(solution.T_base_ee.numpy(), wanted, atol=1e-8)


def test_joints_of_another_arm_stay_within_its_narrower_limits(tmp_path: Path) -> None:
    model, wide = read(narrow(tmp_path), ready_qpos=(0.0,) * 7), read(OTHER_URDF)
    qpos = random_qpos(wide, 500, seed=4)
    poses, reference = forward_kinematics(qpos, wide), torch.zeros(500, 7, dtype=torch.float64)
    assert (InverseKinematics(model=wide).solve(poses, reference).reach == int(Reach.REACHABLE)).all()
    solution = InverseKinematics(model=model).solve(poses, reference, neighbour=False)
    found = solution.reach == int(Reach.REACHABLE)
    assert 10 < int(found.sum()) < 400
    assert (solution.qpos[found].abs() <= torch.as_tensor(model.symmetric_limits) + 1e-12).all()
    assert float(model.symmetric_limits[3]) == pytest.approx(0.7)
    assert_close(forward_kinematics(solution.qpos[found], model), poses[found], rtol=0, atol=1e-6)
    outside = (qpos[:, 3].abs() > 0.71) & found
    # |q4| follows from the distance of the wrist alone.
    assert not bool(outside.any())


def test_the_iiwa_14_and_another_arm_disagree_on_the_same_joints() -> None:
    other, qpos = read(OTHER_URDF), torch.as_tensor(IIWA14.ready_qpos.copy())[None]
    apart = forward_kinematics(qpos)[0, :3, 3] - forward_kinematics(qpos, other)[0, :3, 3]
    assert float(apart.norm()) > 0.02


def test_look_at_moves_and_transits_of_another_arm_end_where_its_flange_is(tmp_path: Path) -> None:
    model = read(turned_frames(tmp_path), ready_qpos=(0.0, 0.9, 0.0, 1.7, 0.0, 0.8, 0.0))
    qpos = torch.as_tensor(model.ready_qpos.copy())[None]
    mover, target = LookAtMover(model=model), torch.tensor([[0.75, 0.0, 0.85]], dtype=torch.float64)
    look = mover.look_from(qpos, torch.tensor([[0.35, 0.05, 0.85]], dtype=torch.float64), target)
    assert int(look.reach[0]) == Reach.REACHABLE
    mount = torch.tensor(T_flange_camera_color_optical)
    flange = torch.as_tensor(by_mujoco(model.urdf, look.qpos.numpy(), ("link_ee",))[:, 0])
    assert_close(flange @ mount, look.T_world_camera, rtol=0, atol=1e-8)
    transit = TransitPlanner(model=model).plan(
        look.qpos[0], torch.tensor([[0.4, 0.25, 0.9]], dtype=torch.float64), target[0]
    )
    assert transit is not None
    end = torch.as_tensor(by_mujoco(model.urdf, transit.waypoints[-1:].numpy(), ("link_ee",))[0, 0])
    assert_close(end @ mount, transit.T_world_camera, rtol=0, atol=1e-8)
    assert any(bool((way == torch.tensor(model.ready_qpos)).all()) for way in transit.waypoints)


def test_the_table_of_spheres_has_the_arms_own_and_the_camera() -> None:
    spheres = {**IIWA14.spheres, "link_7": ((0.0, 0.0, 0.01, 0.123),)}
    model = read(OTHER_URDF, spheres=spheres)
    links, table = sphere_table(model=model)
    own = [model.link_names[k] for k in links[: -len(CAMERA_SPHERES)]]
    assert own == [name for name, several in spheres.items() for _ in several]
    assert table[own.index("link_7"), 3] == np.float32(0.123)
    assert (links[-len(CAMERA_SPHERES) :] == 8).all()


REFUSED: dict[str, tuple[Callable[[str], str], str]] = {
    "six joints": (lambda t: t.replace('"A3" type="revolute"', '"A3" type="fixed"'), "6 joints turn"),
    "a slide": (lambda t: t.replace('"A3" type="revolute"', '"A3" type="prismatic"'), "A3 is prismatic"),
    "a gripper": (
        lambda t: t.replace(
            "</robot>",
            '<link name="finger"/><joint name="grip" type="revolute"><parent link="link_ee"/><child link="finger"/>'
            '<limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>',
        ),
        "grip can move and lies not between",
    ),
    "an elbow beside the axis": (
        lambda t: t.replace('xyz="0 0.0105 0.181"', 'xyz="0.0825 0.0105 0.181"'),
        "the axis of A4 passes the z axis of the base at 82.500 mm; only arms are served that are spherical",
    ),
    "a crooked axis": (
        lambda t: t.replace('xyz="0 0 0.1475"', 'xyz="0 0 0.1475" rpy="0.01 0 0"'),
        "A1 must turn about the z axis",
    ),
    "endless joints": (
        lambda t: re.sub(r'lower="\S+" upper="\S+" (effort="40" velocity="3.1415927")', r"\1", t),
        "A6 must have a limit with a finite lower, got None",
    ),
    "infinite limits": (lambda t: t.replace('upper="3.0543262"', 'upper="inf"'), "finite upper, got 'inf'"),
    "limits that are no numbers": (
        lambda t: t.replace('upper="3.0543262"', 'upper="nan"'),
        "finite upper, got 'nan'",
    ),
    "degrees": (lambda t: t.replace('upper="3.0543262"', 'upper="175"'), "limits -3.05433 and 175 rad"),
    "limits on one side of 0": (
        lambda t: t.replace('upper="3.0543262"', 'upper="-0.5"'),
        "the upper from 0.1",
    ),
    "no speed": (
        lambda t: t.replace('velocity="2.2689280"', 'velocity="0"'),
        "velocity_limits of A4 must be from 0.01 to 20",
    ),
    "no chain": (
        lambda t: t.replace('<child link="link_ee"/>', '<child link="hand"/>'),
        "no joint leads to a link",
    ),
    "no URDF": (lambda t: t.replace("robot", "sdf"), "begins with <sdf>"),
    "no XML": (lambda t: t[:500], "cannot be read"),
    "words for numbers": (lambda t: t.replace('xyz="0 0 0.1475"', 'xyz="0 0 up"'), "three finite numbers"),
    "a hand beside its axis": (
        lambda t: t.replace('xyz="0 0 0.035"', 'xyz="0.02 0 0.035"'),
        "link_ee must lie on the axis of the last joint, it is 20.000 mm off",
    ),
    "a turned hand": (
        lambda t: t.replace('xyz="0 0 0.035"', 'xyz="0 0 0.035" rpy="0 0 1.57"'),
        "must stand as the base does",
    ),
}


@pytest.mark.parametrize("what", list(REFUSED))
def test_an_arm_that_cannot_be_served_is_refused_in_words(what: str, tmp_path: Path) -> None:
    edit, words = REFUSED[what]
    path = edited(tmp_path, edit)
    assert path.read_text() != OTHER_URDF.read_text()
    with pytest.raises(InvalidInputError, match=re.escape(words)):
        read(path)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"spheres": None}, "spheres must name links, got None"),
        ({"acceleration_limits": (5e-324,) * 7}, "acceleration_limits of A1 must be from 0.01 to 1000"),
        ({"spheres": {}}, "no spheres cover link_5, link_6, link_7, link_ee"),
        ({"spheres": {**IIWA14.spheres, "link_6": ()}}, "no spheres cover link_6"),
        ({"spheres": {**IIWA14.spheres, "hand": ((0, 0, 0, 0.1),)}}, "names links that it has not: hand"),
        ({"spheres": {**IIWA14.spheres, "link_6": ((0, 0, 0, np.nan),)}}, "spheres of link_6 must be"),
        ({"spheres": {**IIWA14.spheres, "link_6": ((0, 0, 0, 50.0),)}}, "spheres of link_6 must be"),
        ({"acceleration_limits": (10.0,) * 6}, "acceleration_limits must be finite numbers of shape (7,)"),
        ({"acceleration_limits": (10.0,) * 6 + (np.inf,)}, "acceleration_limits must be finite"),
        ({"ready_qpos": (0.0, -2.5, 0.0, 0.0, 0.0, 0.0, 0.0)}, "ready_qpos has A2 at -2.5 rad"),
        ({"urdf": Path("nowhere.urdf")}, "cannot be read"),
    ],
)
def test_a_declaration_that_leaves_something_out_is_refused(changed: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidInputError, match=re.escape(words)):
        read(changed.pop("urdf", OTHER_URDF), **changed)


def test_models_are_not_changed_behind_the_guard() -> None:
    model = read(OTHER_URDF)
    with pytest.raises(ValueError, match="read-only"):
        model.joint_upper[3] = 9.0
    with pytest.raises(InvalidInputError, match="each of another name"):
        replace(model, joint_names=("A1",) * 7)
