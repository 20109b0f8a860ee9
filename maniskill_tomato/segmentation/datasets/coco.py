"""COCO: one JSON file for all images, with boxes, polygons or run-length encoded masks.

Two files go together: `annotations.json` has the visible parts, `annotations_amodal.json` the same instances with the
masks and boxes of the whole things. Both are plain COCO; beyond it an annotation has `visible_fraction` and `name`, an
image `depth_file_name`, `T_world_optical` and `camera_matrix`.
"""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.segmentation.datasets.annotations import (
    CATEGORIES,
    AnnotatedImage,
    AnnotatedImages,
    CameraView,
    Instance,
    counted_clip,
)
from maniskill_tomato.segmentation.datasets.picture_files import LARGEST_PICTURE, read_picture
from maniskill_tomato.segmentation.masks import Box, EncodedMask
from maniskill_tomato.text_files import read_json

VISIBLE_FILE = "annotations.json"


def find_coco_file(folder: Path, split: str | None = None) -> Path | None:
    """The COCO file of a folder with the visible parts; None if there is none, or several without a telling name."""
    candidates = [
        path
        for place in (folder, folder / "annotations")
        for path in sorted(place.glob("*.json"))
        if "amodal" not in path.stem and (split is None or split in path.stem) and _looks_like_coco(path)
    ]
    named = [path for path in candidates if path.name == VISIBLE_FILE]
    if named:
        return named[0]
    return candidates[0] if len(candidates) == 1 else None


def read_coco(path: Path | str, split: str | None = None, *, root: Path | None = None) -> AnnotatedImages:
    """Reads a COCO file, and the amodal file beside it if there is one.

    Images without their file are left out and counted; so are annotations of unknown images or categories, crowds,
    broken polygons or runs, and boxes outside the image. Boxes that leave the image are clipped and counted.

    Args:
        path: The file, or its folder.
        split: Part of the file's name, if the folder has several.
        root: Folder that the images' names start from; by default the file's own, or that above `annotations`.

    Raises:
        InvalidInputError: The file cannot be read, or is not COCO.
    """
    path = Path(path)
    if path.is_dir():
        found = find_coco_file(path, split)
        if found is None:
            raise InvalidInputError(
                f"{path} holds no COCO file, or several; name one (*.json with images, annotations, categories)"
            )
        path = found
    content = _load(path)
    amodal_path = path.with_name(path.stem + "_amodal.json")
    amodal = _by_id(_load(amodal_path)) if amodal_path.is_file() else {}
    categories = {k: str(c["name"]) for c in content["categories"] if (k := _key(c, "id")) and "name" in c}
    skipped: Counter[str] = Counter()
    images: dict[str, AnnotatedImage] = {}
    instances: dict[str, list[Instance]] = {}
    unread = set()
    for entry in content["images"]:
        key, image = _key(entry, "id"), _read_image(entry, root or path.parent, skipped)
        if key and image is not None:
            images[key], instances[key] = image, []
        elif key:
            unread.add(key)
    entries = _by_id(content)
    hidden = [entry for key, entry in amodal.items() if key not in entries]
    for entry in [*content["annotations"], *hidden]:
        key = _key(entry, "image_id")
        if key in unread:
            continue
        category = categories.get(_key(entry, "category_id"))
        if key not in images:
            skipped["annotations of unknown images"] += 1
        elif category is None:
            skipped["annotations of unknown categories"] += 1
        elif entry.get("iscrowd"):
            skipped["crowd annotations"] += 1
        else:
            number = _key(entry, "id")
            visible = entry if number in entries or not number else None
            instance = _read_instance(visible, amodal.get(number), category, images[key], skipped)
            if instance is not None:
                instances[key].append(instance)
    return AnnotatedImages(
        images=tuple(replace(image, instances=tuple(instances[key])) for key, image in images.items()),
        skipped=dict(skipped),
    )


def write_coco(
    images: AnnotatedImages, folder: Path | str, *, name: str = "annotations"
) -> tuple[Path, Path | None]:
    """Writes `annotations.json` and, if an amodal mask is known, `annotations_amodal.json`.

    Args:
        images: What to write. The names of their files are written as they are.
        folder: Where; the images themselves are not copied.
        name: Of the files, without `.json`.

    Returns:
        The two files.

    Raises:
        CheckpointError: A file cannot be written.
    """
    folder = Path(folder)
    names = [*CATEGORIES, *(c for c in images.categories if c not in CATEGORIES)]
    category_ids = {name: k + 1 for k, name in enumerate(names)}
    head: dict[str, Any] = {
        "info": {"description": "maniskill-tomato"},
        "images": [_image_entry(k + 1, image) for k, image in enumerate(images.images)],
        "categories": [
            {"id": k, "name": name, "supercategory": "tomato_plant"} for name, k in category_ids.items()
        ],
    }
    visible, amodal = [], []
    number = 0
    for k, image in enumerate(images.images):
        for instance in image.instances:
            number += 1
            entry: dict[str, Any] = {
                "id": number,
                "image_id": k + 1,
                "category_id": category_ids[instance.category],
                "iscrowd": 0,
            }
            if instance.visible_fraction is not None:
                entry["visible_fraction"] = round(instance.visible_fraction, 5)
            if instance.name is not None:
                entry["name"] = instance.name
            if instance.box_xywh[2] > 0:
                visible.append(entry | _shape(instance.visible_mask, instance.box_xywh))
            if instance.amodal_mask is not None:
                box = instance.amodal_box_xywh or instance.amodal_mask.box_xywh
                amodal.append(entry | _shape(instance.amodal_mask, box))
    paths = (folder / f"{name}.json", folder / f"{name}_amodal.json" if amodal else None)
    # The visible file last: where it is, the other one is whole.
    for path, annotations in zip(reversed(paths), (amodal, visible), strict=True):
        if path is not None:
            write_atomically(path, json.dumps(head | {"annotations": annotations}).encode())
    return paths


def _shape(mask: EncodedMask | None, box: Box) -> dict[str, Any]:
    rounded = [round(float(v), 2) for v in box]
    if mask is None:
        # COCO's readers want an outline; a box's own is the honest one.
        x, y, w, h = rounded
        outline = [x, y, x + w, y, x + w, y + h, x, y + h]
        return {"bbox": rounded, "area": round(w * h, 2), "segmentation": [outline], "box_only": True}
    return {"bbox": rounded, "area": mask.area, "segmentation": mask.to_coco()}


def _image_entry(number: int, image: AnnotatedImage) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "id": number,
        "file_name": image.file_name,
        "width": image.width,
        "height": image.height,
    }
    if image.depth_path is not None:
        entry["depth_file_name"] = f"{image.depth_path.parent.name}/{image.depth_path.name}"
    if image.camera is not None:
        entry["T_world_optical"] = np.round(image.camera.T_world_optical, 6).tolist()
        entry["camera_matrix"] = np.round(image.camera.matrix, 4).tolist()
    return entry


def _looks_like_coco(path: Path) -> bool:
    try:
        _load(path)
    except InvalidInputError:
        return False
    return True


def _load(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path)
    except FileNotFoundError:
        raise InvalidInputError(f"there is no COCO file {path}") from None
    keys = ("images", "annotations", "categories")
    if not isinstance(content, dict) or not all(isinstance(content.get(k), list) for k in keys):
        raise InvalidInputError(f"{path} is not a COCO file: it needs the lists {', '.join(keys)}")
    if not all(isinstance(e, dict) for k in ("images", "categories") for e in content[k]):
        raise InvalidInputError(f"{path} is not a COCO file: images and categories must be lists of objects")
    return content


def _key(entry: object, name: str) -> str:
    """A number or name that refers to something, as text; empty if there is none."""
    value = entry.get(name) if isinstance(entry, dict) else None
    return str(value) if isinstance(value, int | str) else ""


def _by_id(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {key: entry for entry in content["annotations"] if (key := _key(entry, "id"))}


def _read_image(entry: Mapping[str, Any], folder: Path, skipped: Counter[str]) -> AnnotatedImage | None:
    name = entry.get("file_name")
    if not isinstance(name, str) or "id" not in entry:
        skipped["images without a name or number"] += 1
        return None
    path = _find(name, folder)
    if path is None:
        skipped["images without their file"] += 1
        return None
    width, height = entry.get("width"), entry.get("height")
    if not (isinstance(width, int) and isinstance(height, int) and width > 0 and height > 0):
        try:
            height, width = read_picture(path).shape[:2]
        except InvalidInputError:
            skipped["images that cannot be read"] += 1
            return None
    if width * height > LARGEST_PICTURE:
        skipped[f"images of more than {LARGEST_PICTURE} pixels"] += 1
        return None
    depth = entry.get("depth_file_name")
    return AnnotatedImage(
        path=path,
        file_name=name,
        width=width,
        height=height,
        depth_path=_find(depth, folder) if isinstance(depth, str) else None,
        camera=_read_camera(entry),
    )


def _find(name: str, folder: Path) -> Path | None:
    wanted = Path(name.replace("\\", "/"))
    if wanted.is_absolute() or ".." in wanted.parts:
        # Annotation files must not point out of their data set.
        wanted = Path(wanted.name)
    for base in (folder, folder.parent) if folder.name == "annotations" else (folder,):
        for candidate in (base / wanted, base / "images" / wanted, base / "images" / wanted.name):
            if candidate.is_file():
                return candidate
    return None


def _read_camera(entry: Mapping[str, Any]) -> CameraView | None:
    try:
        pose = np.array(entry["T_world_optical"], dtype=np.float64)
        matrix = np.array(entry["camera_matrix"], dtype=np.float64)
    except (KeyError, TypeError, ValueError):
        return None
    if pose.shape != (4, 4) or matrix.shape != (3, 3):
        return None
    return CameraView(T_world_optical=pose, matrix=matrix)


def _box(values: object) -> Box | None:
    if not isinstance(values, list) or len(values) != 4:
        return None
    try:
        x, y, w, h = (float(v) for v in values)
    except (TypeError, ValueError):
        return None
    return x, y, w, h


def _read_instance(
    visible: Mapping[str, Any] | None,
    amodal: Mapping[str, Any] | None,
    category: str,
    image: AnnotatedImage,
    skipped: Counter[str],
) -> Instance | None:
    """An instance from its entries in the two files; either may be missing."""
    mask, whole, whole_box = None, None, None
    box: Box = (0.0, 0.0, 0.0, 0.0)
    if visible is not None:
        segmentation = visible.get("segmentation")
        if segmentation and not visible.get("box_only"):
            try:
                mask = EncodedMask.from_coco(segmentation, image.height, image.width)
            except InvalidInputError:
                skipped["annotations with broken polygons or masks"] += 1
                return None
        given = _box(visible.get("bbox")) or (mask.box_xywh if mask is not None else None)
        clipped = counted_clip(given, image.width, image.height, skipped)
        if clipped is None:
            return None
        box = clipped
    if amodal is not None:
        try:
            whole = EncodedMask.from_coco(amodal.get("segmentation"), image.height, image.width)
            whole_box = _box(amodal.get("bbox"))
        except InvalidInputError:
            skipped["broken amodal masks"] += 1
            if visible is None:
                return None
    entry = visible or amodal or {}
    fraction, name = entry.get("visible_fraction"), entry.get("name")
    return Instance(
        category=category,
        box_xywh=box,
        visible_mask=mask,
        amodal_mask=whole,
        amodal_box_xywh=whole_box,
        visible_fraction=float(fraction) if isinstance(fraction, int | float) else None,
        name=name if isinstance(name, str) else None,
    )
