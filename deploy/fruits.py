"""Fruits in a picture: who finds them, and where they are in the world."""

import importlib
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.errors import PerceptionError, ProfileError
from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.raycast.images import ROBOT_LABEL
from maniskill_tomato.robot.d435 import CameraIntrinsics

Mask = NDArray[np.bool_]

RADIUS_RANGE: Final = (0.015, 0.05)
"""Radii that a tomato may have, in [m]."""

USUAL_RADIUS: Final = 0.032
"""Taken where too little is seen to tell, in [m]."""

LEAST_SCORE: Final = 0.3
"""Less sure fruits are left out. Low, because fruits that are mostly hidden get low scores, and a target whose place is
known is not easily mistaken for something else."""

FEWEST_PIXELS: Final = 12
"""A fruit with fewer pixels with depth is not located."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Fruit:
    """A ripe fruit in a picture."""

    mask: Mask
    """Its visible pixels. Shape (H, W)."""
    score: float = 1.0
    """Confidence from 0 to 1."""
    visible_fraction: float | None = None
    """V_f if its finder tells, else None."""


class FruitFinder(Protocol):
    """Finds ripe fruits in pictures."""

    name: str
    """As profiles call it."""

    def find(self, frame: Frame) -> list[Fruit]:
        """The ripe fruits, best first.

        Raises:
            PerceptionError: The picture cannot be used.
        """
        ...

    def robot_mask(self, frame: Frame) -> Mask | None:
        """Where the picture shows the robot itself, if it is known."""
        ...


class TruthFinder:
    """The masks that only a simulated camera knows."""

    name = "ground_truth"

    def find(self, frame: Frame) -> list[Fruit]:
        """The ripe fruits; V_f of the target alone."""
        truth = _truth(frame)
        found = []
        for label in truth.ripe_labels:
            mask = truth.labels == label
            if mask.any():
                fraction = truth.visible_fraction if label == truth.target_label else None
                found.append(Fruit(mask=mask, visible_fraction=fraction))
        return found

    def robot_mask(self, frame: Frame) -> Mask | None:
        return np.asarray(_truth(frame).labels == ROBOT_LABEL)


class SegmenterFinder:
    """A segmenter of `maniskill_tomato.perception` as a finder."""

    def __init__(self, name: str, segmenter: Any, min_score: float = LEAST_SCORE) -> None:
        """Wraps one.

        Args:
            name: As it was asked for.
            segmenter: Called with colours and depth, answers with `masks`, `scores`, `categories` and perhaps
                `amodal_boxes`.
            min_score: Less sure fruits are left out.
        """
        self.name = name
        self._segmenter = segmenter
        self._min_score = min_score

    def find(self, frame: Frame) -> list[Fruit]:
        """The fruits that it calls ripe, or whose ripeness it does not tell."""
        try:
            found: Any = self._segmenter(frame.color, frame.depth)
        except TomatoError as error:
            raise PerceptionError(f"the segmenter {self.name} cannot use the picture: {error}") from error
        fractions: Any = [None] * len(found.scores)
        if found.amodal_boxes is not None:
            fractions = found.visible_fractions().tolist()
        return [
            Fruit(
                mask=np.asarray(found.masks[k], dtype=np.bool_),
                score=float(found.scores[k]),
                visible_fraction=fractions[k],
            )
            for k in range(len(found.scores))
            if found.categories[k] in ("tomato", "tomato_ripe") and found.scores[k] >= self._min_score
        ]

    def robot_mask(self, frame: Frame) -> Mask | None:
        return None


def open_finder(name: str) -> FruitFinder:
    """A finder by name: `ground_truth`, or a segmenter's name or file of weights.

    Raises:
        ProfileError: It cannot be opened.
    """
    if name == TruthFinder.name:
        return TruthFinder()
    try:
        module: Any = importlib.import_module("maniskill_tomato.segmentation.segmenter")
        return SegmenterFinder(name, module.make_segmenter(name))
    except ImportError as error:
        raise ProfileError(
            f"perception.segmenter {name!r} cannot be loaded ({error}); install maniskill-tomato[perception], or use "
            f"{TruthFinder.name!r} with the mock profile"
        ) from error
    except TomatoError as error:
        raise ProfileError(f"perception.segmenter: {error}") from error


def locate(
    mask: Mask, depth: NDArray[np.float32], intrinsics: CameraIntrinsics, T_world_camera: Float64
) -> tuple[Float64, float] | None:
    """Where a fruit is, by the sphere through the points of its mask.

    The linear least-squares fit of a sphere; where too small a cap is seen for a believable radius, a usual tomato is
    put behind the middle of the points.

    Args:
        mask: Its visible pixels. Shape (H, W).
        depth: In [m], 0 for none. Shape (H, W).
        intrinsics: Of both.
        T_world_camera: Pose of the optical frame. Shape (4, 4).

    Returns:
        Centre in the world frame, in [m], shape (3,), and radius, in [m]; None with too few points.
    """
    rows, columns = np.nonzero(mask & (depth > 0.0) & np.isfinite(depth))
    if len(rows) < FEWEST_PIXELS:
        return None
    z = depth[rows, columns].astype(np.float64)
    # Pixels at the rim often have the depth of what is behind.
    near = np.abs(z - np.median(z)) < RADIUS_RANGE[1]
    rows, columns, z = rows[near], columns[near], z[near]
    if len(rows) < FEWEST_PIXELS:
        return None
    points = intrinsics.ray_directions(np.stack([columns + 0.5, rows + 0.5], axis=-1)) * z[:, None]
    middle = points.mean(axis=0)
    local = points - middle
    A = np.concatenate([2.0 * local, np.ones((len(local), 1))], axis=1)
    solution, _, rank, _ = np.linalg.lstsq(A, (local**2).sum(-1), rcond=None)
    centre, square = middle + solution[:3], solution[3] + (solution[:3] ** 2).sum()
    radius = float(np.sqrt(max(square, 0.0)))
    believable = rank == 4 and RADIUS_RANGE[0] <= radius <= RADIUS_RANGE[1] and centre[2] > middle[2]
    if not believable:
        radius = USUAL_RADIUS
        centre = middle * (1.0 + 0.75 * radius / np.linalg.norm(middle))
    centre_w: Float64 = T_world_camera[:3, :3] @ centre + T_world_camera[:3, 3]
    return centre_w, radius


def silhouette_area(
    centre_w: Float64, radius: float, intrinsics: CameraIntrinsics, T_world_camera: Float64
) -> float:
    """Area of a sphere's whole silhouette in the image plane, in [px]: T of Eq. 4-4 for a round fruit.

    The exact area of the ellipse that a sphere projects to, pi f_x f_y r^2 sqrt((d^2 - r^2) / (z^2 - r^2)^3) with its
    distance d and its depth z; infinite where the sphere reaches behind the camera.
    """
    centre = T_world_camera[:3, :3].T @ (centre_w - T_world_camera[:3, 3])
    z, square = float(centre[2]), float((centre**2).sum())
    if z <= radius:
        return float("inf")
    return float(
        np.pi
        * intrinsics.fx
        * intrinsics.fy
        * radius**2
        * np.sqrt(square - radius**2)
        / (z**2 - radius**2) ** 1.5
    )


def _truth(frame: Frame) -> Any:
    if frame.truth is None:
        raise PerceptionError(
            "ground_truth needs a simulated camera; choose a segmenter with perception.segmenter"
        )
    return frame.truth
