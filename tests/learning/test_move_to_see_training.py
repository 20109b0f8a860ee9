"""The command that trains the network of `deep_3dmts`: views of training plants to a file that the planner opens."""

import re
from pathlib import Path

import pytest
import torch

from maniskill_tomato.cli import main
from maniskill_tomato.learning.imitation.move_to_see_training import collect_views
from maniskill_tomato.policies.opening import open_policy


def test_the_command_writes_a_network_that_the_planner_opens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "network.pt"
    main(
        ["train-deep-3dmts", "--out", str(path), "--episodes", "2", "--moves", "4", "--epochs", "2"]
        + ["--batch-size", "2", "--validation-share", "0.3"]
    )
    said = capsys.readouterr().out
    assert len(re.findall(r"^epoch \d: loss \d\.\d+, validation", said, flags=re.M)) == 2
    assert re.search(rf"^policy {path} after \d+ s$", said, flags=re.M)
    assert open_policy(path, env_id="TomatoViewpoint-v1").name == "deep_3dmts"


def test_views_come_with_moves_of_at_most_one_and_are_the_same_for_one_seed() -> None:
    first, again = (collect_views(1, 3, seed=5) for _ in range(2))
    assert first.pictures.shape[0] == len(first.distance) == len(first.moves) <= 3
    assert bool((first.moves.norm(dim=-1) <= 1.0 + 1e-6).all())
    torch.testing.assert_close(first.pictures, again.pictures)
    torch.testing.assert_close(first.moves, again.moves)
