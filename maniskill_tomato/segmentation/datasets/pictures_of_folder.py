"""Pictures that annotation files name: found inside the data set's folder, with their size."""

from collections import Counter
from pathlib import Path

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import (
    AnnotatedImage,
    Instance,
    counted_clip,
)
from maniskill_tomato.segmentation.datasets.picture_files import LARGEST_PICTURE, read_picture
from maniskill_tomato.segmentation.masks import Box, EncodedMask

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".JPG", ".JPEG", ".PNG", ".BMP")


def find_picture(folder: Path, name: str, places: tuple[str, ...]) -> Path | None:
    """The file of a picture.

    Args:
        folder: Of the data set.
        name: As the annotation gives it; only its last part counts, so that no annotation points out of its data set.
            Without an ending any of `IMAGE_SUFFIXES` will do.
        places: Folders in the data set's to look in.
    """
    wanted = Path(name.replace("\\", "/")).name
    names = [wanted] if Path(wanted).suffix.lower() in (".jpg", ".jpeg", ".png", ".bmp") else []
    names += [wanted + suffix for suffix in IMAGE_SUFFIXES] if wanted else []
    for place in places:
        for candidate in names:
            if (folder / place / candidate).is_file():
                return folder / place / candidate
    return None


def picture_size(path: Path, given: object = None) -> tuple[int, int]:
    """Width and height of a picture in [px].

    Args:
        path: Its file, which is read if the annotation gives no usable size.
        given: Width and height as the annotation has them.

    Raises:
        InvalidInputError: It cannot be read, or has more than `LARGEST_PICTURE` pixels.
    """
    try:
        width, height = (int(float(side)) for side in given)  # type: ignore[attr-defined]
    except (TypeError, ValueError, OverflowError):
        width = height = 0
    if width < 1 or height < 1:
        try:
            height, width = read_picture(path).shape[:2]
        except InvalidInputError:
            raise InvalidInputError("images that cannot be read") from None
    if width * height > LARGEST_PICTURE:
        raise InvalidInputError(f"images of more than {LARGEST_PICTURE} pixels")
    return width, height


def outlined(
    category: str, outline: list[float], width: int, height: int, skipped: Counter[str]
) -> Instance | None:
    """A thing from its outline, with a mask; None, counted in `skipped`, where it is no polygon inside the image.

    Args:
        category: What it is.
        outline: Corners x, y, x, y, ... in [px].
        width: Of the image, in [px].
        height: Of the image, in [px].
        skipped: What is left out, by reason.
    """
    try:
        mask = EncodedMask.from_coco([outline], height, width)
    except InvalidInputError:
        skipped["annotations with broken polygons or masks"] += 1
        return None
    box = counted_clip(mask.box_xywh, width, height, skipped)
    return None if box is None else Instance(category=category, box_xywh=box, visible_mask=mask)


def boxed(category: str, box: Box, width: int, height: int, skipped: Counter[str]) -> Instance | None:
    """A thing from its box, cut to the image; None, counted in `skipped`, where nothing of it is inside."""
    clipped = counted_clip(box, width, height, skipped)
    return None if clipped is None else Instance(category=category, box_xywh=clipped)


def annotated(
    folder: Path, path: Path, size: tuple[int, int], found: list[Instance | None]
) -> AnnotatedImage:
    """A picture with what was found in it."""
    return AnnotatedImage(
        path=path,
        file_name=path.relative_to(folder).as_posix(),
        width=size[0],
        height=size[1],
        instances=tuple(thing for thing in found if thing is not None),
    )
