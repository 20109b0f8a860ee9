"""Run descriptions in files, and several seeds with one command."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from maniskill_tomato.cli import main, parse
from maniskill_tomato.cli.shared_options import merge_options
from maniskill_tomato.cli.train_command import Train
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.config_file import parse_seeds, read_run_file
from maniskill_tomato.learning.rl.presets import get_preset
from maniskill_tomato.learning.rl.run_folder import checkpoints
from maniskill_tomato.policies.trained_actor import load_checkpoint

ROOT = Path(__file__).resolve().parents[2]
GUIDED, SPARSE = "TomatoViewpointGuided-v1", "TomatoViewpointSparse-v1"

TOML = """
env_id = "TomatoViewpointGuided-v1"
preset = "thesis-guided"
seed = 4

[env_options]
plant = { preset = "three_tomatoes", seed = 7 }
plant_pose_noise = [0.01, 0.01, 0.1]

[config]
total_timesteps = 60
gamma = 0.8
actor_hidden = [16, 16]
checkpoint_every = 20
"""


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def parsed(*arguments: str) -> Train:
    command = parse(["train", *arguments])
    assert isinstance(command, Train)
    return command


def fails(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 2) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["train", *arguments])
    assert ended.value.code == status
    return capsys.readouterr().err


def actor(run_dir: Path) -> dict[str, torch.Tensor]:
    weights: dict[str, torch.Tensor] = load_checkpoint(run_dir / "policy.pt")["actor"]
    return weights


def assert_same_policy(one: Path, other: Path) -> None:
    first, second = actor(one), actor(other)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_a_file_changes_its_preset_and_flags_change_the_file(tmp_path: Path) -> None:
    file = str(write(tmp_path / "run.toml", TOML))
    command = parsed("--config", file)
    assert (command.env_id, command.preset, command.seed) == (GUIDED, "thesis-guided", 4)
    assert (command.config.gamma, command.config.buffer_size) == (0.8, 1000)
    assert command.config.actor_hidden == (16, 16)
    command = parsed(SPARSE, f"--config={file}", "--gamma", "0.7", "--seed", "9", "--preset", "thesis-sparse")
    assert (command.env_id, command.preset, command.seed) == (SPARSE, "thesis-sparse", 9)
    assert (command.config.gamma, command.config.buffer_size, command.config.total_timesteps) == (
        0.7,
        1500,
        60,
    )


def test_plant_flags_change_single_options_of_the_file() -> None:
    base = {"plant": {"preset": "full", "seed": 7}, "motion": "kinematic"}
    assert merge_options(base, {"plant": {"seed": "held_out"}, "plant_pose": (0.8, 0.0, 0.0)}) == {
        "plant": {"preset": "full", "seed": "held_out"},
        "motion": "kinematic",
        "plant_pose": (0.8, 0.0, 0.0),
    }
    grown = {"plant": {"preset": "full", "seed": 3}}
    assert merge_options(grown, {"plant": {"generator": "pots"}}) == {
        "plant": {"generator": "pots", "seed": 3}
    }
    assert merge_options({"plant": "pots"}, {}) == {"plant": {"generator": "pots"}}
    assert merge_options({"plant": "full"}, {"plant": {"seed": 3}}) == {
        "plant": {"preset": "full", "seed": 3}
    }


def test_the_config_of_a_run_repeats_it(tmp_path: Path) -> None:
    file = str(write(tmp_path / "run.toml", TOML))
    main(["train", "--config", file, "--plant-seed", "8", "--out", str(tmp_path / "a")])
    saved = json.loads((tmp_path / "a/config.json").read_text())
    assert saved["env_options"] == {
        "scene": "thesis",
        "plant": {"preset": "three_tomatoes", "seed": 8},
        "plant_pose_noise": [0.01, 0.01, 0.1],
    }
    main(["train", "--config", str(tmp_path / "a/config.json"), "--out", str(tmp_path / "b")])
    assert_same_policy(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "a/config.json").read_text() == (tmp_path / "b/config.json").read_text()
    assert (tmp_path / "a/episodes.csv").read_text() == (tmp_path / "b/episodes.csv").read_text()
    main(
        [
            "train",
            GUIDED,
            "--config",
            str(tmp_path / "a/config.json"),
            "--out",
            str(tmp_path / "c"),
            "--seed=5",
        ]
    )
    assert not torch.equal(actor(tmp_path / "a")["output.weight"], actor(tmp_path / "c")["output.weight"])
    # A finished run can be made longer, and is then the longer run.
    longer = ("--total-timesteps", "75")
    main(["train", "--resume", str(tmp_path / "b"), *longer])
    main(["train", "--config", str(tmp_path / "a/config.json"), "--out", str(tmp_path / "d"), *longer])
    assert_same_policy(tmp_path / "b", tmp_path / "d")
    assert json.loads((tmp_path / "b/config.json").read_text())["config"]["total_timesteps"] == 75


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.toml", "seed = [", "cannot be read"),
        ("a.json", "{", "cannot be read"),
        ("a.json", "[1]", "must hold a table, got list"),
        ("a.yaml", "", "must end in .toml or .json"),
        ("a.toml", "sead = 1", "a.toml: sead is unknown; .* may have config, env_id"),
        ("a.toml", "seed = -1", "a.toml: seeds must be 0 or more, got -1"),
        ("a.toml", "seeds = [0, -2]", r"seeds must be 0 or more, got \(0, -2\)"),
        ("a.toml", "seed = true", "a.toml: seed must be a whole number; got True"),
        ("a.toml", "seeds = 3", "a.toml: seeds must be an array; got 3"),
        ("a.toml", "env_id = 3", "env_id must be a string; got 3"),
        ("a.toml", "config = 3", "config must be a table"),
        ("a.toml", "preset = 'sac'", "preset must be one of 'td3'"),
        (
            "a.toml",
            "[config]\ngama = 0.9",
            "config.gama is unknown; config may have action_scale, .*did you mean 'gamma'",
        ),
        ("a.toml", "[config]\ngamma = 2.0", r"gamma must be in \[0, 1\), got 2.0"),
        ("a.toml", "[config]\ngamma = 'high'", "a.toml: config.gamma must be a finite number; got 'high'"),
    ],
)
def test_a_file_that_cannot_be_used_says_why(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        read_run_file(write(tmp_path / name, text))


def test_what_does_not_go_together_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path / "config.json", json.dumps({"env_id": GUIDED, "seed": 4, "config": {}}))
    assert "give the task to train on" in fails(capsys)
    assert "no configuration file at" in fails(capsys, "--config", str(tmp_path / "none.toml"))
    assert "holds no run to continue" in fails(capsys, "--resume", str(tmp_path / "none"))
    resume = ("--resume", str(tmp_path))
    assert "--config or --resume, not both" in fails(capsys, *resume, "--config", str(file))
    message = fails(capsys, *resume, "--gamma", "0.5", "--seed", "3", "--plant", "full", "--out", "x")
    assert "cannot take --seed, --out, --plant..., --gamma; only total_episodes" in message
    assert "cannot take the task" in fails(capsys, SPARSE, *resume)
    assert "cannot take --preset" in fails(capsys, *resume, "--preset", "thesis-sparse")
    assert "seeds must be integers" in fails(capsys, GUIDED, "--seeds", "1", "two")


def test_seeds_are_numbers_and_ranges() -> None:
    assert parse_seeds(("0", "1", "7")) == (0, 1, 7)
    assert parse_seeds(("0..4", "9")) == (0, 1, 2, 3, 4, 9)
    assert parse_seeds(()) == ()
    for words in (("4..0",), ("-1",), ("1.5",), ("..3",), ("a",)):
        with pytest.raises(InvalidInputError, match="seeds must be integers"):
            parse_seeds(words)
    with pytest.raises(InvalidInputError, match="once only; got 0, 1, 1"):
        parse_seeds(("0..1", "1"))


def command(*arguments: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "maniskill_tomato.cli", "train", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )


@pytest.mark.slow
def test_seeds_train_side_by_side_and_one_that_fails_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(write(tmp_path / "run.toml", TOML))
    main(["train", "--config", file, "--seed", "6", "--out", str(tmp_path / "alone")])
    out = tmp_path / "runs"
    (out / "seed-5").mkdir(parents=True)
    write(out / "seed-5/checkpoints", "in the way")
    arguments = ("--config", file, "--seeds", "5..6", "--out", str(out))
    assert "1 of 2 seeds failed: 5" in fails(capsys, *arguments, status=1)
    assert_same_policy(tmp_path / "alone", out / "seed-6")
    assert "cannot write" in (out / "seed-5/train.log").read_text()
    assert json.loads((out / "seeds.json").read_text())["seeds"] == [5, 6]
    (out / "seed-5/checkpoints").unlink()
    main(["train", "--resume", str(out), "--jobs", "2"])
    table = capsys.readouterr().out
    assert [line.split()[:3] for line in table.splitlines()[1:]] == [
        ["5", "finished", "60"],
        ["6", "finished", "60"],
    ]
    assert_same_policy(tmp_path / "alone", out / "seed-6")
    assert get_preset("thesis-guided").gamma != load_checkpoint(out / "seed-5/policy.pt")["config"]["gamma"]


def children(pid: int) -> list[int]:
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_stopping_the_command_stops_its_seeds_with_everything_saved(tmp_path: Path, number: int) -> None:
    out = tmp_path / "runs"
    arguments = ("--total-timesteps", "1000000", "--checkpoint-every", "50", "--seeds", "0", "1", "2")
    process: Any = command(GUIDED, "--preset", "thesis-guided", *arguments, "--jobs", "2", "--out", str(out))
    try:
        deadline = time.monotonic() + 300
        while len(list(out.glob("seed-*/checkpoints"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(0.3)
        workers = children(process.pid)
        os.kill(process.pid, number)
        output, errors = process.communicate(timeout=300)
        while any(is_alive(pid) for pid in workers) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not any(is_alive(pid) for pid in workers)
    finally:
        process.kill()
    if number != signal.SIGKILL:
        assert process.returncode == 0, errors
        assert [line.split()[1] for line in output.splitlines()[1:4]] == ["SIGTERM", "SIGTERM", "not"]
    for seed in (0, 1):
        saved = load_checkpoint(checkpoints(out / f"seed-{seed}")[-1])["counters"]
        assert load_checkpoint(out / f"seed-{seed}/policy.pt")["counters"]["steps"] == saved["steps"] >= 50
    assert not (out / "seed-2").exists()


@pytest.mark.slow
def test_a_seed_that_is_killed_is_reported_and_continued(tmp_path: Path) -> None:
    out = tmp_path / "runs"
    arguments = ("--total-timesteps", "1500", "--checkpoint-every", "50", "--seeds", "0", "1")
    process: Any = command(GUIDED, "--preset", "thesis-guided", *arguments, "--jobs", "2", "--out", str(out))
    try:
        deadline = time.monotonic() + 300
        while not list(out.glob("seed-1/checkpoints/*.pt")) and time.monotonic() < deadline:
            time.sleep(0.05)
        for pid in children(process.pid):
            if str(out / "seed-1") in os.popen(f"ls -l /proc/{pid}/fd 2>/dev/null").read():
                os.kill(pid, signal.SIGKILL)
        output, errors = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 1 and "1 of 2 seeds failed: 1" in errors
    assert "ended by SIGKILL" in output
    again = command("--resume", str(out))
    output, errors = again.communicate(timeout=300)
    assert again.returncode == 0, errors
    assert output.count("finished") == 2
