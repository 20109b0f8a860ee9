"""COCO and Pascal VOC, whole and broken."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import (
    AnnotatedImage,
    AnnotatedImages,
    CameraView,
    Instance,
    clip_box,
    is_fruit,
    joined,
)
from maniskill_tomato.segmentation.datasets.coco import read_coco, write_coco
from maniskill_tomato.segmentation.datasets.composition import copied
from maniskill_tomato.segmentation.datasets.reading import read_annotated
from maniskill_tomato.segmentation.datasets.voc import read_voc, write_voc
from maniskill_tomato.segmentation.masks import EncodedMask

pytest.importorskip("pycocotools")


def disc(height: int, width: int, x: float, y: float, radius: float) -> np.ndarray[Any, Any]:
    rows, columns = np.mgrid[:height, :width]
    return np.asarray((columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2 < radius**2)


def write_picture(path: Path, height: int = 40, width: int = 60) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((height, width, 3), 90, np.uint8))
    return path


def make_set(folder: Path) -> AnnotatedImages:
    whole = disc(40, 60, 30, 20, 9)
    seen = whole.copy()
    seen[:20] = False
    visible = EncodedMask.encode(seen)
    fruit = Instance(
        category="tomato_ripe",
        box_xywh=visible.box_xywh,
        visible_mask=visible,
        amodal_mask=EncodedMask.encode(whole),
        amodal_box_xywh=(21.0, 11.0, 18.0, 18.0),
        visible_fraction=seen.sum() / whole.sum(),
        name="fruit_03",
    )
    hidden = Instance(
        category="tomato_unripe",
        box_xywh=(0.0, 0.0, 0.0, 0.0),
        amodal_mask=EncodedMask.encode(disc(40, 60, 50, 30, 5)),
        amodal_box_xywh=(45.0, 25.0, 10.0, 10.0),
        visible_fraction=0.0,
    )
    boxed = Instance(category="leaf", box_xywh=(1.0, 2.0, 10.0, 12.0))
    camera = CameraView(T_world_optical=np.eye(4), matrix=np.diag([500.0, 500.0, 1.0]))
    depth = folder / "depth" / "a.png"
    depth.parent.mkdir(parents=True)
    cv2.imwrite(str(depth), np.full((40, 60), 812, np.uint16))
    image = AnnotatedImage(
        path=write_picture(folder / "images" / "a.jpg"),
        file_name="images/a.jpg",
        width=60,
        height=40,
        instances=(fruit, boxed, hidden),
        depth_path=depth,
        camera=camera,
    )
    return AnnotatedImages(images=(image,))


def test_photos_of_one_name_from_several_folders_are_all_copied_in(tmp_path: Path) -> None:
    photos = []
    for k, name in enumerate(("a/1.jpg", "b/1.jpg", "b/1.png")):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes([k]) * 10)
        photos.append(AnnotatedImage(path=path, file_name=name, width=60, height=40, instances=()))
    out = tmp_path / "out"
    for _ in range(2):
        copies = copied(AnnotatedImages(images=tuple(photos)), out, "real")
        assert [image.path.read_bytes() for image in copies.images] == [bytes([k]) * 10 for k in range(3)]
        write_voc(copies, out)
    photos[0].path.write_bytes(b"retouched.")
    again = copied(AnnotatedImages(images=tuple(photos)), out, "real")
    assert again.images[0].path.read_bytes() == b"retouched."


def coco_file(folder: Path, **changes: Any) -> Path:
    write_picture(folder / "images" / "a.jpg")
    content: dict[str, Any] = {
        "images": [{"id": 7, "file_name": "a.jpg", "width": 60, "height": 40}],
        "annotations": [
            {
                "id": 1,
                "image_id": 7,
                "category_id": 1,
                "bbox": [5, 6, 10, 8],
                "segmentation": [[5, 6, 15, 6, 15, 14]],
            }
        ],
        "categories": [{"id": 1, "name": "tomato"}],
    }
    (folder / "annotations.json").write_text(json.dumps(content | changes))
    return folder


@pytest.mark.parametrize("seed", range(5))
def test_a_mask_survives_its_encoding(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random((37, 53)) < rng.random()
    coded = EncodedMask.encode(mask)
    assert np.array_equal(coded.decode(), mask)
    assert coded.area == mask.sum()
    again = EncodedMask.from_coco(coded.to_coco(), 37, 53)
    assert again == coded


def test_long_runs_are_decoded_as_pycocotools_does() -> None:
    mask = disc(480, 640, 300, 200, 150) & ~disc(480, 640, 340, 230, 60)
    coded = EncodedMask.encode(mask)
    assert np.array_equal(EncodedMask.from_coco(coded.to_coco(), 480, 640).decode(), mask)
    columns = mask.T.ravel()
    changes = np.flatnonzero(np.diff(columns)) + 1
    runs = np.diff(np.concatenate([[0], changes, [columns.size]])).tolist()
    plain = EncodedMask.from_coco({"size": [480, 640], "counts": runs}, 480, 640)
    assert plain == coded


def test_a_polygon_fills_its_inside() -> None:
    square = EncodedMask.from_coco([[10, 5, 30, 5, 30, 15, 10, 15]], 40, 60).decode()
    expected = np.zeros((40, 60), bool)
    expected[5:15, 10:30] = True
    assert np.array_equal(square, expected)


@pytest.mark.parametrize(
    "segmentation",
    [
        [],
        [[1, 2, 3]],
        [[1, 2, 3, 4, 5, float("nan")]],
        [["a", 2, 3, 4, 5, 6]],
        [7],
        "text",
        None,
        {"size": [40, 60], "counts": "\x7f\x7f"},
        {"size": [40, 60], "counts": "0oo"},
        {"size": [40, 60], "counts": [10, 5]},
        {"size": [40, 60], "counts": [-5, 2405]},
        {"size": [60, 40], "counts": [2400]},
        {"counts": [2400]},
    ],
)
def test_a_broken_segmentation_is_refused(segmentation: object) -> None:
    with pytest.raises(InvalidInputError):
        EncodedMask.from_coco(segmentation, 40, 60)


def test_polygons_far_outside_the_image_end_quickly_and_empty() -> None:
    assert EncodedMask.from_coco([[1e9, 1e9, 2e9, 1e9, 2e9, 2e9]], 40, 60).area == 0


def test_coco_returns_what_was_written(tmp_path: Path) -> None:
    written = make_set(tmp_path)
    visible, amodal = write_coco(written, tmp_path)
    assert visible.name == "annotations.json" and amodal is not None
    read = read_annotated(tmp_path)
    assert not read.skipped
    (image,), (before,) = read.images, written.images
    assert image.load().shape == (40, 60, 3)
    depth = image.load_depth()
    assert depth is not None and np.allclose(depth, 0.812)
    assert image.camera is not None and np.array_equal(image.camera.matrix, np.diag([500.0, 500.0, 1.0]))
    fruit, leaf, hidden = image.instances
    assert fruit.visible_mask == before.instances[0].visible_mask
    assert fruit.amodal_mask == before.instances[0].amodal_mask
    assert fruit.amodal_box_xywh == (21.0, 11.0, 18.0, 18.0) and fruit.name == "fruit_03"
    assert fruit.visible_fraction == pytest.approx(0.5, abs=0.03)
    assert leaf.visible_mask is None and leaf.box_xywh == (1.0, 2.0, 10.0, 12.0)
    assert hidden.box_xywh == (0.0, 0.0, 0.0, 0.0) and hidden.amodal_mask is not None
    assert [i.category for i in image.fruits] == ["tomato_ripe"]


def test_pycocotools_reads_both_files(tmp_path: Path) -> None:
    from pycocotools.coco import COCO

    visible, amodal = write_coco(make_set(tmp_path), tmp_path)
    for path, count in ((visible, 2), (amodal, 2)):
        coco = COCO(str(path))
        entries = coco.loadAnns(coco.getAnnIds())
        assert len(entries) == count
        assert all(coco.annToMask(e).shape == (40, 60) for e in entries)


def test_voc_returns_the_boxes_that_were_written(tmp_path: Path) -> None:
    written = make_set(tmp_path)
    write_voc(written, tmp_path)
    read = read_annotated(tmp_path)
    (image,) = read.images
    assert image.path == tmp_path / "images" / "a.jpg" and (image.width, image.height) == (60, 40)
    assert [(i.category, i.box_xywh) for i in image.instances] == [
        (i.category, i.box_xywh) for i in written.images[0].instances[:2]
    ]


def test_voc_reads_the_images_of_a_list(tmp_path: Path) -> None:
    written = make_set(tmp_path)
    write_voc(written, tmp_path)
    (tmp_path / "val.txt").write_text("a\nmissing\n")
    (tmp_path / "empty.txt").write_text("\n")
    read = read_voc(tmp_path, "val")
    assert len(read.images) == 1 and read.skipped == {"images listed without an XML file": 1}
    assert not read_voc(tmp_path, "empty").images
    with pytest.raises(InvalidInputError, match="no list test.txt"):
        read_voc(tmp_path, "test")


def test_broken_voc_boxes_are_clipped_or_counted(tmp_path: Path) -> None:
    write_picture(tmp_path / "images" / "a.jpg")
    boxes = ["<xmin>50</xmin><ymin>30</ymin><xmax>90</xmax><ymax>80</ymax>"]
    boxes += ["<xmin>200</xmin><ymin>30</ymin><xmax>290</xmax><ymax>80</ymax>"]
    boxes += ["<xmin>20</xmin><ymin>9</ymin><xmax>10</xmax><ymax>12</ymax>"]
    boxes += ["<xmin>x</xmin><ymin>9</ymin><xmax>10</xmax><ymax>12</ymax>", "<xmin>nan</xmin>"]
    things = "".join(f"<object><name>tomato</name><bndbox>{box}</bndbox></object>" for box in boxes)
    (tmp_path / "annotations").mkdir()
    # The size is missing, and the file has another suffix than the XML says.
    (tmp_path / "annotations" / "a.xml").write_text(
        f"<annotation><filename>a.png</filename>{things}</annotation>"
    )
    (tmp_path / "annotations" / "b.xml").write_text("<annotation><filename>b.jpg</filename></annotation>")
    (tmp_path / "annotations" / "c.xml").write_text("<annotation><filen")
    read = read_voc(tmp_path)
    (image,) = read.images
    assert [i.box_xywh for i in image.instances] == [(50.0, 30.0, 10.0, 10.0)]
    assert read.skipped == {
        "boxes clipped to the image": 1,
        "boxes that are empty or outside the image": 2,
        "boxes with broken numbers": 2,
        "images without their file": 1,
        "images with broken XML": 1,
    }
    assert "2 boxes with broken numbers" in read.skipped_text()


def test_voc_files_cannot_point_out_of_their_folder(tmp_path: Path) -> None:
    write_picture(tmp_path / "secret.jpg")
    (tmp_path / "data").mkdir()
    text = "<annotation><filename>../secret.jpg</filename></annotation>"
    (tmp_path / "data" / "a.xml").write_text(text)
    assert not read_voc(tmp_path / "data").images
    coco_file(
        tmp_path / "coco", images=[{"id": 7, "file_name": "../../secret.jpg", "width": 60, "height": 40}]
    )
    assert not read_coco(tmp_path / "coco").images


def test_broken_coco_entries_are_counted(tmp_path: Path) -> None:
    good = {"id": 1, "image_id": 7, "category_id": 1, "bbox": [5, 6, 10, 8]}
    entries: list[Any] = [
        good,
        good | {"id": 2, "segmentation": [[1, 2]]},
        good | {"id": 3, "bbox": [55, 35, 20, 20]},
        good | {"id": 4, "bbox": [500, 35, 20, 20]},
        good | {"id": 5, "bbox": [1, 2, float("inf"), 4]},
        good | {"id": 6, "bbox": "box"},
        good | {"id": 7, "image_id": 99},
        good | {"id": 8, "category_id": [1]},
        good | {"id": 9, "iscrowd": 1},
        "text",
    ]
    images = [
        {"id": 7, "file_name": "a.jpg"},
        {"id": 8, "file_name": "gone.jpg", "width": 9, "height": 9},
        {"file_name": "a.jpg"},
    ]
    read = read_coco(coco_file(tmp_path, annotations=entries, images=images))
    assert [i.box_xywh for i in read.images[0].instances] == [(5.0, 6.0, 10.0, 8.0), (55.0, 35.0, 5.0, 5.0)]
    assert read.skipped == {
        "annotations with broken polygons or masks": 1,
        "boxes clipped to the image": 1,
        "boxes that are empty or outside the image": 3,
        "annotations of unknown images": 2,
        "annotations of unknown categories": 1,
        "crowd annotations": 1,
        "images without their file": 1,
        "images without a name or number": 1,
    }


@pytest.mark.parametrize(
    "text", ["", "[1, 2", "[]", '{"images": 3}', '{"images": [1], "annotations": [], "categories": []}']
)
def test_a_file_that_is_not_coco_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InvalidInputError):
        read_coco(tmp_path / "x.json")
    with pytest.raises(InvalidInputError):
        read_annotated(tmp_path)


def test_missing_places_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="nowhere"):
        read_annotated(tmp_path / "nowhere")
    with pytest.raises(InvalidInputError, match="holds no annotations that are known"):
        read_annotated(tmp_path)


def test_a_picture_of_another_size_than_annotated_is_refused(tmp_path: Path) -> None:
    images = [{"id": 7, "file_name": "a.jpg", "width": 61, "height": 40}]
    (image,) = read_coco(coco_file(tmp_path, images=images)).images
    with pytest.raises(InvalidInputError, match="61 x 40"):
        image.load()
    (tmp_path / "images" / "a.jpg").write_bytes(b"no picture")
    with pytest.raises(InvalidInputError, match="cannot be read"):
        image.load()


def test_sets_are_joined_without_doubled_names(tmp_path: Path) -> None:
    one, other = make_set(tmp_path / "a"), read_coco(coco_file(tmp_path / "b"))
    both = joined([one, other])
    assert len(both.images) == 2 and both.categories == ("tomato_ripe", "tomato_unripe", "leaf", "tomato")
    assert len(both.filtered(lambda image: image.depth_path is not None).images) == 1
    with pytest.raises(InvalidInputError, match="more than once"):
        joined([one, one])


def test_boxes_are_clipped_to_the_image() -> None:
    assert clip_box((-5, -5, 10, 10), 60, 40) == (0.0, 0.0, 5.0, 5.0)
    assert clip_box((59.5, 0, 10, 10), 60, 40) is None
    assert clip_box((0, 0, 0, 10), 60, 40) is None
    assert is_fruit("tomato") and is_fruit("tomato_ripe") and not is_fruit("leaf")
