"""What viewers find in a recording: the mcap library reads it back as arm, pictures and points at their places."""

import json
import re
import shutil
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
import pytest
import trimesh
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.policy_run import RunConfig, prepare, run_goal
from maniskill_tomato.deploy.profile import parse_profile
from maniskill_tomato.deploy.recording import JSON_TOPICS, McapRecorder
from maniskill_tomato.deploy.run_records import KeptSteps, RunResult, Step
from maniskill_tomato.deploy.run_replay import load_recording
from maniskill_tomato.deploy.viewer_arm import simple_urdf
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import JOINT_NAMES

Floats = NDArray[np.float64]
RERUN = shutil.which("rerun")
mj: Any = mujoco

TEXT = """
[arm]
driver = "mock"
[camera]
driver = "mock"
[twin]
width = 160
height = 120
depth_noise = 0.0
[perception]
segmenter = "ground_truth"
[target]
source = "twin"
[loop]
max_moves = 2
"""

VIEWED = {
    "/tf": "foxglove.FrameTransforms",
    "/joint_states": "foxglove.JointStates",
    "/camera/calibration": "foxglove.CameraCalibration",
    "/camera/color": "foxglove.CompressedImage",
    "/camera/mask": "foxglove.CompressedImage",
    "/camera/depth": "foxglove.RawImage",
    "/camera/points": "foxglove.PointCloud",
}
"""What every look has."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    path: Path
    result: RunResult
    steps: list[Step]
    plant: Any
    """The twin's plant as one mesh in the base frame."""
    messages: dict[str, list[tuple[str, str, int, Any]]]
    """Of each topic: schema, encoding, log time in [ns], content."""


def read(path: Path) -> dict[str, list[tuple[str, str, int, Any]]]:
    found: dict[str, list[tuple[str, str, int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            content: Any = message.data
            if channel.message_encoding == "protobuf":
                decoder = DecoderFactory().decoder_for("protobuf", schema)
                assert decoder is not None
                content = decoder(message.data)
            entry = (schema.name, channel.message_encoding, message.log_time, content)
            found.setdefault(channel.topic, []).append(entry)
    return found


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    out = tmp_path_factory.mktemp("viewed")
    config = RunConfig(profile=parse_profile(TEXT, Path("viewed.toml")), out=out, policy="nbv", seed=5)
    prepared, kept = prepare(config), KeptSteps()
    result, _ = run_goal(config, prepared, None, [kept])
    episode = prepared.workcell.twin().episode
    organs = [trimesh.Trimesh(o.vertices, o.faces, process=False) for o in episode.plant.organs]
    plant: Any = trimesh.util.concatenate(organs)
    plant.apply_transform(episode.T_world_plant.double().numpy())
    return Recorded(
        path=out / "run.mcap", result=result, steps=kept.steps, plant=plant, messages=read(out / "run.mcap")
    )


def seconds(timestamp: Any) -> int:
    return int(timestamp.seconds) * 10**9 + int(timestamp.nanos)


def placed(message: Any) -> dict[str, Floats]:
    """The pose of every frame in `link_0`, from a message of `/tf`."""
    poses = {"link_0": np.eye(4)}
    left = list(message.transforms)
    while left:
        ready = [one for one in left if one.parent_frame_id in poses]
        assert ready, "a frame hangs in the air"
        for one in ready:
            r, t = one.rotation, one.translation
            assert np.linalg.norm([r.x, r.y, r.z, r.w]) == pytest.approx(1.0, abs=1e-9)
            T = np.eye(4)
            T[:3, :3] = Rotation.from_quat([r.x, r.y, r.z, r.w]).as_matrix()
            T[:3, 3] = [t.x, t.y, t.z]
            poses[one.child_frame_id] = poses[one.parent_frame_id] @ T
        left = [one for one in left if one not in ready]
    return poses


def cloud(message: Any) -> tuple[Floats, NDArray[np.uint8]]:
    """Points in the frame of the cloud, in [m], shape (P, 3); and their colours, RGB, shape (P, 3)."""
    offsets = {field.name: (field.offset, field.type) for field in message.fields}
    assert offsets["x"] == (0, 7) and offsets["z"] == (8, 7) and offsets["blue"] == (14, 1)
    raw = np.frombuffer(message.data, dtype=np.uint8).reshape(-1, message.point_stride)
    return raw[:, :12].copy().view("<f4").astype(np.float64), raw[:, 12:15].copy()


def test_every_look_is_there_in_the_schemas_that_viewers_know(recorded: Recorded) -> None:
    looks = len(recorded.steps)
    assert looks == 3
    for topic, schema in VIEWED.items():
        assert [entry[:2] for entry in recorded.messages[topic]] == [(schema, "protobuf")] * looks
    assert recorded.messages["/log"][0][:2] == ("foxglove.Log", "protobuf")
    ((name, encoding, _, content),) = recorded.messages["/robot_description"]
    assert (name, encoding) == ("std_msgs/msg/String", "cdr")
    # Little-endian, then the length with the closing zero.
    assert content[:4] == b"\0\1\0\0" and int.from_bytes(content[4:8], "little") == len(content) - 8
    assert content[8:-1].decode() == simple_urdf() and content[-1] == 0


def test_all_times_are_of_one_clock_that_begins_at_the_date_of_the_run(recorded: Recorded) -> None:
    times = [entry[2] for entries in recorded.messages.values() for entry in entries]
    assert 0 <= time.time_ns() - min(times) < 600 * 10**9
    assert max(times) - min(times) == pytest.approx(recorded.result.device_seconds * 1e9, abs=1e6)
    for topic in VIEWED:
        for (_, _, log_time, message), step in zip(recorded.messages[topic], recorded.steps, strict=True):
            stamps = [t.timestamp for t in message.transforms] if topic == "/tf" else [message.timestamp]
            assert {seconds(stamp) for stamp in stamps} == {log_time}
            first = recorded.messages[topic][0][2] - round(recorded.steps[0].frame.stamp * 1e9)
            assert log_time - first == pytest.approx(round(step.frame.stamp * 1e9), abs=1000)


def test_every_link_stands_where_mujoco_puts_it(recorded: Recorded) -> None:
    """From the URDF in the file and the joints in the file."""
    model = mj.MjModel.from_xml_string(recorded.messages["/robot_description"][0][3][8:-1].decode())
    data = mj.MjData(model)
    links = [model.body(k).name for k in range(1, model.nbody)]
    assert {"link_7", "link_ee", "camera_link", "camera_color_optical_frame"} <= set(links)
    for tf, joints in zip(recorded.messages["/tf"], recorded.messages["/joint_states"], strict=True):
        assert tuple(joint.name for joint in joints[3].joints) == JOINT_NAMES
        for joint in joints[3].joints:
            data.joint(joint.name).qpos[0] = joint.position
        mj.mj_forward(model, data)
        poses = placed(tf[3])
        assert set(poses) == {"link_0", *links}
        for name in links:
            np.testing.assert_allclose(poses[name][:3, 3], data.body(name).xpos, atol=1e-6)
            np.testing.assert_allclose(poses[name][:3, :3].ravel(), data.body(name).xmat, atol=1e-6)


def test_pictures_and_depth_are_those_that_the_loop_saw(recorded: Recorded) -> None:
    for k, step in enumerate(recorded.steps):
        color = recorded.messages["/camera/color"][k][3]
        assert color.format == "png"
        pixels: Any = cv2.imdecode(np.frombuffer(color.data, np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(pixels[..., ::-1], step.frame.color)
        depth = recorded.messages["/camera/depth"][k][3]
        assert (depth.encoding, depth.width, depth.height, depth.step) == ("16UC1", 160, 120, 320)
        millimetres = np.frombuffer(depth.data, "<u2").reshape(120, 160)
        np.testing.assert_allclose(millimetres, 1000.0 * step.frame.depth, atol=0.5001)
        assert millimetres.max() > 300


def test_points_lie_on_the_plant_and_project_onto_their_pixels(recorded: Recorded) -> None:
    surface = KDTree(trimesh.sample.sample_surface(recorded.plant, 200_000, seed=0)[0])
    fruit_points = 0
    for k, step in enumerate(recorded.steps):
        message, poses = recorded.messages["/camera/points"][k][3], placed(recorded.messages["/tf"][k][3])
        calibration = recorded.messages["/camera/calibration"][k][3]
        assert calibration.frame_id == message.frame_id == "camera_color_optical_frame"
        points, colors = cloud(message)
        # Integers are the middles of pixels.
        P = np.array(calibration.P).reshape(3, 4)
        np.testing.assert_array_equal(P[:, :3].ravel(), calibration.K)
        projected = np.c_[points, np.ones(len(points))] @ P.T
        pixels = projected[:, :2] / projected[:, 2:]
        columns, rows = np.round(pixels).astype(int).T
        np.testing.assert_allclose(pixels, np.c_[columns, rows], atol=1e-3)
        np.testing.assert_array_equal(colors, step.frame.color[rows, columns])
        assert len(points) == int((step.frame.depth > 0.0).sum()) > 1000

        T = poses[message.frame_id]
        np.testing.assert_allclose(T, step.T_world_camera, atol=1e-9)
        in_base = points @ T[:3, :3].T + T[:3, 3]
        assert step.frame.truth is not None
        labels = step.frame.truth.labels[rows, columns]
        away, _ = surface.query(in_base[labels >= 2])
        # The samples are some millimetres apart; edges of leaves are seen over half a pixel.
        assert np.median(away) < 0.003 and np.quantile(away, 0.95) < 0.01
        fruit = in_base[labels == step.frame.truth.target_label]
        fruit_points += len(fruit)
        assert (np.linalg.norm(fruit - step.frame.truth.target_position, axis=1) < 0.05).all()
    assert fruit_points > 50


def test_the_arms_shape_moves_with_its_links(recorded: Recorded) -> None:
    ((name, _, _, scene),) = recorded.messages["/arm/shape"]
    assert name == "foxglove.SceneUpdate"
    shown = {entity.frame_id: entity for entity in scene.entities}
    assert set(shown) == {*(f"link_{k}" for k in range(8)), "link_ee", "camera_link"}
    assert all(entity.frame_locked and entity.id == frame for frame, entity in shown.items())
    kept_by_mujoco = simple_urdf().replace("visual>", "collision>")
    model = mj.MjModel.from_xml_string(kept_by_mujoco)
    for kind, geom, along in (
        ("cylinders", mj.mjtGeom.mjGEOM_CYLINDER, 1),
        ("cubes", mj.mjtGeom.mjGEOM_BOX, 2),
        ("spheres", mj.mjtGeom.mjGEOM_SPHERE, 0),
    ):
        drawn = sorted(
            round(shape.size.z / 2.0, 6) for entity in shown.values() for shape in getattr(entity, kind)
        )
        known = [model.geom(k).size for k in range(model.ngeom) if model.geom(k).type[0] == geom]
        assert drawn == sorted(round(float(size[along]), 6) for size in known) != []
    assert all(c.top_scale == c.bottom_scale == 1.0 for entity in shown.values() for c in entity.cylinders)


def test_our_own_messages_keep_to_the_schemas_beside_them(recorded: Recorded) -> None:
    kinds: dict[str, Any] = {
        "number": (int, float),
        "integer": int,
        "string": str,
        "array": list,
        "object": dict,
        "boolean": bool,
    }
    # A run that ends well has no fault; `test_fault_state` looks at those.
    assert JSON_TOPICS.keys() - recorded.messages.keys() == {"/fault"}
    for topic, (name, schema) in JSON_TOPICS.items():
        for found, encoding, _, content in recorded.messages.get(topic, []):
            assert (found, encoding) == (name, "json")
            message = json.loads(content)
            assert set(schema["required"]) <= set(message) <= set(schema["properties"])
            for key, value in message.items():
                wanted = schema["properties"][key]
                allowed = [one["type"] for one in wanted.get("anyOf", [wanted])]
                assert (value is None and "null" in allowed) or isinstance(
                    value, tuple(kinds[kind] for kind in allowed if kind != "null")
                ), (topic, key)


@pytest.mark.parametrize("kind", ["millimetres", "finer", "far"])
def test_depth_comes_back_to_the_last_bit(recorded: Recorded, tmp_path: Path, kind: str) -> None:
    rng, shape = np.random.default_rng(0), (120, 160)
    depth = {
        "millimetres": (rng.integers(0, 4000, shape) / 1000.0).astype(np.float32),
        "finer": rng.random(shape, dtype=np.float32),
        "far": (rng.integers(0, 90_000, shape) / 1000.0).astype(np.float32),
    }[kind]
    step = recorded.steps[0]
    clock, info = SimulatedClock(step.frame.stamp - 1.0), {"profile_text": TEXT, "policy": "nbv", "seed": 9}
    mount = np.array(T_flange_camera_color_optical)
    with McapRecorder(tmp_path / "run.mcap", info, clock, mount) as recorder:
        recorder.step(replace(step, frame=replace(step.frame, depth=depth)))
    np.testing.assert_array_equal(load_recording(tmp_path / "run.mcap").steps[0].frame.depth, depth)
    assert ("/camera/depth_m" in read(tmp_path / "run.mcap")) == (kind != "millimetres")


@pytest.mark.slow
@pytest.mark.skipif(RERUN is None, reason="no rerun on PATH")
def test_rerun_reads_the_recording_as_arm_pictures_and_points(recorded: Recorded, tmp_path: Path) -> None:
    assert RERUN is not None
    converted = tmp_path / "run.rrd"
    for words in (
        ["mcap", "convert", str(recorded.path), "-o", str(converted)],
        ["rrd", "verify", str(converted)],
    ):
        subprocess.run([RERUN, *words], check=True, capture_output=True, timeout=120)
    printed = subprocess.run(
        [RERUN, "rrd", "print", str(converted)], check=True, capture_output=True, text=True, timeout=120
    ).stdout
    found: dict[str, list[str]] = {}
    for entity, columns in re.findall(r" - (/\S*) - data columns: \[(.*)\]", printed):
        found.setdefault(entity, []).append(columns)
    looks = len(recorded.steps)
    for topic, columns in (
        ("/camera/color", "EncodedImage:blob"),
        ("/camera/depth", "Image:buffer"),
        ("/camera/points", "Points3D:positions"),
        ("/camera/calibration", "Pinhole:image_from_camera"),
        ("/tf", "Transform3D:translation"),
    ):
        assert sum(columns in chunk for chunk in found[topic]) >= looks, topic
    drawn = {entity.split("/")[3] for entity in found if "/visual_geometries/" in entity}
    assert {f"link_{k}" for k in range(8)} <= drawn
