"""YOLO's text files, LabelMe and CVAT: what their tools write is read as COCO's is, and broken parts are counted."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImages
from maniskill_tomato.segmentation.datasets.coco import read_coco
from maniskill_tomato.segmentation.datasets.reading import read_annotated, read_place

pytest.importorskip("pycocotools")

WIDTH, HEIGHT = 80, 60
BOX = (12.0, 9.0, 20.0, 15.0)
OUTLINE = [40.0, 20.0, 60.0, 20.0, 60.0, 40.0, 40.0, 40.0]


def picture(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))


@pytest.fixture
def as_coco(tmp_path: Path) -> AnnotatedImages:
    """A box and an outline in one image, as COCO's reader has them."""
    folder = tmp_path / "coco"
    picture(folder / "images" / "a.png")
    entries = [
        {"id": 1, "image_id": 1, "category_id": 1, "bbox": list(BOX)},
        {"id": 2, "image_id": 1, "category_id": 2, "segmentation": [OUTLINE]},
    ]
    content = {
        "images": [{"id": 1, "file_name": "images/a.png", "width": WIDTH, "height": HEIGHT}],
        "annotations": entries,
        "categories": [{"id": 1, "name": "tomato"}, {"id": 2, "name": "tomato_unripe"}],
    }
    (folder / "annotations.json").write_text(json.dumps(content))
    return read_coco(folder)


def assert_same(found: AnnotatedImages, wanted: AnnotatedImages) -> None:
    """The same things at the same places, boxes to a hundredth of a pixel and masks to the pixel."""
    assert [(i.width, i.height) for i in found.images] == [(i.width, i.height) for i in wanted.images]
    for one, other in zip(found.images, wanted.images, strict=True):
        assert [i.category for i in one.instances] == [i.category for i in other.instances]
        for a, b in zip(one.instances, other.instances, strict=True):
            np.testing.assert_allclose(a.box_xywh, b.box_xywh, atol=0.01)
            assert (a.visible_mask is None) == (b.visible_mask is None)
            if a.visible_mask is not None and b.visible_mask is not None:
                np.testing.assert_array_equal(a.visible_mask.decode(), b.visible_mask.decode())
        assert one.load().shape == (HEIGHT, WIDTH, 3)


def yolo_lines() -> str:
    x, y, w, h = BOX
    box = ((x + w / 2) / WIDTH, (y + h / 2) / HEIGHT, w / WIDTH, h / HEIGHT)
    outline = [value / (HEIGHT if k % 2 else WIDTH) for k, value in enumerate(OUTLINE)]
    lines = [(0, *box), (1, *outline)]
    return "".join(" ".join(str(round(v, 6)) for v in line) + "\n" for line in lines)


@pytest.mark.parametrize(
    ("names", "images", "labels"),
    [
        ("data.yaml", "images/train/a.png", "labels/train/a.txt"),
        ("data.yaml", "train/images/a.png", "train/labels/a.txt"),
        ("classes.txt", "images/a.png", "labels/a.txt"),
        ("classes.txt", "a.png", "a.txt"),
    ],
)
def test_yolo_labels_are_read_in_every_usual_layout(
    tmp_path: Path, as_coco: AnnotatedImages, names: str, images: str, labels: str
) -> None:
    folder = tmp_path / "yolo"
    picture(folder / images)
    (folder / labels).parent.mkdir(parents=True, exist_ok=True)
    (folder / labels).write_text(yolo_lines())
    yaml = "path: .\ntrain: images/train\nnames:\n  0: tomato\n  1: 'tomato_unripe'  # green\nnc: 2\n"
    (folder / names).write_text(yaml if names == "data.yaml" else "tomato\ntomato_unripe\n")
    assert_same(read_annotated(folder), as_coco)
    if "train" in labels:
        assert_same(read_place(f"{folder}:train"), as_coco)
        with pytest.raises(InvalidInputError, match="no YOLO labels of 'val'"):
            read_place(f"{folder}:val")
    if names == "data.yaml":
        (folder / names).write_text("names: [tomato, tomato_unripe]\n")
        assert_same(read_annotated(folder), as_coco)
        (folder / names).write_text("names: 3\n")
        with pytest.raises(InvalidInputError, match="must name the classes"):
            read_annotated(folder)


def test_broken_yolo_lines_are_counted(tmp_path: Path) -> None:
    picture(tmp_path / "images" / "a.png")
    (tmp_path / "labels").mkdir()
    lines = [
        "0 0.5 0.5 0.2 0.2",
        "7 0.5 0.5 0.2 0.2",
        "0 half 0.5 0.2 0.2",
        "0 0.5 nan 0.2 0.2",
        "0 2 2 0.1 0.1",
    ]
    (tmp_path / "labels" / "a.txt").write_text("\n".join([*lines, "0 0.1 0.2 0.3"]))
    (tmp_path / "labels" / "gone.txt").write_text("0 0.5 0.5 0.2 0.2")
    (tmp_path / "classes.txt").write_text("tomato\n")
    found = read_annotated(tmp_path)
    assert [len(image.instances) for image in found.images] == [1]
    assert found.skipped == {
        "lines with broken numbers or unknown classes": 2,
        "boxes that are empty or outside the image": 2,
        "annotations with broken polygons or masks": 1,
        "images without their file": 1,
    }


def labelme(shapes: list[dict[str, Any]], name: str = "a.png") -> str:
    return json.dumps(
        {"version": "5.4", "shapes": shapes, "imagePath": name, "imageWidth": WIDTH, "imageHeight": HEIGHT}
    )


def test_labelme_files_are_read(tmp_path: Path, as_coco: AnnotatedImages) -> None:
    folder = tmp_path / "labelme"
    picture(folder / "a.png")
    x, y, w, h = BOX
    shapes = [
        # A rectangle that was drawn from its lower right corner.
        {"label": "tomato", "shape_type": "rectangle", "points": [[x + w, y + h], [x, y]]},
        {
            "label": "tomato_unripe",
            "shape_type": "polygon",
            "points": np.reshape(OUTLINE, (-1, 2)).tolist(),
        },
    ]
    (folder / "a.json").write_text(labelme(shapes, "..\\elsewhere\\a.png"))
    assert_same(read_annotated(folder), as_coco)
    (folder / "few.txt").write_text("b.png\n")
    assert read_place(f"{folder}:few").images == ()
    circle = {"label": "tomato", "shape_type": "circle", "points": [[40, 30], [40, 40]]}
    line = {"label": "tomato", "shape_type": "line", "points": [[1, 2], [3, 4]]}
    broken = {"label": "tomato", "shape_type": "polygon", "points": [[1, "two"]]}
    (folder / "a.json").write_text(labelme([circle, line, broken]))
    found = read_annotated(folder)
    (fruit,) = found.images[0].instances
    assert fruit.visible_mask is not None and abs(fruit.visible_mask.area - np.pi * 10**2) < 10
    assert found.skipped == {
        "shapes of the kind line": 1,
        "shapes without a name or with broken numbers": 1,
    }


def test_an_export_of_cvat_is_read(tmp_path: Path, as_coco: AnnotatedImages) -> None:
    folder = tmp_path / "cvat"
    picture(folder / "images" / "a.png")
    x, y, w, h = BOX
    points = ";".join(f"{a},{b}" for a, b in np.reshape(OUTLINE, (-1, 2)))
    box = f'<box label="tomato" xtl="{x}" ytl="{y}" xbr="{x + w}" ybr="{y + h}" occluded="0"/>'
    head = f'<image id="0" name="deep/a.png" subset="train" width="{WIDTH}" height="{HEIGHT}">'

    def write(shapes: str) -> None:
        text = f"<annotations><version>1.1</version><meta/>{head}{shapes}</image></annotations>"
        (folder / "annotations.xml").write_text(text)

    write(f'{box}<polygon label="tomato_unripe" points="{points}"/>')
    assert_same(read_annotated(folder), as_coco)
    assert_same(read_place(f"{folder}:train"), as_coco)
    with pytest.raises(InvalidInputError, match="must be one of 'train'; got 'val'"):
        read_place(f"{folder}:val")
    # The outline's square as a mask: 5 px of background, 20 rows of 20 px in a box of 30 px.
    runs = [5, 20, *[10, 20] * 19, 5]
    mask = '<mask label="tomato_unripe" left="35" top="20" width="30" height="20" rle="{}"/>'
    write(box + mask.format(", ".join(map(str, runs))))
    assert_same(read_annotated(folder), as_coco)
    write(mask.format("5, 20") + '<points label="tomato" points="1,2"/><box label="tomato" xtl="one"/>')
    assert read_annotated(folder).skipped == {
        "annotations with broken polygons or masks": 1,
        "shapes of the kind points": 1,
        "shapes without a name or with broken numbers": 1,
    }


def test_a_folder_of_no_known_format_says_which_there_are(tmp_path: Path) -> None:
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(InvalidInputError, match=r"COCO file.*VOC.*CVAT.*LabelMe.*YOLO"):
        read_annotated(tmp_path)
