"""What a recording holds for viewers: pictures, depth, points and the arm as `foxglove.*` messages in Protobuf.

Only the recorder imports this module: foxglove-sdk belongs to the extra `deploy`.
"""

import math
from collections.abc import Sequence
from typing import Any, Final
from xml.etree import ElementTree

import cv2
import numpy as np
from foxglove import messages as fox
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from maniskill_tomato.deploy.deploy_errors import RecordingError
from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.deploy.viewer_arm import LinkFrame
from maniskill_tomato.robot.d435 import CameraIntrinsics

CAMERA_FRAME: Final = "camera_color_optical_frame"
"""The frame of all pictures and points."""

MOST_POINTS: Final = 80_000
"""Of a larger picture every second, third ... pixel in each direction becomes a point."""

GREY: Final = fox.Color(r=0.75, g=0.75, b=0.78, a=1.0)


def transforms(stamp: fox.Timestamp, frames: Sequence[LinkFrame]) -> fox.FrameTransforms:
    """Where every link is."""
    return fox.FrameTransforms(
        transforms=[
            fox.FrameTransform(
                timestamp=stamp,
                parent_frame_id=frame.parent,
                child_frame_id=frame.child,
                translation=_vector(frame.T_parent_child[:3, 3]),
                rotation=_quaternion(frame.T_parent_child[:3, :3]),
            )
            for frame in frames
        ]
    )


def joint_states(stamp: fox.Timestamp, names: Sequence[str], joint_positions: Float64) -> fox.JointStates:
    """The joints by the URDF's names, in [rad]. Shape (7,)."""
    return fox.JointStates(
        timestamp=stamp,
        joints=[
            fox.JointState(name=name, position=float(position))
            for name, position in zip(names, joint_positions, strict=True)
        ],
    )


def calibration(stamp: fox.Timestamp, intrinsics: CameraIntrinsics) -> fox.CameraCalibration:
    """A pinhole without distortion; (0, 0) is the centre of the first pixel, as in ROS and OpenCV."""
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx - 0.5, intrinsics.cy - 0.5
    return fox.CameraCalibration(
        timestamp=stamp,
        frame_id=CAMERA_FRAME,
        width=intrinsics.width,
        height=intrinsics.height,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def picture(stamp: fox.Timestamp, pixels: NDArray[Any]) -> fox.CompressedImage:
    """A PNG, without loss.

    Args:
        stamp: When it was taken.
        pixels: RGB, shape (H, W, 3), or one channel, shape (H, W).

    Raises:
        RecordingError: It cannot be packed.
    """
    bgr = np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels)
    ok, content = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not ok:
        raise RecordingError(f"a picture of shape {pixels.shape} cannot be packed as PNG")
    return fox.CompressedImage(timestamp=stamp, frame_id=CAMERA_FRAME, data=content.tobytes(), format="png")


def depth_image(stamp: fox.Timestamp, depth: NDArray[Any]) -> fox.RawImage:
    """A depth image: of uint16 in [mm] or of float32 in [m]. Shape (H, W)."""
    pixels = np.ascontiguousarray(depth, dtype=depth.dtype.newbyteorder("<"))
    return fox.RawImage(
        timestamp=stamp,
        frame_id=CAMERA_FRAME,
        width=pixels.shape[1],
        height=pixels.shape[0],
        encoding={2: "16UC1", 4: "32FC1"}[pixels.itemsize],
        step=pixels.strides[0],
        data=pixels.tobytes(),
    )


POINT: Final = np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)])
"""A point of a cloud: optical frame, in [m], and colour."""


def points(stamp: fox.Timestamp, frame: Frame) -> fox.PointCloud:
    """What has depth, in the camera's optical frame and its colours."""
    stride = math.ceil(math.sqrt(frame.depth.size / MOST_POINTS))
    thinned = (slice(None, None, stride), slice(None, None, stride))
    depth = frame.depth[thinned]
    there = np.isfinite(depth) & (depth > 0.0)
    rays = frame.intrinsics.ray_directions(frame.intrinsics.pixel_centres()[thinned][there])
    cloud = np.zeros(int(there.sum()), POINT)
    cloud["xyz"] = rays * depth[there][:, None]
    cloud["rgba"][:, :3], cloud["rgba"][:, 3] = frame.color[thinned][there], 255
    number = fox.PackedElementFieldNumericType
    fields = [
        *((name, 4 * k, number.Float32) for k, name in enumerate("xyz")),
        *((name, 12 + k, number.Uint8) for k, name in enumerate(("red", "green", "blue", "alpha"))),
    ]
    return fox.PointCloud(
        timestamp=stamp,
        frame_id=CAMERA_FRAME,
        pose=fox.Pose(position=_vector(np.zeros(3)), orientation=_quaternion(np.eye(3))),
        point_stride=POINT.itemsize,
        fields=[fox.PackedElementField(name=n, offset=at, type=kind) for n, at, kind in fields],
        data=cloud.tobytes(),
    )


def arm_shape(stamp: fox.Timestamp, urdf: str) -> fox.SceneUpdate:
    """The boxes, cylinders and spheres of a URDF, each moving with its link."""
    entities = []
    for link in ElementTree.fromstring(urdf).iter("link"):
        cubes, cylinders, spheres = [], [], []
        for visual in link.findall("visual"):
            pose = _origin(visual.find("origin"))
            for shape in visual.iterfind("geometry/*"):
                of = {name: [float(v) for v in text.split()] for name, text in shape.attrib.items()}
                if shape.tag == "box":
                    cubes.append(fox.CubePrimitive(pose=pose, size=_vector(of["size"]), color=GREY))
                elif shape.tag == "sphere":
                    size = _vector([2.0 * of["radius"][0]] * 3)
                    spheres.append(fox.SpherePrimitive(pose=pose, size=size, color=GREY))
                elif shape.tag == "cylinder":
                    wide = 2.0 * of["radius"][0]
                    size = _vector([wide, wide, of["length"][0]])
                    cylinders.append(
                        fox.CylinderPrimitive(
                            pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=GREY
                        )
                    )
        name = link.attrib["name"]
        if cubes or cylinders or spheres:
            entities.append(
                fox.SceneEntity(
                    timestamp=stamp,
                    frame_id=name,
                    id=name,
                    frame_locked=True,
                    cubes=cubes,
                    cylinders=cylinders,
                    spheres=spheres,
                )
            )
    return fox.SceneUpdate(entities=entities)


def log_line(stamp: fox.Timestamp, text: str) -> fox.Log:
    """A line of the log."""
    return fox.Log(timestamp=stamp, level=fox.LogLevel.Info, message=text, name="deploy")


def _origin(origin: ElementTree.Element | None) -> fox.Pose:
    attributes = {} if origin is None else origin.attrib
    xyz = [float(v) for v in attributes.get("xyz", "0 0 0").split()]
    rpy = [float(v) for v in attributes.get("rpy", "0 0 0").split()]
    return fox.Pose(
        position=_vector(xyz), orientation=_quaternion(Rotation.from_euler("xyz", rpy).as_matrix())
    )


def _vector(values: Sequence[float] | Float64) -> fox.Vector3:
    x, y, z = (float(v) for v in values)
    return fox.Vector3(x=x, y=y, z=z)


def _quaternion(rotation: Float64) -> fox.Quaternion:
    x, y, z, w = (float(v) for v in Rotation.from_matrix(rotation).as_quat())
    return fox.Quaternion(x=x, y=y, z=z, w=w)
