"""The occlusion models on a folder of rendered images: tables of their errors, or every step on one image."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.occlusion_figure import draw_steps
from maniskill_tomato.experiments.occlusion_scores import annotated_fruits, judge, make_view, markdown
from maniskill_tomato.files import write_atomically
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
from maniskill_tomato.segmentation.datasets.reading import read_annotated
from maniskill_tomato.segmentation.segmenter import make_segmenter
from maniskill_tomato.sensing.fruit_detector import robots_model
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
    """Judges models and writes occlusion.md, and occlusion.json with every single judgement.

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
        {
            name: robots_model() if found_by and name == "sphere" else make_occlusion_model(name)
            for name in models
        },
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
    text = (
        f"{len(images)} images, {', '.join(categories)}, at least {min_visible} px visible, {min_total} px in all, "
        f"{masks}."
        f"\n\n{markdown(judged, milliseconds)}"
    )
    write_atomically(out / "occlusion.md", text.encode())
    write_atomically(out / "occlusion.json", json.dumps([asdict(j) for j in judged]).encode())
    return text


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
