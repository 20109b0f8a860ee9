"""Measures why the thesis's occlusion model misjudges fruits that are fully visible, and prints a table.

The pictures are the thesis's kind (one or three tomatoes on a plant before an even grey wall, cast by rays) or those of
a rendered data set. Each line changes one thing.

Example:
    python tools/measure_thesis_model.py
    python tools/measure_thesis_model.py --data runs/held_out --limit 40
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from maniskill_tomato.experiments.occlusion_scores import annotated_fruits, make_view
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.raycast.images import BACKGROUND_DEPTH, NOTHING_LABEL
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.report_design import markdown_table
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.depth_noise import DepthNoise, measure_depth
from maniskill_tomato.segmentation.datasets.reading import read_annotated
from maniskill_tomato.segmentation.metrics.detector_evaluation import chosen_images
from maniskill_tomato.segmentation.synthesis.viewpoints import draw_view
from maniskill_tomato.sensing.simulated_camera import true_fruits
from maniskill_tomato.sensing.visible_fraction.estimate import Estimate, SegmentedImage, fruit_depth
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisConfig, ThesisModel
from maniskill_tomato.view.plant_meshes import organ_colours

GREY = (178.0, 178.0, 178.0)
"""Colour of the wall behind a plant, sRGB: Gazebo's default, in which no channel exceeds another."""

GREENISH = (147.0, 150.0, 145.0)
"""Colour of the floor in the tasks' pictures, whose green exceeds red by 3."""

ARM = (206.0, 206.0, 208.0)
FULL = 0.95
"""V_f from which on a fruit counts as fully visible."""

LEAST_PIXELS = 100
VIEWS = 3
"""Views of each plant that show the target fully."""

TRIES = 400
NO_LEAVES = 254
"""A threshold that no pixel exceeds in practice: nothing is painted over."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A picture and what is true of its fruits."""

    view: SegmentedImage
    truths: tuple[float, ...]
    """V_f of each mask."""
    exact_m: NDArray[np.float64] | None = None
    """The depth without a camera's faults, in [m]. Shape (H, W)."""
    background: NDArray[np.bool_] | None = None
    """Where neither plant nor robot is. Shape (H, W)."""


def cast_pictures(plants: int, seed: int) -> Iterator[Shown]:
    """Views of plants with one and with three tomatoes in turn, the target fully visible."""
    intrinsics, rng, eye = color_intrinsics(640, 480), np.random.default_rng(seed), torch.eye(4)
    for number in range(plants):
        plant = generate_plant(("one_tomato", "three_tomatoes")[number % 2], 1000 + seed + number, "training")
        scene = RayScene([plant], intrinsics)
        palette = np.concatenate([[GREY, ARM], organ_colours(plant)])

        def fraction(T: torch.Tensor, fruit: int, scene: RayScene = scene) -> float:
            seen = scene.visibility(T[None], torch.tensor([fruit]), eye[None])
            return float(seen.visible_fraction[0])

        found = 0
        for _ in range(TRIES):
            drawn = draw_view(plant, list(range(len(plant.fruits))), rng)
            T = torch.from_numpy(drawn.T_plant_optical.astype(np.float32))
            if fraction(T, drawn.target_fruit) < FULL:
                continue
            cast = scene.picture(intrinsics, T, eye)
            fruits, numbers = true_fruits(cast, plant)
            nothing = cast.labels == NOTHING_LABEL
            exact = np.where(nothing, BACKGROUND_DEPTH, np.minimum(cast.depth, BACKGROUND_DEPTH)).astype(
                float
            )
            view = SegmentedImage(
                rgb=cast.coloured(palette),
                depth_m=measure_depth(exact, intrinsics, DepthNoise(), rng),
                masks=tuple(fruits.masks),
                intrinsics=intrinsics,
            )
            truths = tuple(fraction(T, j) for j in numbers)
            yield Shown(view=view, truths=truths, exact_m=exact, background=nothing)
            found += 1
            if found == VIEWS:
                break


def rendered_pictures(folder: Path, limit: int | None) -> Iterator[Shown]:
    """The images of a data set and their ripe fruits."""
    for image in chosen_images(read_annotated(folder).images, limit):
        fruits = [f for f in annotated_fruits(image) if f.category == "tomato_ripe"]
        view = make_view(image, annotated_fruits(image))
        if view is None or not fruits:
            continue
        # Other fruits have masks too, but are not judged.
        truths = [
            f.visible_fraction if f.category == "tomato_ripe" and f.visible_fraction is not None else 0.0
            for f in annotated_fruits(image)
        ]
        yield Shown(view=view, truths=tuple(truths))


def with_background(shown: Shown, colour: tuple[float, float, float]) -> Shown:
    """The picture before a wall of another colour."""
    rgb = shown.view.rgb.copy()
    rgb[shown.background] = np.array(colour, np.uint8)
    return replace(shown, view=replace(shown.view, rgb=rgb))


def with_exact_depth(shown: Shown) -> Shown:
    """The picture with the depth of a camera without faults, as Gazebo's."""
    assert shown.exact_m is not None
    return replace(shown, view=replace(shown.view, depth_m=shown.exact_m))


def excess(estimate: Estimate, view: SegmentedImage, mask: NDArray[np.bool_]) -> list[float]:
    """What T has beyond the fruit's pixels, over their number: other fruits, nearer, deeper, not measured."""
    assert estimate.whole is not None
    own = fruit_depth(view.depth_m, mask)
    more = estimate.whole & ~mask
    fruits = np.any(view.masks, axis=0)
    rest, z = more & ~fruits, view.depth_m
    parts = (more & fruits, rest & (z > 0) & (z < own), rest & (z >= own), rest & (z == 0))
    return [float(np.count_nonzero(part)) / np.count_nonzero(mask) for part in parts]


def judged(name: str, pictures: Sequence[Shown], config: ThesisConfig) -> list[str]:
    """A line of the table: the model's errors on fully visible fruits."""
    model, errors, ratios, beyond = ThesisModel(config), [], [], []
    for shown in pictures:
        estimates = model(shown.view)
        for estimate, truth, mask in zip(estimates, shown.truths, shown.view.masks, strict=True):
            if truth < FULL or np.count_nonzero(mask) < LEAST_PIXELS:
                continue
            errors.append(estimate.visible_fraction - truth)
            if estimate.whole is not None:
                ratios.append(estimate.total * truth / np.count_nonzero(mask))
                beyond.append(excess(estimate, shown.view, mask))
    bias, failed = float(np.nanmean(errors)), int(np.isnan(errors).sum())
    shares = [f"{share:.3f}" for share in np.mean(beyond, axis=0)]
    return [name, str(len(errors)), f"{bias:+.3f}", str(failed), f"{np.median(ratios):.2f}", *shares]


def main(plants: int = 10, seed: int = 0, data: Path | None = None, limit: int | None = None) -> None:
    """Prints the table.

    Args:
        plants: How many plants to cast pictures of.
        seed: Which plants and views.
        data: A rendered data set to take instead.
        limit: How many of its images, spread evenly.
    """
    usual = ThesisConfig()
    pictures = list(cast_pictures(plants, seed) if data is None else rendered_pictures(data, limit))
    lines = [
        judged("as in the thesis", pictures, usual),
        judged("leaves not painted over", pictures, replace(usual, leaf_threshold=NO_LEAVES)),
        judged("green over red by more than 10", pictures, replace(usual, leaf_threshold=10)),
        judged("background 2 cm behind instead of 4", pictures, replace(usual, behind_m=0.02)),
    ]
    changes: list[tuple[str, Callable[[Shown], Shown], ThesisConfig]] = [
        ("exact depth", with_exact_depth, usual),
        ("greenish wall", lambda shown: with_background(shown, GREENISH), usual),
        (
            "greenish wall, green over red by more than 10",
            lambda shown: with_background(shown, GREENISH),
            replace(usual, leaf_threshold=10),
        ),
    ]
    if data is None:
        lines += [judged(name, [change(p) for p in pictures], config) for name, change, config in changes]
    head = ["", "fruits", "bias of V_f", "failures", "T / true T, median"]
    print(markdown_table([*head, "of it other fruits", "nearer", "deeper", "not measured"], lines))


if __name__ == "__main__":
    tyro.cli(main)
