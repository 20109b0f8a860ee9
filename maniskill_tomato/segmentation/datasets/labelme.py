"""LabelMe: a JSON file for each image, beside it, with outlines, boxes and circles."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, AnnotatedImages, Instance
from maniskill_tomato.segmentation.datasets.pictures_of_folder import (
    annotated,
    boxed,
    find_picture,
    outlined,
    picture_size,
)
from maniskill_tomato.text_files import read_json

CIRCLE_CORNERS = 48
"""Corners of the outline that a circle becomes."""


def find_labelme_files(folder: Path) -> list[Path]:
    """The JSON files of a folder if they are LabelMe's; none if it is no such set."""
    files = [path for place in (folder, folder / "annotations") for path in sorted(place.glob("*.json"))]
    return files if files and _content(files[0]) is not None else []


def read_labelme(folder: Path | str, split: str | None = None) -> AnnotatedImages:
    """Reads a folder of LabelMe's JSON files.

    Images without their file, files that are not LabelMe's, and shapes that are no surface are left out and counted.

    Args:
        folder: Holds the JSON files, or a folder `annotations` with them; images lie beside them or in `images`.
        split: A list `SPLIT.txt` of names of images in the folder; all by default.

    Raises:
        InvalidInputError: There is no such file, or no such list.
    """
    folder = Path(folder)
    files = find_labelme_files(folder)
    if not files:
        raise InvalidInputError(f"there are no LabelMe files (*.json with shapes) in {folder}")
    if split is not None:
        listed = folder / f"{split}.txt"
        if not listed.is_file():
            raise InvalidInputError(
                f"there is no list {listed.name} in {folder}; leave the split out for all"
            )
        wanted = {Path(line.strip()).stem for line in listed.read_text().splitlines() if line.strip()}
        files = [path for path in files if path.stem in wanted]
    skipped: Counter[str] = Counter()
    images = [image for path in files if (image := _read_image(folder, path, skipped)) is not None]
    return AnnotatedImages(images=tuple(images), skipped=dict(skipped))


def _content(path: Path) -> dict[str, Any] | None:
    try:
        content = read_json(path)
    except (InvalidInputError, OSError):
        return None
    is_labelme = isinstance(content, dict) and isinstance(content.get("shapes"), list)
    return content if is_labelme else None


def _read_image(folder: Path, path: Path, skipped: Counter[str]) -> AnnotatedImage | None:
    content = _content(path)
    if content is None:
        skipped["files that are not LabelMe's"] += 1
        return None
    beside = path.parent.relative_to(folder).as_posix()
    name = content.get("imagePath")
    picture = find_picture(folder, name if isinstance(name, str) else path.stem, (beside, "images", "."))
    if picture is None:
        skipped["images without their file"] += 1
        return None
    try:
        width, height = picture_size(picture, (content.get("imageWidth"), content.get("imageHeight")))
    except InvalidInputError as error:
        skipped[str(error)] += 1
        return None
    found = [_read_shape(shape, width, height, skipped) for shape in content["shapes"]]
    return annotated(folder, picture, (width, height), found)


def _read_shape(shape: object, width: int, height: int, skipped: Counter[str]) -> Instance | None:
    label, kind, points = _parts(shape)
    if not label or points is None:
        skipped["shapes without a name or with broken numbers"] += 1
        return None
    if kind == "rectangle" and len(points) == 2:
        (x0, y0), (x1, y1) = points
        box = (min(x0, x1), min(y0, y1), abs(x1 - x0), abs(y1 - y0))
        return boxed(label, box, width, height, skipped)
    if kind == "circle" and len(points) == 2:
        (x, y), (on_x, on_y) = points
        radius = math.hypot(on_x - x, on_y - y)
        turns = [2 * math.pi * k / CIRCLE_CORNERS for k in range(CIRCLE_CORNERS)]
        points = [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in turns]
    elif kind != "polygon":
        skipped[f"shapes of the kind {kind}"] += 1
        return None
    return outlined(label, [number for point in points for number in point], width, height, skipped)


def _parts(shape: object) -> tuple[str, str, list[tuple[float, float]] | None]:
    if not isinstance(shape, dict):
        return "", "", None
    label, kind = shape.get("label"), shape.get("shape_type", "polygon")
    try:
        points = [(float(x), float(y)) for x, y in shape["points"]]
    except (KeyError, TypeError, ValueError):
        return "", "", None
    finite = all(math.isfinite(number) for point in points for number in point)
    return (
        label.strip() if isinstance(label, str) else "",
        kind if isinstance(kind, str) else "?",
        points if finite else None,
    )
