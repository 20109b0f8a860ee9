"""Reads a folder of annotated images in COCO's or Pascal VOC's format."""

from pathlib import Path

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImages
from maniskill_tomato.segmentation.datasets.coco import find_coco_file, read_coco
from maniskill_tomato.segmentation.datasets.voc import find_voc_folder, read_voc


def read_annotated(path: Path | str, split: str | None = None) -> AnnotatedImages:
    """Reads a data set in COCO's or Pascal VOC's format.

    Args:
        path: A folder, or a COCO file.
        split: Which list of a VOC folder (`train` for `train.txt`), or which COCO file (`annotations_train.json`,
            `instances_train2017.json`, ...); everything by default.

    Raises:
        InvalidInputError: There is no such folder, nothing annotated in it, or the annotations cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise InvalidInputError(f"there is no data set at {path}")
    if path.is_file() or find_coco_file(path, split) is not None:
        return read_coco(path, split)
    if find_voc_folder(path) is not None:
        return read_voc(path, split)
    raise InvalidInputError(
        f"{path} holds neither a COCO file (*.json with images, annotations, categories) "
        "nor Pascal VOC annotations (*.xml)"
    )


def read_place(place: str) -> AnnotatedImages:
    """The annotated images of FOLDER, or of FOLDER:SPLIT for one list of it.

    Raises:
        InvalidInputError: There is nothing usable.
    """
    if Path(place).exists():
        return read_annotated(place)
    folder, _, split = place.rpartition(":")
    return read_annotated(folder, split) if folder else read_annotated(place)
