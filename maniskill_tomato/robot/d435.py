"""The Intel RealSense D435: intrinsics of its streams, limits of its depth, where it sits on the flange.

Image coordinates are continuous: (0, 0) is the top-left corner of the first pixel, which covers [0, 1) in
both directions, as in SAPIEN. RealSense's SDK counts from the centre of that pixel (`from_realsense`
converts). Camera frames are x forward, y left, z up (`camera_*_frame`, the frame of a SAPIEN camera); optical
frames are z forward, x right, y down (`camera_*_optical_frame`). `T_a_b` maps points in b to a.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
import numpy.typing as npt

from maniskill_tomato.errors import InvalidInputError

FloatArray = npt.NDArray[np.float64]

Calibration = Literal["nominal", "measured", "gazebo"]
"""Which numbers describe the colour camera: the data sheet's, those of one real device, or a D435's in Gazebo."""

Stream = Literal["color", "depth"]
"""The two pictures a D435 takes, each with its own imager, field of view and place."""

CAMERA_LINK_NAME: Final = "camera_link"
"""The D435's housing in the URDF."""

COLOR_FRAME_NAME: Final = "camera_color_frame"
"""The URDF's frame of the colour camera, x forward, y left, z up."""

DEPTH_FRAME_NAME: Final = "camera_depth_frame"
"""The URDF's frame of the depth camera, the left infrared imager, x forward, y left, z up."""


LARGEST_SIDE: Final = 20_000
"""Of an image, in [px]."""

LARGEST_FOCAL_LENGTH: Final = 1e6
"""In [px]: a thousand times that of the D435."""


@dataclass(frozen=True, kw_only=True)
class CameraIntrinsics:
    """A pinhole camera: u = fx x / z + cx, v = fy y / z + cy for a point (x, y, z) in the optical frame."""

    width: int
    """Image width, in [px]."""
    height: int
    """Image height, in [px]."""
    fx: float
    """Horizontal focal length, in [px]."""
    fy: float
    """Vertical focal length, in [px]."""
    cx: float
    """Column of the principal point, in [px] from the left edge of the image."""
    cy: float
    """Row of the principal point, in [px] from the top edge of the image."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not 1 <= value <= LARGEST_SIDE:
                raise InvalidInputError(f"{name} must be 1 to {LARGEST_SIDE} pixels, got {value}")
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not 0 < value <= LARGEST_FOCAL_LENGTH:
                raise InvalidInputError(
                    f"{name} must be a positive number of pixels up to {LARGEST_FOCAL_LENGTH:g}, got {value}"
                )
        for name in ("cx", "cy"):
            value = getattr(self, name)
            if not abs(value) <= LARGEST_FOCAL_LENGTH:
                raise InvalidInputError(f"{name} must be within {LARGEST_FOCAL_LENGTH:g} pixels, got {value}")

    @classmethod
    def from_fov(cls, *, width: int, height: int, fov_y: float) -> "CameraIntrinsics":
        """Square pixels, centred principal point, vertical field of view `fov_y` in [rad]."""
        if not 0 < fov_y < math.pi:
            raise InvalidInputError(f"fov_y must be between 0 and pi rad, got {fov_y}")
        focal = height / 2 / math.tan(fov_y / 2)
        return cls(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)

    @classmethod
    def from_realsense(
        cls, *, width: int, height: int, fx: float, fy: float, ppx: float, ppy: float
    ) -> "CameraIntrinsics":
        """The numbers of the SDK's `rs2_intrinsics`, whose principal point counts from a pixel centre."""
        return cls(width=width, height=height, fx=fx, fy=fy, cx=ppx + 0.5, cy=ppy + 0.5)

    @property
    def matrix(self) -> FloatArray:
        """The camera matrix K. Shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def fov_x(self) -> float:
        """Horizontal field of view between the image's edges, in [rad]."""
        return math.atan(self.cx / self.fx) + math.atan((self.width - self.cx) / self.fx)

    @property
    def fov_y(self) -> float:
        """Vertical field of view between the image's edges, in [rad]."""
        return math.atan(self.cy / self.fy) + math.atan((self.height - self.cy) / self.fy)

    @property
    def symmetric(self) -> bool:
        """Whether pixels are square and the principal point is the image's middle, so that a field of view says all."""
        return self.fx == self.fy and self.cx == self.width / 2 and self.cy == self.height / 2

    def scaled(self, width: int, height: int) -> "CameraIntrinsics":
        """The intrinsics of the picture resized to `width` x `height` [px], each axis by its own factor."""
        sx, sy = width / self.width, height / self.height
        return CameraIntrinsics(
            width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def cropped(self, width: int, height: int) -> "CameraIntrinsics":
        """The intrinsics of a picture of another shape: the largest centred crop of this one, then resized.

        Pixels keep their shape. This is how the D435 makes its smaller modes.
        """
        scale = max(width / self.width, height / self.height)
        return CameraIntrinsics(
            width=width,
            height=height,
            fx=self.fx * scale,
            fy=self.fy * scale,
            cx=width / 2 + (self.cx - self.width / 2) * scale,
            cy=height / 2 + (self.cy - self.height / 2) * scale,
        )

    def project(self, points_optical: npt.ArrayLike) -> FloatArray:
        """Image coordinates of points in front of the camera; NaN for points at or behind it.

        Args:
            points_optical: Points in the optical frame, in [m]. Shape (..., 3).

        Returns:
            Columns u and rows v, in [px]; they may lie outside the image. Shape (..., 2).
        """
        points = np.asarray(points_optical, dtype=np.float64)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        return np.stack(
            [self.fx * points[..., 0] / z + self.cx, self.fy * points[..., 1] / z + self.cy], axis=-1
        )

    def ray_directions(self, pixels: npt.ArrayLike) -> FloatArray:
        """Viewing directions of image coordinates, in the optical frame and with z = 1.

        Args:
            pixels: Columns u and rows v, in [px]; pixel (i, j) has its centre at (i + 0.5, j + 0.5). Shape
                (..., 2).

        Returns:
            Directions; multiplied by a depth in [m] they give the point. Shape (..., 3).
        """
        uv = np.asarray(pixels, dtype=np.float64)
        x = (uv[..., 0] - self.cx) / self.fx
        y = (uv[..., 1] - self.cy) / self.fy
        return np.asarray(np.stack([x, y, np.ones_like(x)], axis=-1))

    def pixel_centres(self) -> FloatArray:
        """Image coordinates of every pixel's centre, row by row, in [px]. Shape (height, width, 2)."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.asarray(np.stack([u, v], axis=-1), dtype=np.float64)


COLOR_FOV_Y: Final = math.radians(42.5)
"""Vertical field of view of the colour imager in its full 16:9 modes and all narrower ones, in [rad] (data
sheet: 69.4 x 42.5 degrees; one real device measures 42.9)."""

COLOR_IMAGER: Final = CameraIntrinsics.from_fov(width=1920, height=1080, fov_y=COLOR_FOV_Y)
"""The whole colour imager with the data sheet's field of view and square pixels."""

MEASURED_COLOR_640X480: Final = CameraIntrinsics.from_realsense(
    width=640, height=480, fx=612.4, fy=610.6, ppx=314.3, ppy=237.8
)
"""The factory calibration that one real D435 reports for its 640 x 480 colour mode."""

MEASURED_COLOR_IMAGER: Final = CameraIntrinsics(
    width=1920,
    height=1080,
    fx=MEASURED_COLOR_640X480.fx * 2.25,
    fy=MEASURED_COLOR_640X480.fy * 2.25,
    cx=960.0 + (MEASURED_COLOR_640X480.cx - 320.0) * 2.25,
    cy=540.0 + (MEASURED_COLOR_640X480.cy - 240.0) * 2.25,
)
"""The imager of that device, of which 640 x 480 is the centre, reduced 2.25 times (it reports fx = 918.6 px
at 1280 x 720, as this gives)."""

COLOR_FOV_X: Final = math.radians(69.4)
"""Horizontal field of view of the colour imager in its full 16:9 modes, in [rad] (data sheet)."""

DEPTH_IMAGER: Final = CameraIntrinsics(width=1280, height=800, fx=640.0, fy=640.0, cx=640.0, cy=400.0)
"""The whole depth imager, 90 degrees wide (data sheet: 87 +- 3, devices report 89.6 to 90.0). Its crops give
the focal lengths that devices report: 640 px at 1280 x 720 (reported 638 to 645), 424 px at 848 x 480 (422.8
to 427.3), 384 px at 640 x 480 (382.9 to 384.2)."""

CAMERA_NEAR: Final = 0.01
"""Near plane of the simulated cameras, in [m]: just outside the front glass, so that a camera does not see
its own housing. Rays that start at the optical centre must skip this stretch as well."""

CAMERA_FAR: Final = 20.0
"""Far plane of the simulated cameras, in [m]; ManiSkill's depth is int16 millimetres, which end at 32.8 m."""

STEREO_BASELINE: Final = 0.050
"""Distance between the two infrared imagers, in [m]."""

MAX_DISPARITY: Final = 126
"""Largest disparity the depth processor searches, in [px]."""

SUBPIXEL_RMS: Final = 0.08
"""Typical RMS error of a disparity, in [px]; 0.032 at best on well textured scenes."""


def color_intrinsics(
    width: int = 640, height: int = 480, calibration: Calibration = "nominal"
) -> CameraIntrinsics:
    """The colour stream at `width` x `height` [px].

    Pictures of 16:9 and narrower share the vertical field of view (42.5 degrees nominal, 42.9 measured);
    wider ones lose rows instead of columns. In Gazebo a camera has its horizontal field of view whatever its shape: a
    D435 described with the data sheet's 69.4 degrees keeps them at 640 x 480, where a real one crops to 55, and is 54.9
    degrees high instead of 42.5.

    Raises:
        InvalidInputError: Unknown calibration, or a size below 1 pixel.
    """
    if calibration == "gazebo":
        fov_y = 2.0 * math.atan(math.tan(COLOR_FOV_X / 2.0) * height / width)
        return CameraIntrinsics.from_fov(width=width, height=height, fov_y=fov_y)
    imagers = {"nominal": COLOR_IMAGER, "measured": MEASURED_COLOR_IMAGER}
    if calibration not in imagers:
        raise InvalidInputError.choice("calibration", calibration, get_args(Calibration))
    return imagers[calibration].cropped(width, height)


def depth_intrinsics(width: int = 848, height: int = 480) -> CameraIntrinsics:
    """The depth stream at `width` x `height` [px], seen from the left infrared imager.

    Pictures wider than 16:10 share the horizontal field of view (90 degrees), narrower ones the vertical one
    (64 degrees).
    """
    return DEPTH_IMAGER.cropped(width, height)


def min_depth(intrinsics: CameraIntrinsics) -> float:
    """The nearest distance at which the depth stream measures, in [m]: fx * baseline / largest disparity."""
    return intrinsics.fx * STEREO_BASELINE / MAX_DISPARITY


def depth_noise_std(
    depth: npt.ArrayLike, intrinsics: CameraIntrinsics, subpixel_rms: float = SUBPIXEL_RMS
) -> FloatArray:
    """Standard deviation of a depth reading, in [m]: depth^2 * subpixel_rms / (fx * baseline).

    Args:
        depth: True depths, in [m]. Any shape.
        intrinsics: The depth stream's intrinsics.
        subpixel_rms: RMS error of a disparity, in [px].
    """
    z = np.asarray(depth, dtype=np.float64)
    return z**2 * (subpixel_rms / (intrinsics.fx * STEREO_BASELINE))


def _transform(xyz: tuple[float, float, float], rotation: npt.ArrayLike) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = xyz
    matrix.setflags(write=False)
    return matrix


_EYE: Final = np.eye(3)

BODY_SIZE: Final = (0.02505, 0.090, 0.025)
"""Depth, width and height of the housing along the axes of `camera_link`, in [m]."""

BODY_MASS: Final = 0.072
"""Mass of the camera, in [kg]."""

GLASS_X: Final = 0.0042
"""Distance of the front glass from the imagers' centres of projection, along x of `camera_link`, in [m]."""

BODY_CENTER: Final = (GLASS_X - BODY_SIZE[0] / 2, -0.0175, 0.0)
"""Centre of the housing in the frame of `camera_link`, in [m]. RealSense's own URDF centres its collision box
on the imagers (x = 0), which would put its face 8 mm in front of the glass."""

GLASS_TO_FLANGE: Final = 0.050
"""Distance of the front glass from the flange face along the flange's z axis, in [m]; the printed bracket
fills the 24.95 mm between the flange and the housing's back."""

R_FLANGE_CAMERA: Final = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
"""Camera axes in the flange frame: forward is the flange's z, left its y, up its -x."""

R_CAMERA_OPTICAL: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Optical axes in a camera frame; rpy (-pi/2, 0, -pi/2)."""

T_flange_camera: Final = _transform((0.0, -BODY_CENTER[1], GLASS_TO_FLANGE - GLASS_X), R_FLANGE_CAMERA)
"""`camera_link` (the left infrared imager) in `link_ee`; the housing is centred on the flange axis."""

T_camera_screw: Final = _transform((-0.0106, -0.0175, -0.0125), _EYE)
"""`camera_bottom_screw_frame` (the tripod thread) in `camera_link`."""

T_camera_infra1: Final = _transform((0.0, 0.0, 0.0), _EYE)
"""`camera_infra1_frame` and `camera_depth_frame` in `camera_link`: the same place."""

T_camera_infra2: Final = _transform((0.0, -STEREO_BASELINE, 0.0), _EYE)
"""`camera_infra2_frame` in `camera_link`."""

T_camera_color: Final = _transform((0.0, 0.015, 0.0), _EYE)
"""`camera_color_frame` in `camera_link` (nominal; the SDK reports each device's own)."""

T_frame_optical: Final = _transform((0.0, 0.0, 0.0), R_CAMERA_OPTICAL)
"""An optical frame in the camera frame it belongs to."""


def _product(*transforms: FloatArray) -> FloatArray:
    product = np.linalg.multi_dot(transforms)
    return _transform(tuple(product[:3, 3]), product[:3, :3])


T_flange_camera_depth: Final = _product(T_flange_camera, T_camera_infra1)
"""The depth camera's frame (x forward, y left, z up) in `link_ee`."""

T_flange_camera_color: Final = _product(T_flange_camera, T_camera_color)
"""The colour camera's frame (x forward, y left, z up) in `link_ee`."""

T_flange_camera_depth_optical: Final = _product(T_flange_camera_depth, T_frame_optical)
"""The depth camera's optical frame (z forward, x right, y down) in `link_ee`."""

T_flange_camera_color_optical: Final = _product(T_flange_camera_color, T_frame_optical)
"""The colour camera's optical frame (z forward, x right, y down) in `link_ee`."""


def camera_link_pose(T_flange_camera: npt.ArrayLike) -> FloatArray:
    """Where the housing is that carries a colour camera.

    Args:
        T_flange_camera: The colour camera's optical frame in `link_ee`, as measured. Shape (4, 4).

    Returns:
        `camera_link` in `link_ee`. Shape (4, 4).
    """
    T = np.asarray(T_flange_camera, dtype=np.float64)
    return np.asarray(T @ np.linalg.inv(_product(T_camera_color, T_frame_optical)))


T_color_optical_depth_optical: Final = _transform((0.015, 0.0, 0.0), _EYE)
"""From the depth camera's optical frame to the colour camera's (nominal)."""
