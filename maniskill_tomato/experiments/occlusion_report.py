"""The occlusion models on a folder of rendered images: tables of their errors, or every step on one image."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.occlusion_figure import draw_steps
from maniskill_tomato.experiments.occlusion_scores import (
    OUTLINE_HEAD,
    SCORE_HEAD,
    Judged,
    annotated_fruits,
    band_table,
    judge,
    make_view,
    markdown,
    outline_cells,
    score,
    score_cells,
)
from maniskill_tomato.files import write_atomically
from maniskill_tomato.report_design import figure, paragraph, photo, report, section, table, tile, tiles
from maniskill_tomato.report_plots import plot_intervals
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
from maniskill_tomato.segmentation.datasets.reading import read_annotated
from maniskill_tomato.segmentation.segmenter import make_segmenter
from maniskill_tomato.sensing.visible_fraction.occlusion_models import make_occlusion_model
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisModel

WORST: Final = 12
"""Tomatoes of the list of the largest errors."""

PICTURE_WIDTH: Final = 900
"""Width at which the texts of the drawn steps can be read, in [px]."""

ABOUT: Final = (
    "An occlusion model estimates V_f, the share of a tomato's outline that nothing hides (0 to 1), from the colour "
    "image, the depth and a mask of what is visible of the tomato. The truth is the renderer's."
)

MODELS: Final = {
    "thesis": "thesis: the thesis's ten steps of image processing, which look for red behind the leaves.",
    "thesis_watershed": "thesis_watershed: the same, and a watershed divides outlines with several tomatoes in them.",
    "thesis_classifier": "thesis_classifier: the same with a polynomial classifier of pixel coordinates.",
    "improved": "improved: what the thesis proposes for later work; steps scaled with the size of the tomato.",
    "sphere": "sphere: fits a sphere to the visible outline and the depth; what the robot uses.",
    "amodal": "amodal: the light segmenter's guess at the box of the whole tomato, without depth.",
}

FIGURES: Final = (
    "MAE is the mean absolute error of V_f (0 to 1). A tomato of which a model says nothing is a failure, and counts "
    "in MAE as a guess of 0. Bias (mean error) and RMSE (root of the mean squared error) are without failures. The "
    "CPU time is a model's for all tomatoes of an image, without the segmenter's, in ms."
)

OUTLINES: Final = (
    "Intersection over union (0 to 1) of the model's whole silhouettes with the true ones inside the image, and of "
    "what is hidden of both, where 5 % or more of a tomato is hidden. Means over tomatoes, 0 for a failure. What is "
    "visible was given to the models."
)

STEPS: Final = (
    "(a) to (h) are the steps of the thesis's model (Fig. 4-28). (b) Masks of the visible tomatoes. (c) Leaves: where "
    "green exceeds red. (d) The image with the leaves painted over from their surroundings. (e) Where red now exceeds "
    "green, without specks and what is far away. (f) Outlines of these areas. (g) An ellipse fitted to each. (h) V_f: "
    "the visible tomato as a share of its ellipse. The pictures below show what the other models take for the whole "
    "tomatoes, with the V_f that follows."
)


def report_occlusion(
    images: Sequence[AnnotatedImage],
    out: Path,
    *,
    models: Sequence[str],
    categories: Sequence[str],
    min_visible: int,
    min_total: int,
    segmenter: str | None = None,
    on_image: Callable[[int], object] | None = None,
) -> str:
    """Judges models and writes report.html, and occlusion.json with every single judgement.

    Args:
        images: With depth, cameras and V_f.
        out: Folder of the files.
        models: Names of `OCCLUSION_MODELS`.
        categories: Which tomatoes count.
        min_visible: Tomatoes seen in fewer pixels are left out.
        min_total: Tomatoes whose whole silhouette has fewer pixels, too.
        segmenter: Name or weights of the one that finds the tomatoes; None gives the models the true masks.
        on_image: Called with 1 after every image.

    Returns:
        The tables as Markdown.
    """
    found_by = None if segmenter is None else make_segmenter(segmenter)
    judged, milliseconds = judge(
        tuple(images),
        {name: make_occlusion_model(name) for name in models},
        segmenter=found_by,
        min_visible=min_visible,
        min_total=min_total,
        on_image=on_image,
    )
    judged = [j for j in judged if j.category in categories]
    masks = (
        "true masks"
        if segmenter is None
        else f"masks of {segmenter}; failures are tomatoes that it missed, too"
    )
    told = (
        f"{len(images)} images, {', '.join(categories)}, at least {min_visible} px visible, {min_total} px in all, "
        f"{masks}."
    )
    write_atomically(out / "occlusion.json", json.dumps([asdict(j) for j in judged]).encode())
    _write_report(out, judged, milliseconds, told)
    return f"{told}\n\n{markdown(judged, milliseconds)}"


def _write_report(out: Path, judged: list[Judged], milliseconds: Mapping[str, float], told: str) -> None:
    """Writes report.html with a plot of the models' errors, and where they are largest."""
    errors = {name: score([j for j in judged if j.model == name]).mae for name in milliseconds}
    known = {name: error for name, error in errors.items() if math.isfinite(error)}
    count = len(judged) // max(len(milliseconds), 1)
    of = f"n = {count} tomatoes a model"
    shown = []
    if known:
        plot_intervals(
            known, "Error in V_f", "mean absolute error of V_f (0 to 1)", out / "errors.png", (0.0, None)
        )
        shown.append(
            figure(out / "errors.png", f"Mean absolute error of V_f (0 to 1), less is better; {of}.")
        )
    best = [
        tile(f"{error:.3f}", f"mean absolute error in V_f (0 to 1), {name}: the smallest", of)
        for name, error in sorted(known.items(), key=lambda pair: pair[1])[:1]
    ]
    report(
        out,
        "Occlusion models",
        told,
        [
            tiles(*best) if best else "",
            section(
                "What is compared",
                paragraph(ABOUT),
                *(paragraph(MODELS[name]) for name in milliseconds if name in MODELS),
            ),
            section(
                f"Errors in V_f, {of}",
                table(SCORE_HEAD, score_cells(judged, milliseconds)),
                paragraph(FIGURES, "caption"),
                *shown,
            ),
            section(
                f"Largest errors, {min(WORST, len(judged))} of n = {len(judged)} estimates",
                table(WORST_HEAD, _worst(judged), words=(3,)),
                paragraph("--figure IMAGE draws what the models make of one of these images.", "caption"),
            ),
            section(
                f"By how hidden the tomato is, {of}",
                table(*band_table(judged, milliseconds)),
                paragraph("Mean absolute error of V_f (0 to 1), and in brackets its bias.", "caption"),
            ),
            *_outlines(judged),
        ],
        run_facts(),
    )


def _outlines(judged: list[Judged]) -> list[str]:
    rows = outline_cells(judged)
    if not rows:
        return []
    return [section("Whole silhouettes", table(OUTLINE_HEAD, rows), paragraph(OUTLINES, "caption"))]


WORST_HEAD: Final = ("image", "model", "tomato", "why", "true V_f", "estimate", "visible [px]")


def _worst(judged: Sequence[Judged]) -> list[tuple[str, ...]]:
    """Lines with `WORST_HEAD`, largest errors first; a failure counts as a guess of 0."""

    def error(one: Judged) -> float:
        return abs((one.estimate if math.isfinite(one.estimate) else 0.0) - one.truth)

    return [
        (
            one.file_name,
            one.model,
            one.category,
            _what_went_wrong(one),
            f"{one.truth:.2f}",
            _estimate_text(one.estimate),
            str(one.visible_px),
        )
        for one in sorted(judged, key=error, reverse=True)[:WORST]
    ]


def _what_went_wrong(one: Judged) -> str:
    if not math.isfinite(one.estimate):
        return "no estimate"
    return "estimate too high" if one.estimate > one.truth else "estimate too low"


def _estimate_text(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "none"


def draw_occlusion(data: Path, file_name: str, out: Path, *, models: Sequence[str], min_visible: int) -> Path:
    """Draws every step of the thesis's model on one image (Fig. 4-28), and what the other models make of it.

    Writes report.html with the picture and the numbers, too.

    Args:
        data: A folder of rendered images.
        file_name: The image's name in it, with or without its folder and ending.
        out: Folder of the picture.
        models: Names of `OCCLUSION_MODELS`.
        min_visible: Tomatoes seen in fewer pixels are left out.

    Returns:
        The picture.

    Raises:
        InvalidInputError: There is no such image, or it has no depth or camera.
    """
    images = read_annotated(data).images
    named = [
        image
        for image in images
        if file_name in (image.file_name, Path(image.file_name).name, Path(image.file_name).stem)
    ]
    if len(named) != 1:
        known = [image.file_name for image in named or images]
        raise InvalidInputError.choice("--figure", file_name, known[:20])
    (image,) = named
    fruits = [
        fruit
        for fruit in annotated_fruits(image)
        if fruit.visible_mask and fruit.visible_mask.area >= min_visible
    ]
    view = make_view(image, fruits)
    if view is None:
        raise InvalidInputError(
            f"{image.file_name} has no depth or camera; take a folder of `maniskill-tomato dataset`"
        )
    estimates = {name: list(make_occlusion_model(name)(view)) for name in models}
    others = {name: found for name, found in estimates.items() if name != "thesis"}
    path = out / "steps.png"
    draw_steps(view, ThesisModel().run(view), path, others)
    rows = [
        (
            str(k + 1),
            fruit.category,
            "" if fruit.visible_fraction is None else f"{fruit.visible_fraction:.2f}",
            *(_estimate_text(found[k].visible_fraction) for found in estimates.values()),
        )
        for k, fruit in enumerate(fruits)
    ]
    of = f"n = {len(fruits)} tomatoes"
    report(
        out,
        f"Occlusion models on {image.file_name}",
        f"{data}, {of} of at least {min_visible} px",
        [
            section(
                "Every step",
                photo(path.read_bytes(), f"Steps of the models on {image.file_name}; {of}.", PICTURE_WIDTH),
                paragraph(STEPS, "caption"),
            ),
            section(
                f"V_f (0 to 1), {of}",
                table(("tomato", "kind", "truth", *estimates), rows),
                paragraph(
                    "The share of the tomato's outline that nothing hides; none where a model says nothing.",
                    "caption",
                ),
            ),
            section("The models", *(paragraph(MODELS[name]) for name in estimates if name in MODELS)),
        ],
        run_facts(),
    )
    return path
