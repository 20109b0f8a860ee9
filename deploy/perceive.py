"""What a picture tells about the target: pattern of rays, visible fraction, place."""

from dataclasses import dataclass
from typing import Final, Literal, Protocol

import numpy as np
import torch

from maniskill_tomato.deploy.errors import PerceptionError
from maniskill_tomato.deploy.fruits import RADIUS_RANGE, Fruit, FruitFinder, Mask, locate, silhouette_area
from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.sensing.view_pattern import sample_view

Sight = Literal["images", "rays"]
"""From masks and depth images, as on a robot; or from the twin's exact rays, as in the simulated task."""

GATE: Final = 0.035
"""A fruit farther than this from where the target is known to be is another one, in [m]. Ripe neighbours in a truss
are 50 mm apart and more; the target itself is located to 25 mm where a sliver of it is seen, to 10 mm where half is."""


SURE_SCORE: Final = 0.5
"""A fruit with a lower score is not chosen as the target, only found again as such."""


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """One look at the target."""

    rays: ViewRays
    """The pattern about the target, as the simulated task has it."""
    visible_fraction: float
    """V_f, 0 if the target is not seen."""
    mask: Mask
    """Visible pixels of the target. Shape (H, W)."""
    fruits_seen: int
    """How many ripe fruits the picture shows."""
    measured_position: Float64 | None
    """Where this picture alone puts the target, world frame, in [m]. Shape (3,)."""

    @property
    def target_seen(self) -> bool:
        """Whether any of the target was seen."""
        return self.visible_fraction > 0.0


class Perception(Protocol):
    """Turns pictures into views."""

    name: str
    """In reports."""

    def find_target(self, frame: Frame, T_world_camera: Float64) -> Float64 | None:
        """The place of the fruit to look for, world frame, in [m], shape (3,); None if no fruit is seen."""
        ...

    def look(self, frame: Frame, T_world_camera: Float64, target_position: Float64) -> View:
        """What a picture tells.

        Args:
            frame: The picture.
            T_world_camera: Pose of the optical frame when it was taken. Shape (4, 4).
            target_position: Where the target is known to be, world frame, in [m]. Shape (3,).

        Raises:
            PerceptionError: The picture cannot be used.
        """
        ...


class ImagePerception:
    """Masks of a finder and the depth image; the target is the fruit nearest to where it is known to be.

    Fruits have no names in pictures, so that two that change places in a segmenter's list change nothing.
    """

    def __init__(self, finder: FruitFinder) -> None:
        self._finder = finder
        self.name = f"images, masks from {finder.name}"

    def find_target(self, frame: Frame, T_world_camera: Float64) -> Float64 | None:
        """The largest ripe fruit that is sure and can be located."""
        sure = [fruit for fruit in self._finder.find(frame) if fruit.score >= SURE_SCORE]
        fruits = sorted(sure, key=lambda fruit: -int(fruit.mask.sum()))
        for fruit in fruits:
            found = locate(fruit.mask, frame.depth, frame.intrinsics, T_world_camera)
            if found is not None:
                return found[0]
        return None

    def look(self, frame: Frame, T_world_camera: Float64, target_position: Float64) -> View:
        """The view by masks and depth."""
        fruits = self._finder.find(frame)
        chosen: tuple[float, Fruit, Float64, float] | None = None
        for fruit in fruits:
            place = locate(fruit.mask, frame.depth, frame.intrinsics, T_world_camera)
            if place is None:
                place = self._place_by_ray(fruit, frame, T_world_camera, target_position)
            if place is None:
                continue
            centre, radius = place
            distance = float(np.linalg.norm(centre - target_position))
            if distance <= GATE and (chosen is None or distance < chosen[0]):
                chosen = (distance, fruit, centre, radius)
        mask = np.zeros(frame.depth.shape, dtype=np.bool_)
        fraction, measured = 0.0, None
        if chosen is not None:
            _, fruit, measured, radius = chosen
            mask = fruit.mask
            fraction = _visible_fraction(fruit, measured, radius, frame, T_world_camera)
        rays = sample_view(
            frame.depth,
            mask,
            frame.intrinsics,
            torch.as_tensor(T_world_camera, dtype=torch.float64),
            torch.as_tensor(target_position, dtype=torch.float64),
            self._finder.robot_mask(frame),
        )
        return View(
            rays=rays,
            visible_fraction=fraction,
            mask=mask,
            fruits_seen=len(fruits),
            measured_position=measured,
        )

    @staticmethod
    def _place_by_ray(
        fruit: Fruit, frame: Frame, T_world_camera: Float64, target_position: Float64
    ) -> tuple[Float64, float] | None:
        """A fruit with hardly any depth: the point of its middle ray that is nearest to the target."""
        rows, columns = np.nonzero(fruit.mask)
        if not len(rows):
            return None
        pixel = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        ray = T_world_camera[:3, :3] @ frame.intrinsics.ray_directions(pixel)
        ray /= np.linalg.norm(ray)
        along = float(ray @ (target_position - T_world_camera[:3, 3]))
        if along <= 0.0:
            return None
        centre: Float64 = T_world_camera[:3, 3] + along * ray
        return centre, 0.032


class TruthPerception:
    """The twin's exact rays and V_f: the observations of the simulated task, number by number."""

    name = "rays, ground truth"

    def find_target(self, frame: Frame, T_world_camera: Float64) -> Float64 | None:
        return None if frame.truth is None else frame.truth.target_position

    def look(self, frame: Frame, T_world_camera: Float64, target_position: Float64) -> View:
        truth = frame.truth
        if truth is None:
            raise PerceptionError(
                "perception.sight = 'rays' needs a simulated camera; use 'images' on hardware"
            )
        return View(
            rays=truth.rays,
            visible_fraction=truth.visible_fraction,
            mask=np.asarray(truth.labels == truth.target_label),
            fruits_seen=sum(bool((truth.labels == label).any()) for label in truth.ripe_labels),
            measured_position=truth.target_position,
        )


def _visible_fraction(
    fruit: Fruit, centre: Float64, radius: float, frame: Frame, T_world_camera: Float64
) -> float:
    pixels = int(fruit.mask.sum())
    if fruit.visible_fraction is None:
        return float(min(1.0, pixels / silhouette_area(centre, radius, frame.intrinsics, T_world_camera)))
    # A sliver that a segmenter takes for a small whole fruit: at its distance no fruit is that small.
    smallest = silhouette_area(centre, RADIUS_RANGE[0], frame.intrinsics, T_world_camera)
    return min(fruit.visible_fraction, pixels / smallest)
