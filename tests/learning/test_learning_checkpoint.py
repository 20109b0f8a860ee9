import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

import maniskill_tomato
from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.learning.rl.agent import Agent, make_agent
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint, save_checkpoint
from maniskill_tomato.learning.rl.presets import PRESETS, TrainConfig, get_preset
from maniskill_tomato.policies.baselines import RandomIncrements
from maniskill_tomato.policies.trained_actor import load_actor, load_checkpoint

ENV_ID = "TomatoViewpointGuided-v1"
BOUNDS = (-torch.ones(6), torch.ones(6))


def saved(path: Path, **changes: Any) -> tuple[Agent, dict[str, Any]]:
    agent = make_agent(get_preset("td3"), 9, 6)
    data = {**make_checkpoint(agent, ENV_ID, BOUNDS, {"steps": 12, "seed": 3}), **changes}
    save_checkpoint(path, data)
    return agent, data


@pytest.mark.parametrize("preset", PRESETS)
def test_a_policy_comes_back_as_it_was(tmp_path: Path, preset: str) -> None:
    actions = len(get_preset(preset).action_scale)
    agent = make_agent(get_preset(preset), 9, actions)
    bounds = (-torch.ones(actions), torch.ones(actions))
    save_checkpoint(tmp_path / "p.pt", make_checkpoint(agent, ENV_ID, bounds, {"steps": 12, "seed": 3}))
    policy = load_actor(tmp_path / "p.pt", env_id=ENV_ID)
    observations = torch.randn(8, 9)
    scale = torch.tensor(agent.config.action_scale)
    torch.testing.assert_close(
        policy.act(observations), agent.policy(observations) * scale, rtol=0.0, atol=0.0
    )
    assert TrainConfig.from_dict(policy.config) == agent.config
    assert (policy.env_id, policy.package_version) == (ENV_ID, maniskill_tomato.__version__)
    assert policy.counters == {"steps": 12, "seed": 3}


def test_a_policy_knows_the_options_of_its_task(tmp_path: Path) -> None:
    options = {"plant": {"preset": "full", "seed": "train"}, "plant_pose": (0.8, 0.1, 0.5)}
    agent = make_agent(get_preset("td3"), 9, 6)
    for given, kept in ((options, {**options, "plant_pose": [0.8, 0.1, 0.5]}), ({}, {}), (None, None)):
        save_checkpoint(tmp_path / "p.pt", make_checkpoint(agent, ENV_ID, BOUNDS, {}, env_options=given))
        assert load_actor(tmp_path / "p.pt").env_options == kept
    saved(tmp_path / "p.pt", env_options="full")
    with pytest.raises(CheckpointError, match="env_options is 'full'"):
        load_actor(tmp_path / "p.pt")


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
    with pytest.raises(InvalidInputError, match="unknown training options: colour"):
        TrainConfig.from_dict(policy.config)


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


def test_the_random_policy_repeats_itself_with_its_seed() -> None:
    a, b = RandomIncrements(4), RandomIncrements(4)
    torch.testing.assert_close(a.act(torch.zeros(10, 9)), b.act(torch.zeros(10, 9)))
    assert not torch.allclose(a.act(torch.zeros(10, 9)), a.act(torch.zeros(10, 9)))
