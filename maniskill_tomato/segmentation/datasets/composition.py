"""Sets of rendered images and photos in the thesis's proportions (4-2-1 to 4-2-3), drawn from larger sets.

Photos have boxes only, whatever is annotated in them, so that they train no masks.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, AnnotatedImages, joined
from maniskill_tomato.segmentation.datasets.coco import write_coco
from maniskill_tomato.segmentation.datasets.reading import read_place
from maniskill_tomato.text_files import read_json

Part = Literal["train", "validation", "test"]
Kind = Literal["rendered", "photos"]
Preset = Literal["strategy-1", "strategy-2", "strategy-3", "yolo"]

PARTS: Final[tuple[Part, ...]] = ("test", "train", "validation")
"""In the order in which they are drawn."""

COMPOSITION_FILE: Final = "composition.json"


@dataclass(frozen=True, kw_only=True)
class Counts:
    """How many images of each kind a part has."""

    rendered: int
    photos: int

    def __post_init__(self) -> None:
        for name, count in asdict(self).items():
            if count < 0:
                raise InvalidInputError(f"{name} must be 0 or more images, got {count}")


Composition = Mapping[Part, Counts]

_TEST = Counts(rendered=28, photos=12)

COMPOSITIONS: Final[dict[Preset, Composition]] = {
    "strategy-1": {
        "train": Counts(rendered=103, photos=50),
        "validation": Counts(rendered=68, photos=30),
        "test": _TEST,
    },
    "strategy-2": {
        "train": Counts(rendered=144, photos=76),
        "validation": Counts(rendered=87, photos=38),
        "test": _TEST,
    },
    "strategy-3": {
        "train": Counts(rendered=288, photos=152),
        "validation": Counts(rendered=87, photos=38),
        "test": _TEST,
    },
    "yolo": {
        "train": Counts(rendered=0, photos=120),
        "validation": Counts(rendered=0, photos=30),
        "test": Counts(rendered=0, photos=50),
    },
}
"""The thesis's numbers of images.

The thesis gives only the sums of strategy 2's 125 validation images and of the 40 test images; they are split here as
strategy 1's validation images are. Its third strategy has "a larger dataset", which is read as twice as many training
images as strategy 2. It gives no kinds for the 50 test images of YOLO; they are photos here, as in its training."""

_EARLIER: Final[dict[Preset, tuple[Preset, ...]]] = {
    "strategy-1": (),
    "strategy-2": ("strategy-1",),
    "strategy-3": ("strategy-1", "strategy-2"),
    "yolo": (),
}
"""Compositions whose images each one contains, as strategy 2 of the thesis contains those of strategy 1."""


def compose(
    preset: Preset,
    rendered: Sequence[str],
    photos: Sequence[str],
    out: Path,
    *,
    seed: int = 0,
    counts: Composition | None = None,
) -> dict[Part, AnnotatedImages]:
    """Draws images, copies them and writes `annotations_train.json`, `..._validation.json` and `..._test.json`.

    No image is in two parts. The same seed draws the same images, and of one seed `strategy-2` has all images of
    `strategy-1` in the same parts, and `strategy-3` those of `strategy-2`; the test images are the same.

    Args:
        preset: Which of the thesis's sets.
        rendered: Places (`read_place`) of images with masks: one for all parts, or one each for training, validation
            and test.
        photos: The same of photos, of which the boxes are taken.
        out: Its folder; one that holds another composition is refused.
        seed: Draws the images.
        counts: Other numbers of images for some parts.

    Raises:
        InvalidInputError: There are too few images, none of the rendered ones has a mask, or the folder holds
            something else.
        CheckpointError: A file cannot be written, or another process composes in the folder.
    """
    if seed < 0:
        raise InvalidInputError(f"seed must be 0 or more, got {seed}")
    wanted: dict[Part, Counts] = {**COMPOSITIONS[preset], **(counts or {})}
    if not wanted["train"].rendered + wanted["train"].photos:
        raise InvalidInputError("there must be images to train on: ask for rendered ones or photos")
    stages = [*(COMPOSITIONS[name] for name in _EARLIER[preset]), wanted]
    identity: dict[str, Any] = {
        "preset": preset,
        "seed": seed,
        "rendered": list(rendered),
        "photos": list(photos),
        "counts": {part: asdict(wanted[part]) for part in PARTS},
    }
    with only_writer(out, "composes"):
        simulated = _drawn("rendered", rendered, stages, seed)
        real = _drawn("photos", photos, stages, seed)
        _claim(out, identity)
        found: dict[Part, AnnotatedImages] = {}
        for part in PARTS:
            boxes_only = AnnotatedImages(images=tuple(without_masks(image) for image in real[part]))
            parts = [
                copied(AnnotatedImages(images=tuple(simulated[part])), out, f"{part}_rendered"),
                copied(boxes_only, out, f"{part}_real"),
            ]
            found[part] = joined(parts)
            write_coco(found[part], out, name=f"annotations_{part}")
    return found


def without_masks(image: AnnotatedImage) -> AnnotatedImage:
    """The image with the boxes of its instances alone."""
    boxes = tuple(
        replace(i, visible_mask=None, amodal_mask=None, amodal_box_xywh=None, visible_fraction=None)
        for i in image.instances
        if i.box_xywh[2] > 0
    )
    return replace(image, instances=boxes)


def copied(images: AnnotatedImages, out: Path, prefix: str) -> AnnotatedImages:
    """Copies images into a data set's folder, without depth, under names of their own that begin with a prefix."""
    copies = []
    taken: set[str] = set()
    for image in images.images:
        # Images of several folders may have one name, and Pascal VOC knows files without their endings.
        stem = first = f"{prefix}_{Path(image.file_name).stem}"
        count = 1
        while stem in taken:
            count += 1
            stem = f"{first}_{count}"
        taken.add(stem)
        name = f"images/{stem}{image.path.suffix}"
        target, content = out / name, image.path.read_bytes()
        if not target.is_file() or target.read_bytes() != content:
            write_atomically(target, content)
        copies.append(replace(image, path=target, file_name=name, depth_path=None))
    return AnnotatedImages(images=tuple(copies), skipped=images.skipped)


def _claim(out: Path, identity: dict[str, Any]) -> None:
    path = out / COMPOSITION_FILE
    if path.is_file():
        if read_json(path) != identity:
            raise InvalidInputError(
                f"{out} holds another composition; choose another folder, or the same values"
            )
        return
    if any(out.iterdir()):
        raise InvalidInputError(f"{out} is not empty and holds no composition; choose another folder")
    write_atomically(path, json.dumps(identity, indent=1).encode())


def _drawn(
    kind: Kind, places: Sequence[str], stages: Sequence[Composition], seed: int
) -> dict[Part, list[AnnotatedImage]]:
    """The images of each part, in the order in which they were drawn."""
    by_part = _places(kind, places)
    wanted = stages[-1]
    needed = {
        place: sum(getattr(wanted[part], kind) for part in PARTS if by_part.get(part) == place)
        for place in dict.fromkeys(by_part.values())
    }
    streams: dict[str, Iterator[AnnotatedImage]] = {}
    for place, count in needed.items():
        if count:
            streams[place] = iter(_shuffled(kind, place, count, seed))
    drawn: dict[Part, list[AnnotatedImage]] = {part: [] for part in PARTS}
    for stage in stages:
        for part in PARTS:
            count = min(getattr(stage[part], kind), getattr(wanted[part], kind))
            if count and part not in by_part:
                raise InvalidInputError(f"{count} {kind} are asked for; name a folder of them")
            while len(drawn[part]) < count:
                drawn[part].append(next(streams[by_part[part]]))
    return drawn


def _places(kind: Kind, places: Sequence[str]) -> dict[Part, str]:
    if len(places) not in (0, 1, 3):
        raise InvalidInputError(
            f"{kind} must be one place, or three, of training, validation and test; got {len(places)}"
        )
    named = list(places) * 3 if len(places) == 1 else places
    parts: tuple[Part, ...] = ("train", "validation", "test")
    return dict(zip(parts, named, strict=False))


def _shuffled(kind: Kind, place: str, count: int, seed: int) -> list[AnnotatedImage]:
    images = sorted(read_place(place).images, key=lambda image: image.file_name)
    if kind == "rendered":
        if not any(i.visible_mask is not None for image in images for i in image.instances):
            raise InvalidInputError(
                f"{place} holds no masks; rendered images are made by `maniskill-tomato dataset`"
            )
        # A data set with photos copied in has images of both kinds.
        images = [
            image for image in images if all(i.visible_mask for i in image.instances if i.box_xywh[2] > 0)
        ]
    if len(images) < count:
        raise InvalidInputError(
            f"{place} has {len(images)} {'rendered images' if kind == 'rendered' else 'photos'}, {count} are needed; "
            "add some, or ask for fewer"
        )
    # Each kind has a stream of its own.
    order = np.random.default_rng([seed, int(kind == "photos")]).permutation(len(images))
    return [images[k] for k in order]
