"""`maniskill-tomato detect`: the list that it writes, and what it does with files that are no images."""

import json
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco_mask

from maniskill_tomato.assets import asset_path
from maniskill_tomato.cli import main
from maniskill_tomato.segmentation.instances import box_ellipse
from maniskill_tomato.segmentation.light_segmenter import SHIPPED_WEIGHTS, LightSegmenter
from maniskill_tomato.segmentation.segmenter import open_for_files


def write_image(path: Path, *boxes: tuple[int, int, int, int]) -> None:
    """Red ellipses in boxes (left, top, right, bottom) on green."""
    image = np.full((120, 160, 3), (60, 140, 50), np.uint8)
    for box in boxes:
        image[box_ellipse(np.array(box, np.float32), 120, 160)] = (205, 40, 30)
    cv2.imwrite(str(path), image[..., ::-1])


def run(place: Path, out: Path, *more: str) -> list[dict[str, Any]]:
    main(["detect", str(place), "--segmenter", "colour", "--out", str(out), *more])
    return json.loads(out.read_text())  # type: ignore[no-any-return]


def fails(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The message of a command that must end with status 2 and one line."""
    with pytest.raises(SystemExit) as exit_info:
        main(["detect", *argv])
    assert exit_info.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and "Traceback" not in error
    return error


def test_a_folder_gives_one_object_a_fruit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    write_image(photos / "a.png", (20, 30, 60, 70), (90, 40, 140, 100))
    write_image(photos / "b.jpg")
    (photos / "c.jpg").write_bytes(b"no image")
    (photos / "notes.txt").write_text("no image either")
    found = run(photos, tmp_path / "new" / "list.json", "--pictures", str(tmp_path / "drawn"))
    assert len(found) == 2 and {entry["file_name"] for entry in found} == {"a.png"}
    printed = capsys.readouterr().out
    assert "2 tomatoes in 2 images, 1 files skipped" in printed and "c.jpg" in printed
    boxes = sorted(entry["bbox"] for entry in found)
    np.testing.assert_allclose(boxes, [[20, 30, 40, 40], [90, 40, 50, 60]], atol=2)
    for entry in found:
        assert set(entry) == {"file_name", "bbox", "score", "category", "segmentation"}
        assert entry["category"].startswith("tomato") and 0 <= entry["score"] <= 1
        assert isinstance(entry["segmentation"]["counts"], str) and entry["segmentation"]["size"] == [
            120,
            160,
        ]
        mask = coco_mask.decode(entry["segmentation"]).astype(bool)
        x, y, w, h = entry["bbox"]
        ellipse = box_ellipse(np.array([x, y, x + w, y + h], np.float32), 120, 160)
        assert (mask & ellipse).sum() / (mask | ellipse).sum() > 0.9
    assert sorted(p.name for p in (tmp_path / "drawn").iterdir()) == ["a.jpg", "b.jpg"]
    drawn, plain = cv2.imread(str(tmp_path / "drawn" / "a.jpg")), cv2.imread(str(photos / "a.png"))
    assert drawn is not None and plain is not None and not np.array_equal(drawn, plain)


def test_an_image_without_fruit_gives_an_empty_list(tmp_path: Path) -> None:
    write_image(tmp_path / "leaf.png")
    assert run(tmp_path / "leaf.png", tmp_path / "list.json") == []


def test_grey_and_transparent_and_deep_images_are_read(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", (20, 30, 60, 70))
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None
    cv2.imwrite(str(tmp_path / "b.png"), np.dstack([image, np.full((120, 160), 9, np.uint8)]))
    cv2.imwrite(str(tmp_path / "c.png"), image.astype(np.uint16) * 257)
    cv2.imwrite(str(tmp_path / "d.png"), image[..., 0])
    found = run(tmp_path, tmp_path / "list.json")
    assert [entry["file_name"] for entry in found] == ["a.png", "b.png", "c.png"]


def test_what_cannot_be_done_is_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    for name in ("a.png", "b.jpg"):
        (tmp_path / "broken" / name).write_bytes(b"")
    write_image(tmp_path / "good.png", (20, 30, 60, 70))
    out, colour = str(tmp_path / "list.json"), ("--segmenter", "colour")
    assert "no image or folder" in fails(capsys, str(tmp_path / "nowhere"), "--out", out, *colour)
    assert "holds no image" in fails(capsys, str(tmp_path / "empty"), "--out", out, *colour)
    assert "none of the 2 files" in fails(capsys, str(tmp_path / "broken"), "--out", out, *colour)
    assert "cannot be read" in fails(capsys, str(tmp_path / "broken" / "a.png"), "--out", out, *colour)
    good = str(tmp_path / "good.png")
    assert "must be a file" in fails(capsys, good, "--out", str(tmp_path), *colour)
    assert "no weights" in fails(capsys, good, "--out", out, "--segmenter", str(tmp_path / "gone.pt"))
    assert "must be one of" in fails(capsys, good, "--out", out, "--segmenter", "eye")
    assert "rendered views" in fails(capsys, good, "--out", out, "--segmenter", "ground_truth")
    assert "between 0 and 1" in fails(capsys, good, "--out", out, "--score-threshold", "7")
    assert not (tmp_path / "list.json").exists()


def test_an_older_list_stays_when_the_new_one_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "list.json"
    out.write_text("[]")
    (tmp_path / "broken.png").write_bytes(b"")
    fails(capsys, str(tmp_path / "broken.png"), "--out", str(out), "--segmenter", "colour")
    assert out.read_text() == "[]" and sorted(p.name for p in tmp_path.iterdir()) == [
        "broken.png",
        "list.json",
    ]


def test_the_light_segmenter_looks_thoroughly_at_files_unless_there_is_a_hurry() -> None:
    thorough = open_for_files("light", 0.2, thorough=True)
    quick = open_for_files("light", 0.2, thorough=False)
    assert isinstance(thorough, LightSegmenter) and isinstance(quick, LightSegmenter)
    assert thorough.mirrored and len(thorough.scales) > len(quick.scales) and not quick.mirrored
    assert thorough.score_threshold == quick.score_threshold == 0.2
    by_file = open_for_files(str(asset_path(SHIPPED_WEIGHTS)), 0.2, thorough=True)
    assert isinstance(by_file, LightSegmenter) and by_file.mirrored
    assert not isinstance(open_for_files("colour", 0.2, thorough=True), LightSegmenter)


def test_no_drawing_takes_the_place_of_an_image_or_of_another_drawing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    write_image(photos / "a.png", (20, 30, 60, 70))
    write_image(photos / "a.jpg", (20, 30, 60, 70))
    before = {path.name: path.read_bytes() for path in photos.iterdir()}
    out = tmp_path / "list.json"
    run(photos, out, "--pictures", str(tmp_path / "drawn"))
    assert {path.name for path in (tmp_path / "drawn").iterdir()} == {"a.png.jpg", "a.jpg.jpg"}
    (photos / "a.png").unlink()
    error = fails(capsys, str(photos), "--segmenter", "colour", "--pictures", str(photos), "--out", str(out))
    assert "a.jpg would take the place" in error
    error = fails(capsys, str(photos), "--segmenter", "colour", "--out", str(photos / "a.jpg"))
    assert "must be a file such as detections.json" in error
    assert (photos / "a.jpg").read_bytes() == before["a.jpg"]


def test_the_list_takes_the_place_of_nothing_that_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_image(tmp_path / "a.png", (20, 30, 60, 70))
    photo = (tmp_path / "a.png").rename(tmp_path / "photo.raw")
    weights = tmp_path / "weights.pt"
    weights.write_bytes(asset_path(SHIPPED_WEIGHTS).read_bytes())
    link = tmp_path / "list.json"
    link.symlink_to("photo.raw")
    before = photo.read_bytes(), weights.read_bytes()
    (tmp_path / "b").mkdir()
    for out, segmenter in (
        (photo, "colour"),
        (link, "colour"),
        (tmp_path / "b" / ".." / "photo.raw", "colour"),
        (weights, str(weights)),
    ):
        error = fails(capsys, str(photo), "--segmenter", segmenter, "--out", str(out))
        assert "would take the place of what is read" in error
    assert (photo.read_bytes(), weights.read_bytes()) == before and link.is_symlink()


def test_pictures_that_are_cut_off_or_too_large_are_said_to_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    write_image(photos / "good.jpg", (20, 30, 60, 70))
    whole = (photos / "good.jpg").read_bytes()
    (photos / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    size = (40_000).to_bytes(4, "big") * 2 + bytes([8, 2, 0, 0, 0])
    chunks = [
        len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")
        for kind, data in ((b"IHDR", size), (b"IDAT", bytes(50)))
    ]
    (photos / "large.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    assert len(run(photos, tmp_path / "list.json")) == 1
    printed = capsys.readouterr().out
    assert "cut.jpg is a JPEG that ends too early" in printed
    assert "large.png has more than 178000000 pixels, which are allowed" in printed
