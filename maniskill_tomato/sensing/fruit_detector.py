"""From a frame to the fruits in it: masks by a segmenter, V_f and place by an occlusion model."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.instances import Instances, mask_box
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.segmentation.segmenter import Segmenter
from maniskill_tomato.sensing.measurement import RIPE_CATEGORIES, DetectedFruit, Measurement, Position
from maniskill_tomato.sensing.own_pixels import own_pixels
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.visible_fraction.crop import CropShape
from maniskill_tomato.sensing.visible_fraction.estimate import (
    Estimate,
    OcclusionModel,
    SegmentedImage,
    fruit_depth,
)
from maniskill_tomato.sensing.visible_fraction.sphere import SphereModel

FEWEST_PIXELS: Final = 12
"""A fruit with fewer visible pixels is left out."""

LEAST_SCORE: Final = 0.3
"""A fruit with a lower score is left out. Low, because fruits that are mostly hidden get low scores."""

ONE_SHARE: Final = 0.4
"""Centres nearer to each other than this share of the sum of their radii belong to one fruit. Fruits that touch have
0.85 or more, and the centre of a small piece is off by a third of a radius."""

SURFACE_SHARE: Final = 0.7
"""The centre of a fruit lies this share of a radius behind the median depth of its visible surface."""


class FruitDetector:
    """Measures frames; the same for simulated and real cameras."""

    def __init__(self, segmenter: Segmenter | None, model: OcclusionModel | None = None) -> None:
        """Keeps both parts.

        Args:
            segmenter: Finds fruits in colours and depth; None takes `PosedFrame.told_fruits`, or where there are none
                the ripe ones of `PosedFrame.true_fruits`.
            model: Estimates V_f and centre; by default `SphereModel`.
        """
        self._segmenter = segmenter
        self._model = model or SphereModel()

    def measure(self, frame: PosedFrame, crop: CropShape | None = None) -> Measurement:
        """The fruits of a frame.

        Args:
            frame: What the camera saw.
            crop: What earlier views told about the fruits' size and shape; None before any.

        Raises:
            InvalidInputError: The frame lacks the colours or the true fruits that the segmentation needs.
        """
        found, crop = self._segmented(frame), crop or CropShape()
        kept = [
            k
            for k, mask in enumerate(found.masks)
            if found.scores[k] >= LEAST_SCORE and np.count_nonzero(mask) >= FEWEST_PIXELS
        ]
        masks = tuple(np.ascontiguousarray(found.masks[k]) for k in kept)
        categories = [found.categories[k] for k in kept]
        fruits = self._fruits(frame, crop, masks, categories, found.scores[kept])
        measurement = Measurement(frame=frame, fruits=fruits, crop=crop)
        return measurement if self._segmenter is None else self._joined(measurement)

    def _joined(self, measurement: Measurement) -> Measurement:
        """The view with pieces of one fruit, which a segmenter takes for several, measured as one."""
        fruits = list(measurement.fruits)
        for pieces in _pieces(fruits, measurement.crop.radius_m):
            whole = max((fruits[k] for k in pieces), key=lambda fruit: fruit.pixels)
            mask = np.logical_or.reduce([measurement.mask(k) for k in pieces])
            score = np.array([max(fruits[k].score for k in pieces)], np.float32)
            (joined,) = self._fruits(measurement.frame, measurement.crop, (mask,), (whole.category,), score)
            for k in pieces:
                fruits[k] = joined
        kept = tuple(dict.fromkeys(fruits))
        return measurement if len(kept) == len(fruits) else replace(measurement, fruits=kept)

    def divide(self, measurement: Measurement, index: int, parts: Sequence[BinaryMask]) -> Measurement:
        """A view measured anew with a detection's mask divided.

        Args:
            measurement: The view.
            index: Of the detection in `Measurement.fruits`; its parts take its place.
            parts: Their masks; those with fewer than `FEWEST_PIXELS` are left out. Each of shape (H, W).
        """
        fruits, whole = measurement.fruits, measurement.fruits[index]
        masks = [part for part in parts if np.count_nonzero(part) >= FEWEST_PIXELS]
        new = self._fruits(
            measurement.frame,
            measurement.crop,
            tuple(masks),
            (whole.category,) * len(masks),
            np.full(len(masks), whole.score, np.float32),
        )
        return replace(measurement, fruits=(*fruits[:index], *new, *fruits[index + 1 :]))

    def _fruits(
        self,
        frame: PosedFrame,
        crop: CropShape,
        masks: tuple[BinaryMask, ...],
        categories: Sequence[str],
        scores: NDArray[np.float32],
    ) -> tuple[DetectedFruit, ...]:
        depth = frame.measured_m
        if self._segmenter is not None or frame.told_fruits is not None:
            masks = own_pixels(masks, depth, crop.largest_radius_m)
        rgb = np.zeros((*depth.shape, 3), np.uint8) if frame.rgb is None else frame.rgb
        view = SegmentedImage(
            rgb=rgb,
            depth_m=depth,
            filled_m=frame.filled_m,
            masks=masks,
            intrinsics=frame.intrinsics,
            up_optical=frame.T_world_camera[2, :3],
            crop=crop,
        )
        return tuple(
            _fruit(frame, view, crop.radius_m, mask, estimate, category, float(score))
            for mask, estimate, category, score in zip(
                view.masks, self._model(view), categories, scores, strict=True
            )
        )

    def _segmented(self, frame: PosedFrame) -> Instances:
        if self._segmenter is None:
            if frame.told_fruits is not None:
                return frame.told_fruits
            if frame.true_fruits is None:
                raise InvalidInputError("perfect masks need a simulated camera; choose a segmenter")
            ripe = [category in RIPE_CATEGORIES for category in frame.true_fruits.categories]
            return frame.true_fruits.chosen(np.array(ripe, np.bool_))
        if frame.rgb is None:
            raise InvalidInputError("a segmenter needs a picture with colours")
        return self._segmenter(frame.rgb, frame.depth_m)


def _pieces(fruits: Sequence[DetectedFruit], usual_radius: float) -> list[list[int]]:
    """Detections that are pieces of one fruit, by their indices: two or more each.

    Fruits are solid: where the fitted spheres of two detections overlap more than two fruits could, it is one fruit.
    """
    groups: list[list[int]] = []
    for k, fruit in enumerate(fruits):
        if not fruit.is_depth_measured:
            continue
        own = [group for group in groups if any(_is_one(fruit, fruits[j], usual_radius) for j in group)]
        groups = [group for group in groups if group not in own]
        groups.append([j for group in own for j in group] + [k])
    return [sorted(group) for group in groups if len(group) > 1]


def _is_one(a: DetectedFruit, b: DetectedFruit, usual_radius: float) -> bool:
    radii = sum(f.radius_m if np.isfinite(f.radius_m) else usual_radius for f in (a, b))
    return bool(np.linalg.norm(a.centre_w - b.centre_w) < ONE_SHARE * radii)


def _fruit(
    frame: PosedFrame,
    view: SegmentedImage,
    usual_radius: float,
    mask: BinaryMask,
    estimate: Estimate,
    category: str,
    score: float,
) -> DetectedFruit:
    left, top, right, bottom = mask_box(mask)
    crop = mask[top:bottom, left:right].copy()
    rows, columns = np.nonzero(crop)
    pixel = np.array([left + columns.mean() + 0.5, top + rows.mean() + 0.5])
    ray = frame.intrinsics.ray_directions(pixel)
    rotation = frame.T_world_camera[:3, :3]
    own_depth = fruit_depth(view.depth_m[top:bottom, left:right], crop)
    centre = _centre(estimate, own_depth, ray, usual_radius)
    if centre is None:
        # Where neither it nor what is round it has depth, its size tells how far away it is.
        distance = usual_radius * frame.intrinsics.fx / (0.5 * max(crop.shape))
        centre = ray * distance
    return DetectedFruit(
        category=category,
        score=score,
        corner=(top, left),
        crop=crop,
        visible_fraction=estimate.visible_fraction,
        centre_w=rotation @ centre + frame.T_world_camera[:3, 3],
        radius_m=estimate.radius_m,
        is_depth_measured=bool(np.isfinite(own_depth)),
        direction_w=rotation @ (ray / np.linalg.norm(ray)),
        redness=_redness(None if frame.rgb is None else frame.rgb[top:bottom, left:right][crop]),
        seen_whole=estimate.seen_whole,
    )


DARK: Final = 30.0
"""Sum of red and green below which a colour says nothing, of 510."""


def _redness(colours: NDArray[np.uint8] | None) -> float:
    """(R - G) / (R + G) of the mean of colours; NaN without any, and where it is too dark to tell. Shape (N, 3)."""
    if colours is None:
        return float("nan")
    red, green, _ = colours.mean(axis=0)
    return float((red - green) / (red + green)) if red + green > DARK else float("nan")


def _centre(estimate: Estimate, z: float, ray: NDArray[np.float64], usual_radius: float) -> Position | None:
    """Centre in the optical frame, in [m]: the model's, or one behind the middle of the mask. Shape (3,).

    Args:
        estimate: Of the model.
        z: Depth of the visible surface, in [m]; NaN if it was not measured.
        ray: Through the middle of the visible pixels, 1 m along the optical axis. Shape (3,).
        usual_radius: Of the crop's fruits, in [m].
    """
    if estimate.centre_optical is not None:
        return np.array(estimate.centre_optical)
    return ray * (z + SURFACE_SHARE * usual_radius) if np.isfinite(z) else None
