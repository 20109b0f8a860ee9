"""The command line on the real tasks, without rendering unless a test is marked."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
import trimesh

from maniskill_tomato.cli import main, parse
from maniskill_tomato.cli.eval_command import Eval
from maniskill_tomato.cli.shared_options import PlantOptions
from maniskill_tomato.cli.train_command import Train
from maniskill_tomato.experiments.stored_episodes import read_stored_episodes
from maniskill_tomato.files import write_tensors
from maniskill_tomato.learning.rl.agent import make_agent
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.presets import get_preset
from maniskill_tomato.plants.episode_list import load_episodes, write_episodes
from maniskill_tomato.plants.kinds import PLANT_NAMES
from maniskill_tomato.policies.trained_actor import load_actor, load_checkpoint
from maniskill_tomato.tasks import THESIS_IDS

ROOT = Path(__file__).resolve().parents[2]
GUIDED, SPARSE = THESIS_IDS
SHORT = (
    "--num-envs",
    "1",
    "--total-timesteps",
    "100",
    "--learning-starts",
    "50",
    "--batch-size",
    "32",
    "--checkpoint-every",
    "50",
)


def make_policy(path: Path, env_id: str = GUIDED) -> Path:
    """An untrained policy, good enough to be evaluated."""
    agent = make_agent(get_preset("td3"), 9, 6)
    write_tensors(path, make_checkpoint(agent, env_id, (-torch.ones(6), torch.ones(6)), {"steps": 0}))
    return path


def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Runs a command that must end with status 2; returns what it said."""
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    message = capsys.readouterr().err
    assert "Traceback" not in message
    return message


def command(*arguments: str) -> subprocess.Popen[str]:
    """The command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "maniskill_tomato.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )


def test_a_reader_that_goes_away_gets_no_traceback() -> None:
    command = f"{sys.executable} -m maniskill_tomato.cli train --help | head -n 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.stderr == "" and done.stdout.count("\n") == 1
    assert done.returncode in (0, 141)  # All of the text may fit into the pipe before its reader goes.


@pytest.mark.parametrize(
    "options",
    [
        ("--hindsight-targets", "2", "--aux-visibility-weight", "0.1"),
        ("--normalize-observations", "running"),
        ("--preset", "fast-td3", "--num-envs", "1", "--updates-per-step", "0.2", "--batch-size", "16"),
    ],
    ids=["hindsight", "normalisation", "fast-td3"],
)
def test_options_of_the_learner_are_flags(tmp_path: Path, options: tuple[str, ...]) -> None:
    main(["train", THESIS_IDS[1], "--out", str(tmp_path / "run"), *SHORT, *options])
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    for flag, value in zip(options[::2], options[1::2], strict=True):
        if flag != "--preset":
            assert str(config["config"][flag.removeprefix("--").replace("-", "_")]) == value
    assert config["env_options"] == {}
    main(["train", "--resume", str(tmp_path / "run"), "--total-timesteps", "120"])
    policy = load_actor(tmp_path / "run" / "policy.pt")
    assert policy.counters["steps"] == 120 and policy.counters["updates"] > 0


@pytest.mark.parametrize("env_id", THESIS_IDS)
def test_training_a_hundred_steps_writes_a_run(
    tmp_path: Path, env_id: str, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["train", env_id, "--out", str(tmp_path / "run"), "--seed", "4", *SHORT])
    assert f"policy  {tmp_path / 'run' / 'policy.pt'}" in capsys.readouterr().out
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written == {
        "checkpoints",
        "config.json",
        "episodes.csv",
        "history.npz",
        "policy.pt",
        "tensorboard",
    }
    checkpoint = load_checkpoint(tmp_path / "run/policy.pt")
    assert checkpoint["env_id"] == env_id
    assert (checkpoint["counters"]["steps"], checkpoint["counters"]["seed"]) == (100, 4)
    assert json.loads((tmp_path / "run/config.json").read_text())["config"]["total_timesteps"] == 100
    assert (tmp_path / "run/policy.pt").stat().st_size < 1_000_000


def test_one_seed_trains_one_policy_on_the_real_task(tmp_path: Path) -> None:
    weights = []
    for name in ("a", "b"):
        main(
            [
                "train",
                GUIDED,
                "--out",
                str(tmp_path / name),
                "--preset",
                "thesis-guided",
                "--total-timesteps",
                "60",
            ]
        )
        weights.append(load_checkpoint(tmp_path / name / "policy.pt")["actor"]["output.weight"])
    torch.testing.assert_close(weights[0], weights[1], rtol=0.0, atol=0.0)


def test_options_start_from_the_asked_preset() -> None:
    train = parse(["train", GUIDED, "--preset", "thesis-sparse", "--gamma", "0.9"])
    assert isinstance(train, Train)
    assert (train.config.buffer_size, train.config.exploration_steps, train.config.gamma) == (1500, 1800, 0.9)
    train = parse(["train", GUIDED, "--preset=thesis-guided"])
    assert isinstance(train, Train)
    assert train.config == get_preset("thesis-guided")


def test_another_plant_can_be_asked_for() -> None:
    command = parse(
        ["eval", GUIDED, "--plant", "full", "--plant-seed", "held_out", "--plant-pose", "0.8", "0", "1.5"]
    )
    assert isinstance(command, Eval)
    options = {"plant": {"preset": "full", "seed": "held_out"}, "plant_pose": (0.8, 0.0, 1.5)}
    assert command.plants.env_options() == options
    assert PlantOptions(plant_seed="7").env_options() == {"plant": {"seed": 7}}
    assert PlantOptions().env_options() == {}


def make_mesh(folder: Path) -> Path:
    """A stem with one ripe fruit on the robot's side."""
    stem = trimesh.creation.box((0.02, 0.02, 1.2)).apply_translation([0, 0, 0.6])
    fruit = trimesh.creation.icosphere(subdivisions=1, radius=0.03).apply_translation([-0.1, 0, 0.75])
    np.savez(folder / "plant.npz", stem=stem.triangles, fruit_0=fruit.triangles)
    return folder / "plant.npz"


def test_plants_from_meshes_are_trained_on_judged_and_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    mesh = make_mesh(tmp_path)
    main(["train", GUIDED, "--mesh", "plant.npz", "--total-timesteps", "20", "--out", "run"])
    options = {"plant": {"mesh": str(mesh)}}
    assert json.loads(Path("run/config.json").read_text())["env_options"] == options
    asked = ["--mesh", "plant.npz", "--policy", "run/policy.pt", "--no-video", "--no-baseline"]
    main(["eval", GUIDED, *asked, "--episodes", "2", "--out", "eval"])
    assert f"--seed 1001 --episodes 1 --no-baseline --out runs/again-1001 --mesh {mesh}" in re.sub(
        "<[^>]+>", "", Path("eval/report.html").read_text()
    )
    # The fruit hangs where the file says.
    target = np.load("eval/trajectories.npz")["target"]
    np.testing.assert_allclose(target, np.broadcast_to(target[0], target.shape))
    assert target[0, 2] == pytest.approx(0.75, abs=0.01)


@pytest.mark.parametrize("command", ["eval", "train", "play"])
def test_a_mesh_that_is_not_there_is_refused(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "there is no file or folder" in fails(
        capsys, command, GUIDED, "--mesh", str(tmp_path / "vine.glb")
    )


@pytest.mark.parametrize("preset", PLANT_NAMES)
def test_every_preset_of_plants_can_be_trained_on(preset: str) -> None:
    command = parse(["train", "TomatoViewpoint-v1", "--plant", preset])
    assert isinstance(command, Train)
    assert command.plants.env_options() == {"plant": {"preset": preset}}


def test_an_evaluation_runs_the_episodes_of_a_file(tmp_path: Path) -> None:
    episodes = load_episodes("validation")[3:5]
    write_episodes(tmp_path / "mine.json", episodes)
    words = [
        "eval",
        "TomatoViewpoint-v1",
        "--policy",
        "stay",
        "--episodes",
        "2",
        "--seed",
        "0",
        "--no-baseline",
    ]
    main(
        [*words, "--no-video", "--episode-list", str(tmp_path / "mine.json"), "--out", str(tmp_path / "out")]
    )
    with np.load(tmp_path / "out" / "trajectories.npz") as data:
        first = data["visible_fraction"][data["first_view"]]
    assert first == pytest.approx([e.start_visibility for e in episodes], abs=1e-4)
    (kept,) = read_stored_episodes(tmp_path / "out")
    assert kept.env_options == {"episodes": str(tmp_path / "mine.json")}
    assert [e.visible_fraction[0] for e in kept.episodes["stay"].values()] == pytest.approx(first, abs=1e-4)


def test_evaluation_writes_metrics_that_follow_from_its_trajectories(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = make_policy(tmp_path / "policy.pt")
    out = tmp_path / "out"
    main(
        [
            "eval",
            GUIDED,
            "--policy",
            str(policy),
            "--episodes",
            "3",
            "--seed",
            "5",
            "--out",
            str(out),
            "--no-video",
        ]
    )
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["env_id"], metrics["episodes"], metrics["seed"]) == (GUIDED, 3, 5)
    assert metrics["success_threshold"] == 0.85
    with np.load(out / "trajectories.npz") as data:
        views = np.split(data["visible_fraction"], data["first_view"][1:])
        seeds = data["seed"].tolist()
    assert seeds == [5, 6, 7] == metrics["per_episode"]["seed"]
    largest = [view[1:].max() for view in views]
    assert metrics["success_rate"] == pytest.approx(np.mean([v > 0.85 for v in largest]))
    assert metrics["mean_steps"] == pytest.approx(np.mean([len(view) - 1 for view in views]))
    assert metrics["mean_max_visible_fraction"] == pytest.approx(np.mean(largest))
    assert "success_rate" in metrics["random_actions"]
    assert (out / "report.html").is_file()
    assert f"report  {out / 'report.html'}" in capsys.readouterr().out
    main(
        [
            "eval",
            GUIDED,
            "--policy",
            str(policy),
            "--episodes",
            "3",
            "--seed",
            "5",
            "--out",
            str(out),
            "--no-video",
        ]
    )
    again = json.loads((out / "metrics.json").read_text())
    assert again["per_episode"] == metrics["per_episode"]


def test_a_run_on_another_plant_leaves_policies_that_say_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant = ("--plant", "three_tomatoes", "--plant-seed", "4", "--plant-pose", "0.8", "0.1", "0.5")
    main(["train", GUIDED, "--out", str(tmp_path), *plant, *SHORT])
    options = {"plant": {"preset": "three_tomatoes", "seed": 4}, "plant_pose": [0.8, 0.1, 0.5]}
    (newest, *_) = sorted((tmp_path / "checkpoints").iterdir(), reverse=True)
    for path in (tmp_path / "policy.pt", newest):
        assert load_actor(path).env_options == options
    capsys.readouterr()
    short = ("--episodes", "1", "--no-video", "--no-baseline", "--out", str(tmp_path / "eval"))
    main(["eval", GUIDED, "--policy", str(tmp_path / "policy.pt"), *short])
    assert f"policy  TD3, trained on {GUIDED} with plant={{" in capsys.readouterr().out
    assert json.loads((tmp_path / "eval/metrics.json").read_text())["policy"]["trained_with"] == options


def test_the_demo_names_its_report_and_its_policy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy = tmp_path / "training" / "policy.pt"
    for _ in range(2):  # A second demo replaces the first.
        main(["demo", "--out", str(tmp_path), "--minutes", "0.05", "--episodes", "1", "--no-video"])
    said = capsys.readouterr().out.splitlines()
    assert said[-4:] == [
        f"report  {tmp_path / 'report.html'}",
        "video   not wanted",
        f"policy  {policy}",
        f"watch   maniskill-tomato play --policy {policy}",
    ]
    assert load_actor(policy).env_id == "TomatoViewpoint-v1"
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert set(metrics["beside"]) == {"nbv", "lattice_oracle"} and "random_actions" in metrics
    assert metrics["beside"]["lattice_oracle"]["success_rate"] == 1.0
    page = (tmp_path / "report.html").read_text()
    assert all(f">{name}<" in page for name in ("nbv", "lattice_oracle", "random actions"))
    assert "Training" in page and "<dd>training/policy.pt</dd>" in page
    assert f"<code>maniskill-tomato demo --out {tmp_path} --minutes 0.05" in page


@pytest.mark.render
@pytest.mark.slow
def test_an_evaluation_films_an_episode_where_it_can_render(tmp_path: Path) -> None:
    main(["eval", GUIDED, "--out", str(tmp_path), "--episodes", "1", "--no-baseline"])
    reader = imageio.get_reader(tmp_path / "video.mp4")
    assert reader.get_meta_data()["duration"] > 1.0
    frame = np.asarray(reader.get_data(5))
    assert frame.shape == (544, 1280, 3)
    assert frame[:480, :640].std() > 10.0 and frame[:480, 640:].std() > 10.0
    for name in ("first_view", "last_view", "first_pose", "last_pose"):
        assert imageio.imread(tmp_path / f"{name}.png").shape == (480, 640, 3)
    page = (tmp_path / "report.html").read_text()
    assert 'src="data:video/mp4;base64,' in page and 'poster="data:image/jpeg;base64,' in page
    assert 'href="video.mp4"' in page and "First view of the wrist camera" in page


def test_a_policy_that_is_damaged_or_of_another_task_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ("--out", str(tmp_path / "out"), "--episodes", "1", "--no-video")
    (tmp_path / "bad.pt").write_bytes(b"PK\x03\x04 nonsense")
    assert "not a readable checkpoint" in fails(
        capsys, "eval", GUIDED, "--policy", str(tmp_path / "bad.pt"), *out
    )
    other = make_policy(tmp_path / "other.pt", SPARSE)
    message = fails(capsys, "eval", GUIDED, "--policy", str(other), *out)
    assert "trained on TomatoViewpointSparse-v1" in message and "--allow-other-task" in message
    main(["eval", GUIDED, "--policy", str(other), "--allow-other-task", "--no-baseline", *out])
    assert "random_actions" not in json.loads((tmp_path / "out/metrics.json").read_text())


@pytest.mark.parametrize("env_id", THESIS_IDS)
def test_the_shipped_policy_solves_its_task(tmp_path: Path, env_id: str) -> None:
    main(["eval", env_id, "--episodes", "50", "--out", str(tmp_path), "--no-video", "--no-baseline"])
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["policy"]["trained_on"] == env_id
    assert metrics["success_rate"] >= 0.9
    assert metrics["mean_steps"] <= 3.0


def test_without_a_shipped_policy_the_message_says_what_to_do(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("maniskill_tomato.assets.ASSETS_DIR", tmp_path)
    message = fails(capsys, "eval", GUIDED, "--episodes", "1")
    assert f"maniskill-tomato train {GUIDED}" in message and "--policy" in message


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("train", GUIDED, "--num-envs", "0"), "--num-envs must be 1 or more, got 0"),
    ],
)
def test_bad_options_are_answered_in_words(
    arguments: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    if arguments[0] in ("train", "eval"):
        arguments = (*arguments, "--out", str(tmp_path / "out"))
    assert expected in fails(capsys, *arguments)
    assert not (tmp_path / "out/config.json").exists()


def test_a_run_is_not_overwritten_unless_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = ("train", GUIDED, "--out", str(tmp_path), *SHORT)
    (tmp_path / "notes.txt").write_text("mine")
    main(run)
    assert "already holds a run" in fails(capsys, *run)
    main([*run, "--overwrite"])
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_ctrl_c_in_the_terminal_saves_the_policy(tmp_path: Path) -> None:
    process = command("train", GUIDED, "--out", str(tmp_path / "run"), "--total-timesteps", "1000000")
    try:
        deadline = time.monotonic() + 300
        while not list(tmp_path.glob("run/tensorboard/*")) and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(1.0)
        os.kill(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert "(SIGINT)" in output
    assert load_actor(tmp_path / "run/policy.pt").counters["steps"] > 0
