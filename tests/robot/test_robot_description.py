"""The shipped URDF and meshes against the arm's published numbers, MuJoCo and the closed-form kinematics."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import trimesh

from build_robot import build
from maniskill_tomato import assets
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import d435, iiwa14, robot_description
from maniskill_tomato.robot.kinematics import link_transforms
from robot_model import glb, meshes, solids, urdf

mj: Any = mujoco

# A1 to A7: origin xyz [m], axis, limit [degrees], velocity [degrees/s], torque [N m].
JOINTS = [
    ((0, 0, 0.1475), (0, 0, 1), 170, 85, 320),
    ((0, -0.01, 0.2125), (0, 1, 0), 120, 85, 320),
    ((0, 0.01, 0.228), (0, 0, 1), 170, 100, 176),
    ((0, 0.0105, 0.192), (0, -1, 0), 120, 75, 176),
    ((0, -0.0105, 0.2075), (0, 0, 1), 170, 130, 110),
    ((0, -0.0707, 0.1925), (0, 1, 0), 120, 135, 40),
    ((0, 0.0707, 0.091), (0, 0, 1), 175, 135, 40),
]
# Links 0 to 7: mass [kg], centre of mass [m], ixx iyy izz ixy ixz iyz [kg m^2].
INERTIALS = [
    (7.050378, (-0.012822, 0, 0.071507), (0.031226, 0.039697, 0.043102, 0, 0.000871, 0)),
    (5.289529, (0, -0.033795, 0.132404), (0.042462, 0.042838, 0.01587, 0, 0, 0.006341)),
    (5.688888, (0.000136, 0.047548, 0.076322), (0.055182, 0.053983, 0.016523, -0.000033, 0.000056, 0.010034)),
    (3.461245, (0, 0.034913, 0.123108), (0.02172, 0.02073, 0.007701, 0, 0, -0.003845)),
    (4.122995, (0, -0.039793, 0.086944), (0.03241, 0.030758, 0.009883, 0, 0, -0.006022)),
    (1.563756, (0, -0.029824, 0.076267), (0.008677, 0.007297, 0.003935, 0, 0, 0.002869)),
    (2.457878, (0, 0.07102, 0.00495), (0.007227, 0.006958, 0.004734, 0, 0, 0.000318)),
    (0.265331, (0, 0, 0.013782), (0.000175, 0.000175, 0.000306, 0, 0, 0)),
]
HOME, BENT = np.zeros(7), np.deg2rad([0, 20, 0, -70, 0, 90, 0])


@pytest.fixture(scope="module")
def root() -> ET.Element:
    return ET.parse(robot_description.urdf_path()).getroot()


@pytest.fixture(scope="module")
def model() -> Any:
    return mj.MjModel.from_xml_path(robot_description.urdf_path())


@pytest.fixture
def data(model: Any) -> Iterator[Any]:
    yield mj.MjData(model)


def element(parent: ET.Element, path: str) -> ET.Element:
    found = parent.find(path)
    assert found is not None, f"{parent.get('name')} has no {path}"
    return found


def numbers(node: ET.Element, attribute: str) -> list[float]:
    return [float(v) for v in node.get(attribute, "").split()]


def random_configurations(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.uniform(iiwa14.JOINT_LOWER, iiwa14.JOINT_UPPER, (count, 7))


def touching(model: Any, data: Any, qpos: np.ndarray) -> set[frozenset[str]]:
    data.qpos[:] = qpos
    mj.mj_kinematics(model, data)
    mj.mj_collision(model, data)
    return {
        frozenset(model.body(model.geom_bodyid[g]).name for g in contact.geom)
        for contact in data.contact[: data.ncon]
        if contact.dist < 0
    }


def test_joints_have_the_published_geometry_and_limits(root: ET.Element) -> None:
    for index, (origin, axis, limit, velocity, torque) in enumerate(JOINTS):
        joint = element(root, f"joint[@name='joint_{index + 1}']")
        assert joint.get("type") == "revolute"
        assert element(joint, "parent").get("link") == f"link_{index}"
        assert element(joint, "child").get("link") == f"link_{index + 1}"
        assert numbers(element(joint, "origin"), "xyz") == pytest.approx(origin)
        assert numbers(element(joint, "origin"), "rpy") == [0, 0, 0]
        assert numbers(element(joint, "axis"), "xyz") == pytest.approx(axis)
        limits = element(joint, "limit").attrib
        assert float(limits["lower"]) == pytest.approx(np.deg2rad(-limit))
        assert float(limits["upper"]) == pytest.approx(np.deg2rad(limit))
        assert float(limits["velocity"]) == pytest.approx(np.deg2rad(velocity))
        assert float(limits["effort"]) == torque


def test_links_have_the_published_inertials(root: ET.Element) -> None:
    for index, (mass, com, inertia) in enumerate(INERTIALS):
        inertial = element(root, f"link[@name='link_{index}']/inertial")
        assert float(element(inertial, "mass").get("value", "")) == mass
        assert numbers(element(inertial, "origin"), "xyz") == pytest.approx(com)
        entries = element(inertial, "inertia").attrib
        assert [float(entries[k]) for k in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")] == pytest.approx(
            inertia
        )


def test_the_arm_weighs_what_the_catalogue_says(model: Any) -> None:
    masses = {model.body(i).name: float(model.body_mass[i]) for i in range(model.nbody)}
    assert sum(masses[f"link_{i}"] for i in range(8)) == pytest.approx(29.9, abs=1e-5)
    assert masses["camera_link"] == pytest.approx(0.072)
    assert sum(masses.values()) < 29.9 + 0.072 + 0.05


def test_mujoco_keeps_every_link_and_the_torques(model: Any) -> None:
    names = {model.body(i).name for i in range(model.nbody)}
    assert set(iiwa14.LINK_NAMES) | {"camera_link", "camera_color_optical_frame"} <= names
    assert model.nq == 7
    torques = np.array([joint[4] for joint in JOINTS], dtype=float)
    np.testing.assert_allclose(model.jnt_actfrcrange, np.stack([-torques, torques], axis=1))


def test_mujoco_and_the_closed_form_agree_on_every_link(model: Any, data: Any) -> None:
    configurations = random_configurations(200)
    expected = link_transforms(torch.from_numpy(configurations)).numpy()
    bodies = [model.body(name).id for name in iiwa14.LINK_NAMES]
    for qpos, poses in zip(configurations, expected, strict=True):
        data.qpos[:] = qpos
        mj.mj_kinematics(model, data)
        np.testing.assert_allclose(data.xpos[bodies], poses[:, :3, 3], atol=1e-9)
        np.testing.assert_allclose(data.xmat[bodies].reshape(-1, 3, 3), poses[:, :3, :3], atol=1e-9)


@pytest.mark.parametrize(
    ("degrees", "flange"),
    [
        ((0, 0, 0, 0, 0, 0, 0), (0.0, 0.0, 1.306)),
        ((0, 20, 0, -70, 0, 90, 0), (0.5436, 0.0, 0.6287)),
        ((0, 45, 0, -90, 0, 0, 0), (0.6689, 0.0, 0.2850)),
    ],
)
def test_the_flange_is_where_other_models_of_the_arm_put_it(
    model: Any, data: Any, degrees: tuple[float, ...], flange: tuple[float, ...]
) -> None:
    data.qpos[:] = np.deg2rad(degrees)
    mj.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("link_ee").xpos, flange, atol=5e-5)


def test_camera_frames_stand_where_the_constants_say(model: Any, data: Any) -> None:
    data.qpos[:] = random_configurations(1)[0]
    mj.mj_kinematics(model, data)

    def pose(name: str) -> np.ndarray:
        body = data.body(name)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = body.xmat.reshape(3, 3), body.xpos
        return matrix

    flange = np.linalg.inv(pose("link_ee"))
    for name, expected in {
        "camera_link": d435.T_flange_camera,
        "camera_depth_frame": d435.T_flange_camera_depth,
        "camera_infra1_frame": d435.T_flange_camera_depth,
        "camera_color_frame": d435.T_flange_camera_color,
        "camera_depth_optical_frame": d435.T_flange_camera_depth_optical,
        "camera_color_optical_frame": d435.T_flange_camera_color_optical,
    }.items():
        np.testing.assert_allclose(flange @ pose(name), expected, atol=1e-9, err_msg=name)
    camera = np.linalg.inv(pose("camera_link"))
    np.testing.assert_allclose((camera @ pose("camera_infra2_frame"))[:3, 3], [0, -0.05, 0], atol=1e-9)
    screw = np.linalg.inv(pose("camera_bottom_screw_frame")) @ pose("camera_link")
    np.testing.assert_allclose(screw[:3, 3], [0.0106, 0.0175, 0.0125], atol=1e-9)


def test_every_link_that_one_sees_can_be_hit(root: ET.Element) -> None:
    for name in robot_description.VISIBLE_LINK_NAMES:
        link = element(root, f"link[@name='{name}']")
        assert link.findall("collision"), name
        assert not link.findall("collision/geometry/mesh"), name
        assert link.findall("visual/geometry/mesh"), name


@pytest.mark.parametrize("qpos", [HOME, BENT, -BENT])
def test_the_arm_does_not_touch_itself_in_ordinary_poses(model: Any, data: Any, qpos: np.ndarray) -> None:
    assert touching(model, data, qpos) == set()


def test_within_its_limits_the_arm_can_only_hit_its_base(model: Any, data: Any) -> None:
    hits = [touching(model, data, qpos) for qpos in random_configurations(2000)]
    assert all("link_0" in pair for pairs in hits for pair in pairs)
    assert sum(bool(pairs) for pairs in hits) < 0.02 * len(hits)


def test_the_arm_folded_down_hits_its_base(model: Any, data: Any) -> None:
    # The wrist is then 9 cm in front of the base's axis and 4 cm below its foot.
    pairs = touching(model, data, np.deg2rad([0, 110, 0, -120, 0, 100, 0]))
    assert frozenset({"link_0", "link_7"}) in pairs


def distance_to_shapes(points: np.ndarray, shapes: tuple[urdf.Primitive, ...]) -> np.ndarray:
    """How far points are outside of a link's collision shapes, in [m]; negative inside."""
    distances = []
    for shape in shapes:
        rel = np.abs(points - np.array(shape.center))
        if shape.kind == "sphere":
            distances.append(np.linalg.norm(points - np.array(shape.center), axis=1) - shape.radius)
            continue
        if shape.kind == "box":
            beyond = rel - np.array(shape.size) / 2
        else:
            along, across = (1, [0, 2]) if shape.axis == "y" else (2, [0, 1])
            radial = np.linalg.norm(rel[:, across], axis=1) - shape.radius
            beyond = np.stack([radial, rel[:, along] - shape.length / 2], axis=1)
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        distances.append(outside + np.minimum(beyond.max(axis=1), 0))
    return np.asarray(np.min(distances, axis=0))


def test_collision_shapes_hold_the_visible_shells() -> None:
    for name, (vertices, _) in robot_description.link_meshes().items():
        distances = distance_to_shapes(vertices, urdf.COLLISION_SHAPES[name])
        if name == "link_ee":
            camera = (vertices - d435.T_flange_camera[:3, 3]) @ d435.T_flange_camera[:3, :3]
            distances = np.minimum(
                distances, distance_to_shapes(camera, urdf.COLLISION_SHAPES["camera_link"])
            )
        assert distances.max() < 0.017, name


def test_link_meshes_are_closed_sets_of_triangles_within_the_budget() -> None:
    shapes = robot_description.link_meshes()
    assert tuple(shapes) == iiwa14.LINK_NAMES
    for name, (vertices, faces) in shapes.items():
        assert vertices.dtype == np.float32 and vertices.shape[1:] == (3,), name
        assert faces.dtype == np.int32 and faces.shape[1:] == (3,), name
        assert 0 <= faces.min() and faces.max() < len(vertices), name
        assert len(faces) <= 2500, name
        corners = vertices[faces].astype(np.float64)
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        assert areas.min() > 0, name
        volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        assert volume > 0, f"{name} is inside out"
    total = sum(
        path.stat().st_size
        for path in Path(robot_description.urdf_path()).parent.rglob("*")
        if path.is_file()
    )
    assert total < 3_000_000


def test_link_meshes_meet_at_the_joints_in_the_home_pose() -> None:
    poses = link_transforms(torch.zeros(1, 7, dtype=torch.float64))[0].numpy()
    placed = {
        name: vertices @ poses[i, :3, :3].T + poses[i, :3, 3]
        for i, (name, (vertices, _)) in enumerate(robot_description.link_meshes().items())
    }
    assert placed["link_0"][:, 2].min() == pytest.approx(0.0, abs=1e-6)
    for name, (below, above, height) in {
        "A1": ("link_0", "link_1", 0.1475),
        "A3": ("link_2", "link_3", 0.588),
        "A5": ("link_4", "link_5", 0.9875),
        "A7": ("link_6", "link_7", 1.271),
    }.items():
        near = [placed[link][np.abs(placed[link][:, 2] - height) < 0.004] for link in (below, above)]
        radii = [np.hypot(p[:, 0], p[:, 1]).max() for p in near]
        assert radii[0] == pytest.approx(radii[1], abs=1e-3), name
    # The media side of the flange ends at the flange face; the camera's glass is 50 mm in front of it.
    assert placed["link_7"][:, 2].max() == pytest.approx(1.306, abs=0.001)
    assert placed["link_ee"][:, 2].max() == pytest.approx(1.306 + 0.050 + 0.0009, abs=1e-4)


def test_nothing_of_the_robot_is_in_front_of_the_camera() -> None:
    vertices, _ = robot_description.link_meshes()["link_ee"]
    optical = (vertices - d435.T_flange_camera_color_optical[:3, 3]) @ d435.T_flange_camera_color_optical[
        :3, :3
    ]
    assert optical[:, 2].max() < d435.CAMERA_NEAR


def test_link_meshes_can_be_changed_without_harm() -> None:
    vertices, _ = robot_description.link_meshes()["link_3"]
    vertices += 1.0
    assert np.abs(robot_description.link_meshes()["link_3"][0] - vertices).min() > 0.5


def test_the_generator_gives_the_shipped_files(tmp_path: Path) -> None:
    shipped = Path(robot_description.urdf_path()).parent
    files = build(tmp_path)
    assert {f.relative_to(tmp_path) for f in files} == {
        f.relative_to(shipped) for f in shipped.rglob("*") if f.is_file()
    }
    assert (tmp_path / "iiwa14.urdf").read_text() == (shipped / "iiwa14.urdf").read_text()
    for file in files[1:]:
        new, old = (trimesh.load_scene(f / "meshes" / file.name) for f in (tmp_path, shipped))
        assert set(new.geometry) == set(old.geometry)
        for key in new.geometry:
            np.testing.assert_allclose(new.geometry[key].bounds, old.geometry[key].bounds, atol=1e-5)


def test_a_missing_urdf_is_said_and_not_asked_about(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assets, "ASSETS_DIR", tmp_path)
    with pytest.raises(FileNotFoundError, match="iiwa14.urdf"):
        robot_description.urdf_path()


def test_an_unknown_link_has_no_parts() -> None:
    with pytest.raises(InvalidInputError, match="link_0"):
        meshes.link_parts("link_9")


def test_a_triangulated_box_keeps_its_edges_and_volume() -> None:
    solid = solids.box([0.1, 0.0, 0.0], [0.2, 0.1, 0.3])
    vertices, normals, faces = solids.triangulate(solid, [0.0, -0.05, -0.15], [0.2, 0.05, 0.15], 0.021)
    assert vertices.min(axis=0) == pytest.approx([0.0, -0.05, -0.15], abs=1e-6)
    assert vertices.max(axis=0) == pytest.approx([0.2, 0.05, 0.15], abs=1e-6)
    p = vertices[faces]
    volume = np.einsum("fi,fi->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6
    assert volume == pytest.approx(0.2 * 0.1 * 0.3, rel=1e-6)
    # Every normal is along one axis: corners and edges were split, not smoothed.
    np.testing.assert_allclose(np.abs(normals).max(axis=1), 1.0, atol=1e-6)


def test_a_triangulated_sphere_is_round() -> None:
    solid = solids.ellipsoid([0.0, 0.0, 0.0], [0.1, 0.1, 0.1])
    vertices, normals, faces = solids.triangulate(solid, [-0.1] * 3, [0.1] * 3, 0.015)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.1, atol=6e-4)
    np.testing.assert_allclose(normals, vertices / np.linalg.norm(vertices, axis=1, keepdims=True), atol=0.02)
    p = vertices[faces]
    volume = np.einsum("fi,fi->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=0.02)


def test_a_stretched_revolution_is_a_stadium() -> None:
    profile = [(0.0, 0.0), (0.01, 0.0), (0.01, 0.03), (0.0, 0.03)]
    vertices, _, faces = solids.revolve(profile, 80, stretch=0.02)
    assert vertices.max(axis=0) == pytest.approx([0.03, 0.01, 0.03], abs=1e-6)
    p = vertices[faces]
    volume = np.einsum("fi,fi->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6
    assert volume == pytest.approx((np.pi * 0.01**2 + 0.04 * 0.02) * 0.03, rel=0.01)


def test_glb_files_are_the_same_every_time_and_keep_colours(tmp_path: Path) -> None:
    parts = meshes.link_parts("link_2")
    assert glb.to_glb(parts) == glb.to_glb(parts)
    path = tmp_path / "link.glb"
    path.write_bytes(glb.to_glb(parts))
    scene = trimesh.load_scene(path)
    colors = {tuple(g.visual.material.baseColorFactor[:3]) for g in scene.geometry.values()}
    assert len(colors) == 3  # paint, seam and orange cap
