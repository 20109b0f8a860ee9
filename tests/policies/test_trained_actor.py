"""Trained actors from checkpoints: what is kept, and files that are refused."""

from pathlib import Path
from typing import Any

import pytest
import torch

from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.files import write_tensors
from maniskill_tomato.learning.rl.agent import Agent, make_agent
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.policies.trained_actor import load_actor

ENV_ID = "TomatoViewpointGuided-v1"
BOUNDS = (-torch.ones(6), torch.ones(6))


def saved(path: Path, **changes: Any) -> tuple[Agent, dict[str, Any]]:
    agent = make_agent(get_preset("td3"), 9, 6)
    data = {**make_checkpoint(agent, ENV_ID, BOUNDS, {"steps": 12, "seed": 3}), **changes}
    write_tensors(path, data)
    return agent, data


def test_a_policy_knows_the_options_of_its_task(tmp_path: Path) -> None:
    options = {"plant": {"preset": "full", "seed": "train"}, "plant_pose": (0.8, 0.1, 0.5)}
    agent = make_agent(get_preset("td3"), 9, 6)
    for given, kept in ((options, {**options, "plant_pose": [0.8, 0.1, 0.5]}), ({}, {}), (None, None)):
        write_tensors(tmp_path / "p.pt", make_checkpoint(agent, ENV_ID, BOUNDS, {}, env_options=given))
        assert load_actor(tmp_path / "p.pt").env_options == kept
    saved(tmp_path / "p.pt", env_options="full")
    with pytest.raises(CheckpointError, match="env_options is 'full'"):
        load_actor(tmp_path / "p.pt")


def test_a_policy_refuses_observations_of_another_shape(tmp_path: Path) -> None:
    saved(tmp_path / "p.pt")
    with pytest.raises(InvalidInputError, match=r"shape \(B, 9\), got \(9,\)"):
        load_actor(tmp_path / "p.pt").act(torch.zeros(9))


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no checkpoint at .*nothing\.pt"):
        load_actor(tmp_path / "nothing.pt")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_checkpoint_is_an_error(tmp_path: Path, share: float) -> None:
    path = tmp_path / "p.pt"
    saved(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load_actor(path)


def test_text_and_foreign_files_are_errors(tmp_path: Path) -> None:
    (tmp_path / "text.pt").write_text("hello")
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load_actor(tmp_path / "text.pt")
    torch.save({"weights": torch.zeros(3)}, tmp_path / "foreign.pt")
    with pytest.raises(CheckpointError, match="not a checkpoint of this package"):
        load_actor(tmp_path / "foreign.pt")
    torch.save([1, 2, 3], tmp_path / "list.pt")
    with pytest.raises(CheckpointError, match="not a checkpoint of this package"):
        load_actor(tmp_path / "list.pt")


def test_code_in_a_checkpoint_is_not_run(tmp_path: Path) -> None:
    class Attack:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return (Path.touch, (tmp_path / "pwned",))  # type: ignore[return-value]

    torch.save({"format": Attack()}, tmp_path / "attack.pt")
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load_actor(tmp_path / "attack.pt")
    assert not (tmp_path / "pwned").exists()


def test_a_policy_of_another_task_is_refused_unless_any_will_do(tmp_path: Path) -> None:
    saved(tmp_path / "p.pt")
    with pytest.raises(
        CheckpointError, match="trained on TomatoViewpointGuided-v1, not on TomatoViewpointSparse-v1"
    ):
        load_actor(tmp_path / "p.pt", env_id="TomatoViewpointSparse-v1")
    assert load_actor(tmp_path / "p.pt").env_id == ENV_ID


def test_a_newer_format_asks_for_an_upgrade(tmp_path: Path) -> None:
    saved(tmp_path / "p.pt", format=99)
    with pytest.raises(CheckpointError, match=r"format 99.*upgrade"):
        load_actor(tmp_path / "p.pt")


def test_weights_that_do_not_fit_the_configuration_are_an_error(tmp_path: Path) -> None:
    other = make_agent(get_preset("thesis-guided"), 9, 6)
    saved(tmp_path / "p.pt", actor=other.actor.state_dict())
    with pytest.raises(CheckpointError, match="does not fit itself"):
        load_actor(tmp_path / "p.pt")


def test_weights_that_are_not_finite_are_an_error(tmp_path: Path) -> None:
    weights = make_agent(get_preset("td3"), 9, 6).actor.state_dict()
    weights["output.bias"] = torch.full((6,), float("nan"))
    saved(tmp_path / "p.pt", actor=weights)
    with pytest.raises(CheckpointError, match="not finite"):
        load_actor(tmp_path / "p.pt")


def test_options_that_only_a_training_needs_do_not_keep_a_policy_from_acting(tmp_path: Path) -> None:
    agent = make_agent(get_preset("td3"), 9, 6)
    saved(tmp_path / "p.pt", config={**agent.config.to_dict(), "colour": "red"})
    policy = load_actor(tmp_path / "p.pt")
    assert policy.act(torch.zeros(1, 9)).shape == (1, 6)
    with pytest.raises(InvalidInputError, match="config.colour is unknown"):
        TrainConfig.from_dict(policy.config)
