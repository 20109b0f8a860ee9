"""YOLO's text files: for each image a file of lines, a thing a line, in shares of the image's width and height.

A line is `class x y width height` with the box's centre, or `class x1 y1 x2 y2 x3 y3 ...` with an outline. A YAML file
names the classes and the lists (Ultralytics' `data.yaml`); without one, `classes.txt` does (LabelImg).
"""

import re
from collections import Counter
from pathlib import Path

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, AnnotatedImages, Instance
from maniskill_tomato.segmentation.datasets.pictures_of_folder import (
    annotated,
    boxed,
    find_picture,
    outlined,
    picture_size,
)

SPLIT_FOLDERS = {"train": ("train",), "val": ("val", "valid", "validation"), "test": ("test",)}
"""Names of the folders of each list."""


def find_yolo_labels(folder: Path) -> list[Path]:
    """The folders with label files of a data set; none if it is no such set."""
    if not _has_names(folder):
        return []
    places = {
        path.parent for path in folder.rglob("*.txt") if "labels" in path.relative_to(folder).parts[:-1]
    }
    if not places and any(_is_label(path) for path in folder.glob("*.txt")):
        places = {folder}
    return sorted(places)


def read_yolo(folder: Path | str, split: str | None = None) -> AnnotatedImages:
    """Reads a folder of YOLO's text files; see the module.

    Images without their file and broken lines are left out and counted.

    Args:
        folder: Holds `data.yaml` or `classes.txt`, and `labels` beside `images`, in either order of folders
            (`labels/train` or `train/labels`), or the text files beside the images.
        split: `train`, `val` or `test`: labels in folders of this name. All by default.

    Raises:
        InvalidInputError: There are no labels, no names of classes, or no such list.
    """
    folder = Path(folder)
    places = find_yolo_labels(folder)
    if not places:
        raise InvalidInputError(
            f"there are no YOLO labels in {folder}: it needs data.yaml or classes.txt, and *.txt in labels"
        )
    names = _names(folder)
    if split is not None:
        wanted = SPLIT_FOLDERS.get(split, (split,))
        places = [place for place in places if set(place.relative_to(folder).parts) & set(wanted)]
        if not places:
            raise InvalidInputError(
                f"there are no YOLO labels of {split!r} in {folder}; leave it out for all"
            )
    skipped: Counter[str] = Counter()
    images = []
    for place in places:
        for path in sorted(place.glob("*.txt")):
            if (
                path.name != "classes.txt"
                and (image := _read_image(folder, path, names, skipped)) is not None
            ):
                images.append(image)
    return AnnotatedImages(images=tuple(images), skipped=dict(skipped))


def _read_image(
    folder: Path, path: Path, names: dict[int, str], skipped: Counter[str]
) -> AnnotatedImage | None:
    parts = path.relative_to(folder).parts[:-1]
    beside = Path(*("images" if part == "labels" else part for part in parts)).as_posix()
    picture = find_picture(folder, path.stem, (beside, "images", "."))
    if picture is None:
        skipped["images without their file"] += 1
        return None
    try:
        width, height = picture_size(picture)
        lines = path.read_text(encoding="utf-8").splitlines()
    except InvalidInputError as error:
        skipped[str(error)] += 1
        return None
    except (OSError, UnicodeDecodeError):
        skipped["label files that cannot be read"] += 1
        return None
    found = [_read_line(line, names, width, height, skipped) for line in lines if line.strip()]
    return annotated(folder, picture, (width, height), found)


def _read_line(
    line: str, names: dict[int, str], width: int, height: int, skipped: Counter[str]
) -> Instance | None:
    try:
        number, *shares = (float(word) for word in line.split())
        category = names[int(number)]
    except (ValueError, KeyError, OverflowError):
        skipped["lines with broken numbers or unknown classes"] += 1
        return None
    if len(shares) in (4, 5):  # A fifth number is a score.
        x, y, w, h = shares[:4]
        box = ((x - w / 2) * width, (y - h / 2) * height, w * width, h * height)
        return boxed(category, box, width, height, skipped)
    sides = (width, height)
    return outlined(
        category, [share * sides[k % 2] for k, share in enumerate(shares)], width, height, skipped
    )


def _has_names(folder: Path) -> bool:
    return bool(_name_files(folder))


def _name_files(folder: Path) -> list[Path]:
    named = [path for path in sorted(folder.glob("*.yaml")) if re.search(r"(?m)^names\s*:", _text(path))]
    return [
        *named,
        *(path for path in (folder / "classes.txt", folder / "labels" / "classes.txt") if path.is_file()),
    ]


def _names(folder: Path) -> dict[int, str]:
    """The names of the classes by their numbers."""
    path = _name_files(folder)[0]
    text = _text(path)
    if path.suffix != ".yaml":
        return dict(enumerate(line.strip() for line in text.splitlines() if line.strip()))
    import yaml

    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InvalidInputError(f"{path} cannot be read as YAML: {error}") from error
    names = content.get("names") if isinstance(content, dict) else None
    if isinstance(names, list):
        names = dict(enumerate(names))
    if not isinstance(names, dict) or not names or not all(isinstance(key, int) for key in names):
        raise InvalidInputError(f"{path} must name the classes under `names:`, as a list or by their numbers")
    return {key: str(name) for key, name in names.items()}


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


def _is_label(path: Path) -> bool:
    return path.name != "classes.txt" and bool(
        re.match(r"\d+( +[\d.eE+-]+){4,}\s*$", _text(path).split("\n")[0])
    )
