"""Numbers of the KUKA LBR iiwa 14 R820: geometry, limits, home, spheres; and `IIWA14`, its model.

The link frames and joint origins are those of the `lbr_description` package (all origins without
rotation), because the inertial parameters used in the URDF are expressed in these frames. The joint
offsets across the links (0.01, 0.0105 and 0.0707 m) cancel along the chain, so the arm is
spherical-rotational-spherical: shoulder, elbow and wrist centres with nothing but the four segment
lengths between them.

The end effector `link_ee` is the plain flange face, 126 mm from the wrist centre; a media flange
ordered with a real arm moves it (KUKA's own ROS 2 model has 152 mm).
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from maniskill_tomato.assets import ASSETS_DIR
from maniskill_tomato.robot.arm_model import NUM_JOINTS as NUM_JOINTS
from maniskill_tomato.robot.arm_model import ArmModel, Sphere

URDF_NAME: Final = "iiwa14/iiwa14.urdf"
"""The URDF, relative to the package's assets."""

JOINT_NAMES: Final = tuple(f"joint_{i}" for i in range(1, 8))
"""The revolute joints A1 to A7, base to flange."""

LINK_NAMES: Final = (*(f"link_{i}" for i in range(8)), "link_ee")
"""The links, base to flange; `link_ee` is fixed to `link_7`."""

EE_LINK_NAME: Final = "link_ee"


def _constant(values: object) -> npt.NDArray[np.float64]:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


JOINT_UPPER: Final = _constant(np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0]))
"""Upper joint limits, in [rad]. Shape (7,)."""

JOINT_LOWER: Final = _constant(-JOINT_UPPER)
"""Lower joint limits, in [rad]: the limits are symmetric. Shape (7,)."""

VELOCITY_LIMITS: Final = _constant(np.deg2rad([85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0]))
"""Largest joint speeds, in [rad/s]. Shape (7,)."""

TORQUE_LIMITS: Final = _constant([320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0])
"""Largest joint torques of the data sheet, in [N m]. Shape (7,)."""

ACCELERATION_LIMITS: Final = _constant([8.57, 8.57, 8.74, 11.36, 12.23, 15.72, 15.72])
"""Largest joint accelerations as measured by the authors of the Drake model, in [rad/s^2]. Shape (7,)."""

JOINT_ORIGINS: Final = _constant(
    [
        [0.0, 0.0, 0.1475],
        [0.0, -0.01, 0.2125],
        [0.0, 0.01, 0.228],
        [0.0, 0.0105, 0.192],
        [0.0, -0.0105, 0.2075],
        [0.0, -0.0707, 0.1925],
        [0.0, 0.0707, 0.091],
    ]
)
"""Origin of each joint (and of its child link) in the frame of its parent link, in [m]. Shape (7, 3)."""

JOINT_AXES: Final = _constant(
    [
        [0.0, 0.0, 1.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0],
        [0.0, -1.0, 0.0],
        [0.0, 0.0, 1.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0],
    ]
)
"""Unit axis of each joint in the frame of its child link. Shape (7, 3)."""

EE_ORIGIN: Final = _constant([0.0, 0.0, 0.035])
"""Origin of `link_ee` in the frame of `link_7`, in [m]; no rotation. Shape (3,)."""

BASE_TO_SHOULDER: Final = 0.360
"""Height of the shoulder centre above the base, in [m]."""

SHOULDER_TO_ELBOW: Final = 0.420
"""Length of the upper arm, in [m]."""

ELBOW_TO_WRIST: Final = 0.400
"""Length of the forearm, in [m]."""

WRIST_TO_EE: Final = 0.126
"""Distance from the wrist centre to the plain flange, in [m]."""

MODIFIED_DH: Final = _constant(
    [
        [0.0, 0.0, 0.360],
        [0.0, -np.pi / 2, 0.0],
        [0.0, np.pi / 2, 0.420],
        [0.0, np.pi / 2, 0.0],
        [0.0, -np.pi / 2, 0.400],
        [0.0, -np.pi / 2, 0.0],
        [0.0, np.pi / 2, 0.126],
    ]
)
"""Modified Denavit-Hartenberg a_{i-1} [m], alpha_{i-1} [rad], d_i [m]; theta_i = q_i. Shape (7, 3)."""

HOME_QPOS: Final = _constant(np.zeros(7))
"""Home configuration: the arm stands straight up, flange at z = 1.306 m, in [rad]. Shape (7,)."""

READY_QPOS: Final = _constant(
    np.deg2rad([0.0, -49.93516285858080, 0.0, -97.54595928557242, 0.0, 42.38920357300838, 0.0])
)
"""The flange at (0.1, 0, 0.9) m, looking along +x with the picture upright and the elbow behind, in [rad]."""

REST_QPOS: Final = _constant(np.deg2rad([0.0, -30.0, 0.0, -115.0, 0.0, 95.0, 0.0]))
"""Folded over the base, looking down, in [rad]."""

LINK_SPHERES: Final[dict[str, tuple[Sphere, ...]]] = {
    "link_5": (
        (0.0, 0.0, 0.012, 0.0689),
        (0.0, -0.004, 0.045, 0.0688),
        (0.0, -0.016, 0.075, 0.0664),
        (0.0, -0.032, 0.103, 0.0639),
        (0.0, -0.05, 0.13, 0.0631),
        (0.0, -0.07, 0.157, 0.0661),
        (0.0, -0.076, 0.183, 0.07),
        (0.0, -0.078, 0.205, 0.0701),
    ),
    "link_6": (
        (0.0, 0.022, 0.0, 0.0672),
        (0.0, 0.05, 0.0, 0.066),
        (0.0, 0.078, 0.0, 0.0686),
        (0.0, 0.06, 0.035, 0.076),
        (0.0, 0.08, 0.03, 0.0759),
    ),
    "link_7": ((0.0, 0.0, 0.012, 0.0514),),
    "link_ee": ((0.0, 0.0, 0.008, 0.038),),
}
"""Centre x, y, z in the link's frame and radius of each sphere, in [m]; `link_ee` carries the bracket. Every point
of these links' meshes lies in one of their spheres. They reach 9 mm beyond the links in the mean (95 %: 25 mm)."""

IIWA14: Final = ArmModel(
    name="iiwa14",
    urdf=ASSETS_DIR / URDF_NAME,
    joint_names=JOINT_NAMES,
    link_names=LINK_NAMES,
    joint_lower=JOINT_LOWER,
    joint_upper=JOINT_UPPER,
    velocity_limits=VELOCITY_LIMITS,
    acceleration_limits=ACCELERATION_LIMITS,
    torque_limits=TORQUE_LIMITS,
    joint_origins=JOINT_ORIGINS,
    joint_axes=JOINT_AXES,
    flange_height=float(EE_ORIGIN[2]),
    spheres=LINK_SPHERES,
    ready_qpos=READY_QPOS,
)
"""The arm that everything here is about unless another one is named."""
