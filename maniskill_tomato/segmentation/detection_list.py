"""Fruits and other things in image files, as a JSON list in COCO's form."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import refuse_inputs, write_atomically
from maniskill_tomato.segmentation.datasets.picture_files import read_picture
from maniskill_tomato.segmentation.instances import Image, Instances
from maniskill_tomato.segmentation.masks import EncodedMask
from maniskill_tomato.segmentation.segmenter import Segmenter, ThingSegmenter

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")


@dataclass(frozen=True, kw_only=True)
class DetectionSummary:
    """How many images were searched and what was found."""

    images: int
    """Images that were searched."""
    detections: int
    """Fruits found in them."""
    others: int
    """Other things found in them."""
    skipped: tuple[str, ...]
    """Why each of the others was left out."""


def image_files(place: Path) -> list[Path]:
    """The image files in a folder, by name, or the one file.

    Raises:
        InvalidInputError: There is nothing there, or no image.
    """
    if place.is_file():
        return [place]
    if not place.is_dir():
        raise InvalidInputError(f"there is no image or folder {place}")
    files = sorted(p for p in place.iterdir() if p.is_file() and p.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise InvalidInputError(
            f"{place} holds no image ({', '.join(IMAGE_SUFFIXES)}); its subfolders are not searched"
        )
    return files


def drawing_files(place: Path, folder: Path) -> dict[str, Path]:
    """Where the drawing of each image goes, by the image's name: no two share one, and none is an image itself.

    Args:
        place: An image or a folder.
        folder: Of the drawings.

    Raises:
        InvalidInputError: There is no image, or a drawing would take its place.
    """
    files = image_files(place)
    stems = [path.stem for path in files]
    drawings = {
        path.name: folder / (f"{path.stem}.jpg" if stems.count(path.stem) == 1 else f"{path.name}.jpg")
        for path in files
    }
    images = {path.resolve() for path in files}
    for name, drawing in drawings.items():
        if drawing.resolve() in images:
            raise InvalidInputError(
                f"--pictures: the drawing of {name} would take the place of the image {drawing}; choose another folder"
            )
    return drawings


def detect(
    place: Path,
    segmenter: Segmenter,
    out: Path,
    seen: Callable[[str, Image, Instances], None] | None = None,
    everything: bool = False,
) -> DetectionSummary:
    """Finds the fruits in an image, or in each image of a folder, and writes a JSON list with one object a fruit.

    Each object has `file_name`, `bbox` (x, y, w, h in [px]), `score`, `category` and `segmentation` (COCO's run-length
    encoding, `counts` as text). Files that cannot be read are left out. If none can be read, that is an error.

    Args:
        place: An image or a folder.
        segmenter: Finds the fruits.
        out: The file to write, whole or not at all.
        seen: Called with each name, image and what was found in it.
        everything: List leaves, stems and the robot too.

    Raises:
        InvalidInputError: There is no image, none can be read, or `out` is a folder, an image, or named as one; or
            the segmenter tells fruits alone, and everything is asked for.
        CheckpointError: The file cannot be written.
    """
    if out.is_dir():
        raise InvalidInputError(f"--out must be a file such as {out / 'detections.json'}; {out} is a folder")
    if out.suffix.lower() in IMAGE_SUFFIXES:
        raise InvalidInputError(f"--out is the list and must be a file such as detections.json; got {out}")
    finds: Callable[[Image], Instances] = segmenter
    if everything:
        if not isinstance(segmenter, ThingSegmenter):
            raise InvalidInputError(
                "--everything needs a segmenter that tells more than fruits: weights of `maniskill-tomato "
                "train-segmenter mask-rcnn --classes tomato leaf stem`"
            )
        finds = segmenter.things
    entries: list[dict[str, Any]] = []
    skipped: list[str] = []
    others = 0
    files = image_files(place)
    refuse_inputs("--out", out, files)
    for path in files:
        try:
            image = read_picture(path)
        except InvalidInputError as error:
            if len(files) == 1:
                raise
            skipped.append(str(error))
            continue
        found = finds(image)
        others += len(found) - len(found.fruits()) if everything else 0
        entries += detection_entries(path.name, found)
        if seen is not None:
            seen(path.name, image, found)
    if len(skipped) == len(files):
        raise InvalidInputError(
            f"none of the {len(files)} files in {place} can be read as an image; {skipped[0]}"
        )
    write_atomically(out, json.dumps(entries, indent=1).encode())
    return DetectionSummary(
        images=len(files) - len(skipped),
        detections=len(entries) - others,
        others=others,
        skipped=tuple(skipped),
    )


def detection_entries(file_name: str, found: Instances) -> list[dict[str, Any]]:
    """The objects of one image; see `detect`."""
    return [
        {
            "file_name": file_name,
            "bbox": [round(float(v), 2) for v in (left, top, right - left, bottom - top)],
            "score": round(float(score), 5),
            "category": category,
            "segmentation": EncodedMask.encode(mask).to_coco(),
        }
        for (left, top, right, bottom), score, category, mask in zip(
            found.boxes, found.scores, found.categories, found.masks, strict=True
        )
    ]
