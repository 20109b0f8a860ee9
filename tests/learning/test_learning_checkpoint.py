import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import maniskill_tomato
from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.files import write_tensors
from maniskill_tomato.learning.rl.agent import Agent, make_agent
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.presets import PRESETS, TrainConfig, get_preset
from maniskill_tomato.policies.trained_actor import load_actor, load_checkpoint
from maniskill_tomato.sensing.image_layout import ImageLayout

ENV_ID = "TomatoViewpointGuided-v1"
BOUNDS = (-torch.ones(6), torch.ones(6))


def saved(path: Path, **changes: Any) -> tuple[Agent, dict[str, Any]]:
    agent = make_agent(get_preset("td3"), 9, 6)
    data = {**make_checkpoint(agent, ENV_ID, BOUNDS, {"steps": 12, "seed": 3}), **changes}
    write_tensors(path, data)
    return agent, data


def seen(config: TrainConfig, count: int) -> Any:
    """Random observations of the thesis's tasks, with images where they are observed."""
    state = torch.randn(count, 9)
    layout = ImageLayout.parse(config.obs_mode, config.image_size)
    if layout is None:
        return state
    drawn = {kind: np.stack([box.sample() for _ in range(count)]) for kind, box in layout.spaces().items()}
    return {"state": state, **{kind: torch.from_numpy(images) for kind, images in drawn.items()}}


@pytest.mark.parametrize("preset", PRESETS)
def test_a_policy_comes_back_as_it_was(tmp_path: Path, preset: str) -> None:
    actions = len(get_preset(preset).action_scale)
    agent = make_agent(get_preset(preset), 9, actions)
    bounds = (-torch.ones(actions), torch.ones(actions))
    write_tensors(tmp_path / "p.pt", make_checkpoint(agent, ENV_ID, bounds, {"steps": 12, "seed": 3}))
    policy = load_actor(tmp_path / "p.pt", env_id=ENV_ID)
    observations = seen(agent.config, 8)
    scale = torch.tensor(agent.config.action_scale)
    torch.testing.assert_close(
        policy.act(observations), agent.policy(observations) * scale, rtol=0.0, atol=0.0
    )
    assert TrainConfig.from_dict(policy.config) == agent.config
    assert (policy.env_id, policy.package_version) == (ENV_ID, maniskill_tomato.__version__)
    assert policy.counters == {"steps": 12, "seed": 3}


def test_a_training_checkpoint_holds_critics_targets_and_optimisers(tmp_path: Path) -> None:
    agent, _ = saved(tmp_path / "p.pt")
    data = load_checkpoint(tmp_path / "p.pt")
    other = make_agent(agent.config, 9, 6)
    for name in ("actor", "critics", "target_actor", "target_critics", "actor_optimizer", "critic_optimizer"):
        getattr(other, name).load_state_dict(data[name])
    for mine, theirs in zip(other.critics.parameters(), agent.critics.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0.0, atol=0.0)


def test_a_checkpoint_says_what_its_numbers_mean(tmp_path: Path) -> None:
    saved(tmp_path / "p.pt")
    data = load_checkpoint(tmp_path / "p.pt")
    assert data["observation"]["names"][3:] == [
        "ee_roll",
        "ee_pitch",
        "ee_yaw",
        "target_x",
        "target_y",
        "target_z",
    ]
    assert data["action"]["names"] == ["dx", "dy", "dz", "droll", "dpitch", "dyaw"]
    assert data["action"]["high"].tolist() == [1.0] * 6


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "p.pt"
    saved(path)
    before = path.read_bytes()

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(CheckpointError, match="No space left on device"):
        saved(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["p.pt"]


def test_configurations_survive_json() -> None:
    for config in PRESETS.values():
        assert TrainConfig.from_dict(config.to_dict()) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gamma": 1.0}, r"gamma must be in \[0, 1\), got 1.0"),
        ({"tau": 0.0}, "tau must be in"),
        ({"batch_size": 0}, "batch_size must be 1 or more"),
        ({"buffer_size": 10}, "buffer_size must be at least batch_size"),
        ({"total_timesteps": -5}, "total_timesteps must be above 0"),
        ({"total_timesteps": None, "total_episodes": None, "max_minutes": None}, "set at least one of"),
        ({"actor_hidden": ()}, "actor_hidden must list"),
        ({"critic_action_layer": 2}, r"critic_action_layer must be in 0 \.\.\. 1, got 2"),
        ({"action_scale": (0.1, 0.1, 0.1, 0.0, 0.1, 0.1)}, r"action_scale must hold values in \(0, 1\]"),
        ({"target_noise": float("nan")}, "target_noise must be 0 or more"),
    ],
)
def test_impossible_configurations_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(get_preset("td3"), **change)


def test_the_thesis_presets_are_tables_5_1_and_5_2() -> None:
    for name, episodes, buffer, exp in (
        ("thesis-guided", 240, 1000, 1200),
        ("thesis-sparse", 500, 1500, 1800),
    ):
        config = get_preset(name)
        assert (config.gamma, config.batch_size, config.tau) == (0.99, 32, 0.001)
        assert (config.actor_learning_rate, config.critic_learning_rate) == (1e-4, 1e-3)
        assert (config.total_episodes, config.buffer_size, config.exploration_steps) == (
            episodes,
            buffer,
            exp,
        )
        assert config.total_timesteps is None and config.max_minutes is None
        assert config.actor_hidden == config.critic_hidden == (100, 100)
        assert config.action_scale == (1.0,) * 6
        assert (config.twin_critics, config.policy_frequency, config.target_noise) == (False, 1, 0.0)
        assert (config.reward, config.updates_per_step, config.normalize_observations) == (
            "task",
            1.0,
            "none",
        )


def test_an_unknown_preset_lists_the_known_ones() -> None:
    listed = ", ".join(repr(name) for name in PRESETS)
    assert "'general-td3'" in listed
    with pytest.raises(InvalidInputError, match=f"{listed}; got 'sac'"):
        get_preset("sac")
