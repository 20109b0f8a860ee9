"""JSON and TOML of strangers: values, or one error that says what is wrong."""

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.profile import parse_profile
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.coco import read_coco
from maniskill_tomato.segmentation.datasets.voc import read_voc
from maniskill_tomato.text_files import DEEPEST, parse_json, parse_toml, read_json, read_toml

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text(),
    lambda below: st.lists(below, max_size=4) | st.dictionaries(st.text(), below, max_size=4),
    max_leaves=20,
)


@settings(max_examples=50, deadline=None)
@given(VALUES)
def test_honest_json_comes_back(value: Any) -> None:
    assert parse_json(json.dumps(value)) == value


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.text(max_size=60) | st.text(alphabet='[]{}",:=0123456789eE-.\n ', max_size=60))
def test_any_text_is_a_value_or_one_error(text: str) -> None:
    for parse in (parse_json, parse_toml):
        with contextlib.suppress(InvalidInputError):
            parse(text)


@pytest.mark.parametrize("deep", [DEEPEST + 2, 500, 100_000])
def test_deep_nesting_is_refused(deep: int) -> None:
    with pytest.raises(InvalidInputError, match="nested more than 64 deep"):
        parse_json("[" * deep + "]" * deep)
    with pytest.raises(InvalidInputError, match="nested more than 64 deep"):
        parse_toml("a = " + "[" * min(deep, 2000) + "]" * min(deep, 2000))
    inside = "[" * DEEPEST + "]" * DEEPEST
    assert parse_json(inside) == json.loads(inside)


@pytest.mark.parametrize("digits", [20, 400, 5000])
def test_long_integers_are_refused(digits: int) -> None:
    for parse, text in ((parse_json, '{"a": %s}'), (parse_toml, "a = %s")):
        with pytest.raises(InvalidInputError, match="digits"):
            parse(text % ("9" * digits))
    with pytest.raises(ProfileError, match="digits"):
        parse_profile("[loop]\nmax_moves = " + "9" * digits, Path("mine.toml"))


@pytest.mark.timeout(60)
@pytest.mark.parametrize("parse", [parse_json, parse_toml])
def test_a_key_that_stands_twice_in_a_table_is_refused(parse: Callable[[str], Any]) -> None:
    twice = '{"a": {"rms_px": 500, "b": 1, "rms_px": 0.1}}' if parse is parse_json else "[a]\nb = 1\nb = 2\n"
    with pytest.raises(InvalidInputError, match="twice|overwrite"):
        parse(twice)
    once = '[{"a": 1}, {"a": 1}]' if parse is parse_json else "[[a]]\nb = 1\n[[a]]\nb = 2\n"
    assert len(list(parse(once))) >= 1


def test_a_device_that_never_ends_and_a_pipe_in_which_nobody_writes_are_no_files(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    for path in (Path("/dev/zero"), pipe):
        for read in (read_json, read_toml):
            with pytest.raises(InvalidInputError, match="it is no file"):
                read(path)


def test_what_is_no_text_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"\xff\xfe{}")
    for read in (read_json, read_toml):
        with pytest.raises(InvalidInputError, match="a.json cannot be read as"):
            read(path)
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "missing")


@pytest.mark.parametrize(
    ("xml", "reason"),
    [
        ('<?xml version="1.0" encoding="x-none"?><annotation/>', "broken XML"),
        ('<?xml version="1.0" encoding="utf-7"?><annotation/>', "broken XML"),
        ("<annotation><size><width>inf</width><height>480</height></size></annotation>", "cannot be read"),
        ("<annotation><size><width>1e9</width><height>1e9</height></size></annotation>", "more than"),
    ],
)
def test_hostile_voc_files_are_left_out_with_their_reason(xml: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "Annotations").mkdir()
    (tmp_path / "Annotations" / "a.xml").write_text(xml)
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff cut off")
    found = read_voc(tmp_path)
    assert not found.images and any(reason in why for why in found.skipped), found.skipped


def test_a_coco_mask_of_ten_thousand_million_pixels_is_left_out(tmp_path: Path) -> None:
    side = 100_000
    mask = {"size": [side, side], "counts": [side * side // 2, side * side // 2]}
    (tmp_path / "a.jpg").write_bytes(b"")
    content = {
        "images": [{"id": 1, "file_name": "a.jpg", "width": side, "height": side}],
        "categories": [{"id": 1, "name": "tomato"}],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 1, "bbox": [0, 0, 9, 9], "segmentation": mask}
        ],
    }
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps(content))
    found = read_coco(path)
    assert not found.images and any("pixels" in why for why in found.skipped)
