"""Reads a folder of annotated images in any of the formats that annotation tools write."""

from pathlib import Path

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImages
from maniskill_tomato.segmentation.datasets.coco import find_coco_file, read_coco
from maniskill_tomato.segmentation.datasets.cvat import find_cvat_file, read_cvat
from maniskill_tomato.segmentation.datasets.labelme import find_labelme_files, read_labelme
from maniskill_tomato.segmentation.datasets.voc import find_voc_folder, read_voc
from maniskill_tomato.segmentation.datasets.yolo_text import find_yolo_labels, read_yolo


def read_annotated(path: Path | str, split: str | None = None) -> AnnotatedImages:
    """Reads a data set in the format of COCO, Pascal VOC, YOLO's text files, LabelMe or CVAT.

    Args:
        path: A folder, or a COCO file.
        split: Which list of a VOC or LabelMe folder (`train` for `train.txt`), which COCO file
            (`annotations_train.json`, `instances_train2017.json`, ...), which folders of YOLO's labels, or which subset
            of CVAT's images; everything by default.

    Raises:
        InvalidInputError: There is no such folder, nothing annotated in it, or the annotations cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise InvalidInputError(f"there is no data set at {path}")
    if path.is_file() or find_coco_file(path, split) is not None:
        return read_coco(path, split)
    if find_cvat_file(path) is not None:
        return read_cvat(path, split)
    if find_voc_folder(path) is not None:
        return read_voc(path, split)
    if find_yolo_labels(path):
        return read_yolo(path, split)
    if find_labelme_files(path):
        return read_labelme(path, split)
    raise InvalidInputError(
        f"{path} holds no annotations that are known: a COCO file (*.json with images, annotations, categories), "
        "Pascal VOC's *.xml, CVAT's annotations.xml, LabelMe's *.json with shapes, or YOLO's labels/*.txt "
        "with data.yaml or classes.txt"
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
