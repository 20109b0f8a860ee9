"""Pascal VOC: one XML file of boxes for each image.

Boxes are read and written as today's tools do: (xmin, ymin) is the first pixel and (xmax, ymax) the end, counted from
0. The challenge itself counted from 1 and included the last pixel, which shifts a box by a pixel at most.
"""

import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.segmentation.datasets.annotations import (
    AnnotatedImage,
    AnnotatedImages,
    Instance,
    counted_clip,
    leaves_image,
)
from maniskill_tomato.segmentation.datasets.pictures_of_folder import find_picture, picture_size

IMAGE_FOLDERS = ("JPEGImages", "images", ".")
ANNOTATION_FOLDERS = ("Annotations", "annotations", ".")


def find_voc_folder(folder: Path) -> Path | None:
    """The folder with the XML files in a data set's folder; None if there is none."""
    for name in ANNOTATION_FOLDERS:
        candidate = folder / name
        if candidate.is_dir() and next(candidate.glob("*.xml"), None) is not None:
            return candidate
    return None


def read_voc(folder: Path | str, split: str | None = None) -> AnnotatedImages:
    """Reads a folder in Pascal VOC's format.

    An image without its file, or whose XML is broken, is left out and counted; so is a box outside its image or with
    broken numbers. Boxes that leave the image are clipped and counted.

    Args:
        folder: Holds `Annotations` (or `annotations`) with XML files and `JPEGImages` (or `images`).
        split: Name of a list of images: `SPLIT.txt` in the folder or in `ImageSets/Main`. All by default.

    Raises:
        InvalidInputError: There is no annotation, or no such list.
    """
    folder = Path(folder)
    annotations = find_voc_folder(folder)
    if annotations is None:
        raise InvalidInputError(f"there are no Pascal VOC annotations (*.xml) in {folder}")
    names = sorted(p.stem for p in annotations.glob("*.xml")) if split is None else _listed(folder, split)
    skipped: Counter[str] = Counter()
    images = []
    for name in names:
        try:
            image = _read_image(folder, annotations / f"{name}.xml", skipped)
        except InvalidInputError as error:
            skipped[str(error)] += 1
            continue
        images.append(image)
    return AnnotatedImages(images=tuple(images), skipped=dict(skipped))


def write_voc(images: AnnotatedImages, folder: Path | str) -> None:
    """Writes `Annotations/NAME.xml` for every image, with the boxes of its visible instances.

    Args:
        images: What to write; the names of their files decide those of the XML files.
        folder: Where; the images themselves are not copied.

    Raises:
        InvalidInputError: Two images would share an XML file.
        CheckpointError: A file cannot be written.
    """
    stems = Counter(Path(image.file_name).stem for image in images.images)
    if doubled := [stem for stem, count in stems.items() if count > 1]:
        raise InvalidInputError(f"several images are called {doubled[0]}; Pascal VOC needs one name each")
    for image in images.images:
        path = Path(folder) / "Annotations" / f"{Path(image.file_name).stem}.xml"
        write_atomically(path, voc_xml(image))


def voc_xml(image: AnnotatedImage) -> bytes:
    """The XML of one image."""
    root = ElementTree.Element("annotation")
    _text(root, "folder", str(Path(image.file_name).parent))
    _text(root, "filename", Path(image.file_name).name)
    size = ElementTree.SubElement(root, "size")
    for key, value in (("width", image.width), ("height", image.height), ("depth", 3)):
        _text(size, key, str(value))
    _text(root, "segmented", "0")
    for instance in image.instances:
        x, y, w, h = instance.box_xywh
        if w <= 0 or h <= 0:
            continue
        whole = instance.amodal_box_xywh
        thing = ElementTree.SubElement(root, "object")
        _text(thing, "name", instance.category)
        _text(thing, "pose", "Unspecified")
        _text(
            thing, "truncated", str(int(whole is not None and leaves_image(whole, image.width, image.height)))
        )
        hidden = instance.visible_fraction is not None and instance.visible_fraction < 0.95
        _text(thing, "occluded", str(int(hidden)))
        _text(thing, "difficult", "0")
        box = ElementTree.SubElement(thing, "bndbox")
        for key, corner in (("xmin", x), ("ymin", y), ("xmax", x + w), ("ymax", y + h)):
            _text(box, key, f"{corner:g}")
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8"))


def _text(parent: ElementTree.Element, tag: str, text: str) -> None:
    ElementTree.SubElement(parent, tag).text = text


def _listed(folder: Path, split: str) -> list[str]:
    candidates = [folder / f"{split}.txt", folder / "ImageSets" / "Main" / f"{split}.txt"]
    for path in candidates:
        if path.is_file():
            # The challenge's lists for one category have a second column, 1 or -1.
            return [line.split()[0] for line in path.read_text().splitlines() if line.strip()]
    raise InvalidInputError(
        f"there is no list {split}.txt in {folder} or its ImageSets/Main; leave the split out for all"
    )


def _read_image(folder: Path, path: Path, skipped: Counter[str]) -> AnnotatedImage:
    try:
        root = ElementTree.parse(path).getroot()
    except FileNotFoundError:
        raise InvalidInputError("images listed without an XML file") from None
    except (ElementTree.ParseError, OSError, ValueError, LookupError):
        # An encoding that Python does not know, or that the parser does not take, is the last two.
        raise InvalidInputError("images with broken XML") from None
    name = root.findtext("filename") or ""
    picture = find_picture(folder, name, IMAGE_FOLDERS) or find_picture(folder, path.stem, IMAGE_FOLDERS)
    if picture is None:
        raise InvalidInputError("images without their file")
    width, height = picture_size(picture, [root.findtext(f"size/{key}") or 0 for key in ("width", "height")])
    instances = []
    for thing in root.iter("object"):
        category = (thing.findtext("name") or "").strip()
        try:
            corners = [
                float(thing.findtext(f"bndbox/{key}") or "") for key in ("xmin", "ymin", "xmax", "ymax")
            ]
        except ValueError:
            skipped["boxes with broken numbers"] += 1
            continue
        given = (corners[0], corners[1], corners[2] - corners[0], corners[3] - corners[1])
        if not category:
            skipped["boxes without a name"] += 1
        elif (box := counted_clip(given, width, height, skipped)) is not None:
            instances.append(Instance(category=category, box_xywh=box))
    return AnnotatedImage(
        path=picture,
        file_name=picture.relative_to(folder).as_posix(),
        width=width,
        height=height,
        instances=tuple(instances),
    )
