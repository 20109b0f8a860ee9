"""Rows that the twin inspects, beside the truth."""

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from maniskill_tomato.deploy.mock.episode import load_episode
from maniskill_tomato.experiments.configs import TwinConfig
from maniskill_tomato.experiments.twin_inspection import inspect_twin, summarise_rows
from maniskill_tomato.sensing.inspection_judge import JudgedFruit

PROFILE = """
[arm]
driver = "mock"
[camera]
driver = "mock"
[twin]
episodes = "validation"
width = 212
height = 160
faults = { camera = "unplugged", camera_from_read = 9 }
[perception]
segmenter = "ground_truth"
"""


def fruit(number: int, fraction: float, is_ripe: bool = True) -> dict[str, Any]:
    return asdict(
        JudgedFruit(
            fruit=number,
            is_ripe=True,
            is_truly_ripe=is_ripe,
            is_fully_seen=True,
            true_fraction=fraction,
            position_error_m=0.001,
            radius_error_m=0.0,
        )
    )


def row(listed: list[dict[str, Any]], in_reach: list[int], seeable: list[int], moves: int) -> dict[str, Any]:
    return {
        "reason": "success",
        "moves": moves,
        "refused_moves": 1,
        "listed": listed,
        "in_reach": in_reach,
        "seeable": seeable,
        "cpu_seconds": 3.0,
        "device_seconds": 10.0,
    }


def test_rows_are_counted_together_and_what_was_seen_can_be_seen() -> None:
    found = summarise_rows(
        [
            # Fruit 3 was seen though no sample sees it; fruit 9 is out of reach; fruit 1 was called full and is not.
            row([fruit(0, 0.9), fruit(1, 0.7), fruit(3, 0.85), fruit(9, 0.9)], [0, 1, 2, 3], [0, 1, 2], 30),
            row([fruit(0, 0.9), fruit(5, 0.9, is_ripe=False)], [0, 1], [0], 10),
        ],
        0.8,
    )
    assert (found["seeable"], found["seen"], found["recall"]) == (5, 3, pytest.approx(3 / 5))
    assert (found["listed_as_ripe"], found["right"], found["precision"]) == (6, 5, pytest.approx(5 / 6))
    assert found["full_precision"] == pytest.approx(4 / 6) and found["mean_moves"] == 20.0
    assert found["refused_share_of_moves"] == pytest.approx(2 / 40) and found["reasons"] == {"success": 2}
    low, high = found["recall_interval_95"]
    assert (low, high) == (pytest.approx(0.5), pytest.approx(1.0)), "the rows' own recalls are 1/2 and 1"


def test_a_row_without_a_list_counts_its_fruits_as_missed() -> None:
    cannot = {"reason": "cannot begin", "moves": 0, "refused_moves": 0, "listed": []}
    found = summarise_rows([{**cannot, "in_reach": [0, 1], "seeable": [1]}], 0.8)
    assert (found["seeable"], found["recall"], found["precision"]) == (1, 0.0, None)
    assert found["precision_interval_95"] is None and found["cpu_seconds_a_row"] is None
    json.dumps(found, allow_nan=False)


def test_a_row_is_inspected_once_and_judged_by_what_stands_there(tmp_path: Path) -> None:
    profile = tmp_path / "mine.toml"
    profile.write_text(PROFILE)
    config = TwinConfig(profile=str(profile), inspect=True, seed=1, episodes=1, out=tmp_path / "out")
    lines: list[str] = []
    found = inspect_twin(config, lines.append)
    told = json.loads((tmp_path / "out" / "row_001" / "inspection.json").read_text())
    ripe = [f for f in told["fruits"] if f["ripeness"] == "ripe"]
    full = {f["true_fruit"] for f in ripe if f["fully_seen"] and f["true_visible_fraction"] > 0.8}
    plant = load_episode("validation", 1).plant
    assert found["listed_as_ripe"] == len(ripe) >= 3 and found["seen"] == told["true_fully_seen"] >= 1
    assert all(plant.fruits[number].ripeness == "ripe" for number in full)
    assert found["seen"] <= found["seeable"] <= told["true_ripe_in_reach"]
    assert found["recall"] == pytest.approx(found["seen"] / found["seeable"]) and found["recall"] < 1.0
    assert found["reasons"] == {told["reason"]: 1} and told["is_fault"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert f"{found['seen']} of {found['seeable']} seeable fruits seen; {told['reason']}" in page
    text = re.sub("<[^>]+>", "", page)
    assert "maniskill-tomato deploy inspect" in text and "--seed 1 --out runs/again-1" in text
    assert len(lines) == 1 and f"{found['seen']} of {found['seeable']}" in lines[0]
    assert json.loads((tmp_path / "out" / "rows.json").read_text())["recall"] == found["recall"]
    assert inspect_twin(config, lines.append)["recall"] == found["recall"] and len(lines) == 1
