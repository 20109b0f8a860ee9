"""The occlusion models on a folder of rendered images: tables of their errors, or every step on one image."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.occlusion_figure import draw_steps
from maniskill_tomato.experiments.occlusion_scores import (
    SCORE_HEAD,
    Judged,
    annotated_fruits,
    band_table,
    judge,
    make_view,
    markdown,
    score,
    score_cells,
)
from maniskill_tomato.files import write_atomically
from maniskill_tomato.report_design import figure, paragraph, report, section, table
from maniskill_tomato.report_plots import plot_intervals
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
from maniskill_tomato.segmentation.datasets.reading import read_annotated
from maniskill_tomato.segmentation.segmenter import make_segmenter
from maniskill_tomato.sensing.visible_fraction.occlusion_models import make_occlusion_model
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisModel


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
    """Writes report.html with a plot of the models' errors."""
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
    report(
        out,
        "Occlusion models",
        told,
        [
            section(
                f"Errors in V_f, {of}",
                table(SCORE_HEAD, score_cells(judged, milliseconds)),
                *shown,
                paragraph(
                    "MAE: mean absolute error of V_f (0 to 1); a failure counts as a guess of 0. Bias and RMSE are "
                    "without failures. CPU time in ms for an image, without the segmenter's.",
                    "caption",
                ),
            ),
            section("By how hidden the tomato is", table(*band_table(judged, milliseconds))),
        ],
        run_facts(),
    )


def draw_occlusion(data: Path, file_name: str, out: Path, *, models: Sequence[str], min_visible: int) -> Path:
    """Draws every step of the thesis's model on one image (Fig. 4-28), and what the other models make of it.

    Args:
        data: A folder of rendered images.
        file_name: The image's name in it.
        out: Folder of the picture.
        models: Names of `OCCLUSION_MODELS`.
        min_visible: Tomatoes seen in fewer pixels are left out.

    Returns:
        The picture.

    Raises:
        InvalidInputError: There is no such image, or it has no depth or camera.
    """
    images = {image.file_name: image for image in read_annotated(data).images}
    if file_name not in images:
        raise InvalidInputError.choice("figure", file_name, list(images)[:20])
    fruits = [
        fruit
        for fruit in annotated_fruits(images[file_name])
        if fruit.visible_mask and fruit.visible_mask.area >= min_visible
    ]
    view = make_view(images[file_name], fruits)
    if view is None:
        raise InvalidInputError(
            f"{file_name} has no depth or camera; take a folder of `maniskill-tomato dataset`"
        )
    others = {name: list(make_occlusion_model(name)(view)) for name in models if name != "thesis"}
    path = out / "steps.png"
    draw_steps(view, ThesisModel().run(view), path, others)
    return path
