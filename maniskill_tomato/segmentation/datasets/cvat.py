"""CVAT for images: one XML file for all images, with boxes, outlines and masks."""

import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, AnnotatedImages, Instance
from maniskill_tomato.segmentation.datasets.pictures_of_folder import (
    annotated,
    boxed,
    find_picture,
    outlined,
    picture_size,
)
from maniskill_tomato.segmentation.masks import EncodedMask


def find_cvat_file(folder: Path) -> Path | None:
    """The XML file of a folder that is CVAT's; None if there is none."""
    for place in (folder, folder / "annotations"):
        for path in sorted(place.glob("*.xml")):
            root = _root(path)
            if root is not None and root.tag == "annotations" and root.find("image") is not None:
                return path
    return None


def read_cvat(path: Path | str, split: str | None = None) -> AnnotatedImages:
    """Reads an export of the kind "CVAT for images 1.1".

    Images without their file and broken shapes are left out and counted.

    Args:
        path: Folder of `annotations.xml`, with the images in `images` or beside it.
        split: The subset (`train`, `val`, ...) that the images belong to in CVAT; all by default.

    Raises:
        InvalidInputError: There is no such file, or no image of the subset.
    """
    folder = Path(path)
    file = find_cvat_file(folder)
    root = None if file is None else _root(file)
    if root is None:
        raise InvalidInputError(f"there is no file of CVAT (*.xml with annotations/image) in {folder}")
    entries = root.findall("image")
    if split is not None:
        subsets = sorted({entry.get("subset", "") for entry in entries})
        entries = [entry for entry in entries if (entry.get("subset") or "").lower() == split.lower()]
        if not entries:
            raise InvalidInputError.choice("the subset of CVAT's images", split, subsets)
    skipped: Counter[str] = Counter()
    images = [image for entry in entries if (image := _read_image(folder, entry, skipped)) is not None]
    return AnnotatedImages(images=tuple(images), skipped=dict(skipped))


def _root(path: Path) -> ElementTree.Element | None:
    try:
        return ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError, ValueError, LookupError):
        return None


def _read_image(folder: Path, entry: ElementTree.Element, skipped: Counter[str]) -> AnnotatedImage | None:
    name = entry.get("name", "")
    subset = entry.get("subset") or "."
    picture = find_picture(folder, name, ("images", f"images/{Path(subset).name}", "."))
    if picture is None:
        skipped["images without their file"] += 1
        return None
    try:
        width, height = picture_size(picture, (entry.get("width"), entry.get("height")))
    except InvalidInputError as error:
        skipped[str(error)] += 1
        return None
    found = [_read_shape(shape, width, height, skipped) for shape in entry]
    return annotated(folder, picture, (width, height), found)


def _read_shape(
    shape: ElementTree.Element, width: int, height: int, skipped: Counter[str]
) -> Instance | None:
    label = shape.get("label", "").strip()
    if not label:
        skipped["shapes without a name or with broken numbers"] += 1
        return None
    try:
        if shape.tag == "box":
            left, top, right, bottom = (float(shape.get(key, "")) for key in ("xtl", "ytl", "xbr", "ybr"))
            return boxed(label, (left, top, right - left, bottom - top), width, height, skipped)
        if shape.tag == "polygon":
            corners = [float(x) for point in shape.get("points", "").split(";") for x in point.split(",")]
            return outlined(label, corners, width, height, skipped)
        if shape.tag == "mask":
            return _masked(label, shape, width, height, skipped)
    except ValueError:
        skipped["shapes without a name or with broken numbers"] += 1
        return None
    skipped[f"shapes of the kind {shape.tag}"] += 1
    return None


def _masked(
    label: str, shape: ElementTree.Element, width: int, height: int, skipped: Counter[str]
) -> Instance | None:
    """CVAT's runs are row by row inside the mask's box, and begin with pixels outside."""
    left, top, w, h = (int(shape.get(key, "")) for key in ("left", "top", "width", "height"))
    runs = [int(run) for run in shape.get("rle", "").split(",")]
    inside = 0 <= left < width and 0 <= top < height and 0 < w <= width - left and 0 < h <= height - top
    if not inside or min(runs) < 0 or sum(runs) != w * h:
        skipped["annotations with broken polygons or masks"] += 1
        return None
    mask = np.zeros((height, width), bool)
    values = np.arange(len(runs)) % 2 == 1
    mask[top : top + h, left : left + w] = np.repeat(values, runs).reshape(h, w)
    encoded = EncodedMask.encode(mask)
    found = boxed(label, encoded.box_xywh, width, height, skipped)
    return None if found is None else Instance(category=label, box_xywh=found.box_xywh, visible_mask=encoded)
