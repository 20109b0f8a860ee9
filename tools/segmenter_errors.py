"""Measures the light segmenter's errors on rendered views, and how far simulated ones agree with them.

Usage:
    python tools/segmenter_errors.py measure --episodes 0 16
    python tools/segmenter_errors.py check --episodes 40 50

`measure` prints the constants of `sensing.simulated_segmenter.SegmenterErrors`; `check` compares the real segmenter
with the simulated one, at its own size and at that of cast pictures, on views of other validation episodes.
"""

import json
import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from maniskill_tomato.experiments.camera_views import TrueView, rendered_views
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.segmenter import make_segmenter
from maniskill_tomato.sensing.fruit_detector import FEWEST_PIXELS, LEAST_SCORE, FruitDetector
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.simulated_camera import IMAGE_SIZE
from maniskill_tomato.sensing.simulated_segmenter import (
    KINDS,
    SegmenterErrors,
    flat_colours,
    silhouette_of,
    simulated_masks,
)

BINS = ((0.05, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.7), (0.7, 0.8), (0.8, 0.9), (0.9, 1.01))
"""Of V_f."""

SHIFTS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Shifts of edges that are tried, in [px]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to measure."""

    what: tyro.conf.Positional[Literal["measure", "check"]]
    """The constants, or how well they do."""
    episodes: tuple[int, int] = (0, 16)
    """First of the validation list, and the first that is left out."""
    views: int = 5
    """Of each episode."""
    out: Path | None = None
    """Also written here, as JSON."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """What became of one fruit in one view."""

    fraction: float
    """V_f as it is."""
    estimate: float
    """V_f by its pixels and its size, which is what a simulation knows."""
    pixels: int
    """Visible."""
    kind: str
    """Its category."""
    found: int | None
    """Index of its first detection."""
    overlap: float
    """Intersection over union of that; 0 without one."""
    touches_found: bool
    """Whether a fruit that was found touches it."""
    is_taken_in: bool
    """Whether one detection holds half of its pixels or more."""


def judged(view: TrueView, found: Instances) -> list[Seen]:
    """What became of the fruits of a view that show `FEWEST_PIXELS` or more."""
    frame = view.frame
    assert frame.true_fruits is not None
    shown = [frame.shown_fruit(mask) for mask in found.masks]
    true = dict(zip(frame.true_numbers, frame.true_fruits.masks, strict=True))
    kinds = dict(zip(frame.true_numbers, frame.true_fruits.categories, strict=True))
    around = np.full(frame.depth_m.shape, -1, np.int32)
    for number, mask in true.items():
        if number in shown:
            around[mask] = number
    fruits = []
    for number, mask in true.items():
        pixels = int(np.count_nonzero(mask))
        if pixels < FEWEST_PIXELS:
            continue
        whole = silhouette_of(frame, view.positions_w[number], view.plant.fruits[number].radius)
        index = shown.index(number) if number in shown else None
        ring = cv2.dilate(mask.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
        beside = around[ring]
        held = max((np.count_nonzero(mask & other) for other in found.masks), default=0)
        overlap = 0.0
        if index is not None:
            other = found.masks[index]
            overlap = float(np.count_nonzero(mask & other) / np.count_nonzero(mask | other))
        fruits.append(
            Seen(
                fraction=view.fractions[number],
                estimate=min(pixels / whole, 1.0),
                pixels=pixels,
                kind=kinds[number],
                found=index,
                overlap=overlap,
                touches_found=bool(((beside >= 0) & (beside != number)).any()),
                is_taken_in=bool(2 * held >= pixels),
            )
        )
    return fruits


def kept(found: Instances) -> Instances:
    """Those that a `FruitDetector` keeps."""
    pixels = np.array([np.count_nonzero(mask) for mask in found.masks])
    return found.chosen((found.scores >= LEAST_SCORE) & (pixels >= FEWEST_PIXELS))


def simulated(view: TrueView, frame: PosedFrame, errors: SegmenterErrors, seed: int) -> Instances:
    """A draw of what the segmenter might have found."""
    rng = np.random.default_rng((view.episode, seed))
    radii = {number: view.plant.fruits[number].radius for number in frame.true_numbers}
    return simulated_masks(frame, dict(enumerate(view.positions_w)), radii, rng, errors)


def logistic(features: NDArray[np.float64], answers: NDArray[np.float64]) -> list[float]:
    """Coefficients of a logistic regression, by Newton's method. Shapes (N, F), (N,)."""
    weights = np.zeros(features.shape[1])
    for _ in range(30):
        p = 1.0 / (1.0 + np.exp(-features @ weights))
        curvature = features.T @ (features * (p * (1.0 - p))[:, None]) + 1e-6 * np.eye(len(weights))
        weights = weights + np.linalg.solve(curvature, features.T @ (answers - p))
    return [round(float(w), 2) for w in weights]


def measure(args: Args) -> dict[str, Any]:
    """The constants of `SegmenterErrors`."""
    segmenter = make_segmenter("light")
    fruits: list[Seen] = []
    told: dict[str, list[str]] = defaultdict(list)
    scores: list[tuple[float, float]] = []
    false: list[tuple[int, str]] = []
    overlaps: dict[float, list[float]] = defaultdict(list)
    leaves = []
    colours: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
    views = 0
    for view in rendered_views(range(*args.episodes), args.views):
        views += 1
        frame = view.frame
        assert frame.rgb is not None and frame.true_fruits is not None
        found = kept(segmenter(frame.rgb, frame.depth_m))
        seen = judged(view, found)
        fruits += seen
        for fruit in seen:
            if fruit.found is not None:
                told[fruit.kind].append(found.categories[fruit.found])
                scores.append((fruit.estimate, float(found.scores[fruit.found])))
        for mask, category in zip(found.masks, found.categories, strict=True):
            if frame.shown_fruit(mask) is None:
                false.append((int(np.count_nonzero(mask)), category))
        for shift in SHIFTS:
            drawn = simulated(view, frame, replace(SegmenterErrors(), edge_shift=shift), views)
            overlaps[shift] += [
                f.overlap for f in judged(view, kept(drawn)) if f.found is not None and f.fraction > 0.6
            ]
        leaf = ~frame.true_fruits.masks.any(axis=0) & (frame.measured_m > 0) & (frame.measured_m < 1.0)
        leaves.append(frame.rgb[leaf].mean(axis=0))
        for mask, category in zip(frame.true_fruits.masks, frame.true_fruits.categories, strict=True):
            if np.count_nonzero(mask) > 500:
                colours[category].append(frame.rgb[mask].mean(axis=0))
    features = np.array([[1.0, f.estimate, np.log(f.pixels)] for f in fruits])
    beside = [f for f in fruits if f.found is None and f.touches_found]
    at, given = np.array(scores).T
    line = np.polyfit(at, given, 1)
    areas = np.log([area for area, _ in false])
    real = float(np.median([f.overlap for f in fruits if f.found is not None and f.fraction > 0.6]))
    simulated_overlap = {shift: round(float(np.median(values)), 3) for shift, values in overlaps.items()}
    return {
        "views": views,
        "fruits": len(fruits),
        "detections": len(scores) + len(false),
        "detection": logistic(features, np.array([float(f.found is not None) for f in fruits])),
        "merged_share": round(float(np.mean([f.is_taken_in for f in beside])), 2),
        "missed_beside_a_found_one": len(beside),
        "edge_overlap": round(real, 3),
        "edge_overlap_by_shift": simulated_overlap,
        "score": [
            round(float(line[1]), 2),
            round(float(line[0]), 2),
            round(float(np.std(given - np.polyval(line, at))), 2),
        ],
        "confusion": [
            [round(told[kind].count(other) / len(told[kind]), 3) for other in KINDS] for kind in KINDS
        ],
        "false_rate": round(len(false) / views, 3),
        "false_pixels": [round(float(np.exp(np.median(areas)))), round(float(np.std(areas)), 2)]
        if false
        else None,
        "false_kinds": [round(sum(c == kind for _, c in false) / len(false), 2) for kind in KINDS]
        if false
        else None,
        "colours": {kind: np.mean(values, axis=0).round().tolist() for kind, values in colours.items()},
        "foliage": np.mean(leaves, axis=0).round().tolist(),
    }


def halved(frame: PosedFrame) -> PosedFrame:
    """Every other pixel: the size of cast pictures."""
    assert frame.true_fruits is not None
    masks = np.ascontiguousarray(frame.true_fruits.masks[:, ::2, ::2])
    shown = [k for k, mask in enumerate(masks) if mask.any()]
    return PosedFrame(
        depth_m=np.ascontiguousarray(frame.depth_m[::2, ::2]),
        intrinsics=color_intrinsics(*IMAGE_SIZE),
        T_world_camera=frame.T_world_camera,
        true_fruits=Instances.from_masks(
            masks[shown], categories=tuple(frame.true_fruits.categories[k] for k in shown)
        ),
        true_numbers=tuple(frame.true_numbers[k] for k in shown),
    )


def check(args: Args) -> dict[str, Any]:
    """Rates of the real segmenter beside those of the simulated one, for ripe fruits by V_f."""
    segmenter = make_segmenter("light")
    names = ("real", "simulated", "simulated_320")
    found_share: dict[tuple[str, int], list[bool]] = defaultdict(list)
    overlaps: dict[tuple[str, int], list[float]] = defaultdict(list)
    errors: dict[tuple[str, int], list[float]] = defaultdict(list)
    false: dict[str, int] = defaultdict(int)
    wrong: dict[str, list[bool]] = defaultdict(list)
    views = 0
    for view in rendered_views(range(*args.episodes), args.views):
        views += 1
        frame = view.frame
        assert frame.rgb is not None
        small = replace(view, frame=halved(frame))
        for name, seen, found in (
            ("real", view, segmenter(frame.rgb, frame.depth_m)),
            ("simulated", view, simulated(view, frame, SegmenterErrors(), views)),
            ("simulated_320", small, simulated(small, small.frame, SegmenterErrors(), views)),
        ):
            found = kept(found)
            told = replace(seen.frame, told_fruits=found, rgb=seen.frame.rgb)
            if told.rgb is None:
                told = replace(told, rgb=flat_colours(told))
            false[name] += sum(seen.frame.shown_fruit(mask) is None for mask in found.masks)
            for fruit in judged(seen, found):
                if fruit.found is not None:
                    is_ripe = found.categories[fruit.found] == KINDS[0]
                    wrong[name].append(is_ripe != (fruit.kind == KINDS[0]))
                if fruit.kind != KINDS[0] or (which := bin_of(fruit.fraction)) is None:
                    continue
                found_share[name, which].append(fruit.found is not None)
                if fruit.found is not None:
                    overlaps[name, which].append(fruit.overlap)
            measured = FruitDetector(None).measure(told)
            for k, detected in enumerate(measured.fruits):
                number = told.shown_fruit(measured.mask(k))
                if number is None or view.plant.fruits[number].ripeness != "ripe":
                    continue
                which = bin_of(view.fractions[number])
                if which is not None and np.isfinite(detected.visible_fraction):
                    errors[name, which].append(detected.visible_fraction - view.fractions[number])
    table = []
    for which, (low, high) in enumerate(BINS):
        if not all(overlaps[name, which] and errors[name, which] for name in names):
            continue
        row: dict[str, Any] = {"V_f": [low, min(high, 1.0)], "fruits": len(found_share["real", which])}
        for name in names:
            key = name, which
            row[name] = {
                "found": round(float(np.mean(found_share[key])), 3),
                "overlap_median": round(float(np.median(overlaps[key])), 3),
                "overlap_tenth": round(float(np.quantile(overlaps[key], 0.1)), 3),
                "error_mean": round(float(np.mean(errors[key])), 3),
                "error_sd": round(float(np.std(errors[key])), 3),
            }
        table.append(row)
    return {
        "views": views,
        "ripe": table,
        "false_a_view": {name: round(false[name] / views, 3) for name in names},
        "ripeness_mistaken": {name: round(float(np.mean(wrong[name])), 3) for name in names},
    }


def bin_of(fraction: float) -> int | None:
    """Index in `BINS`."""
    return next((k for k, (low, high) in enumerate(BINS) if low <= fraction < high), None)


def main(args: Args) -> int:
    """Runs one of both."""
    torch.set_num_threads(1)
    text = json.dumps(measure(args) if args.what == "measure" else check(args), indent=1)
    if args.out is not None:
        args.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
