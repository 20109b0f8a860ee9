"""Logging to Weights & Biases: a stand-in package records what it is sent; the real one runs offline if installed."""

import dataclasses
import json
import os
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from maniskill_tomato.cli import main
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.run_comparison import group_runs
from maniskill_tomato.experiments.training_runs import load_run
from maniskill_tomato.learning.rl.envs import make_learner_env
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.run_folder import clear_run
from maniskill_tomato.learning.rl.trainer import train
from maniskill_tomato.tasks import THESIS_IDS

GUIDED = THESIS_IDS[0]


def short_config(**changes: Any) -> TrainConfig:
    short = {
        "num_envs": 1,
        "updates_per_step": 0.5,
        "total_timesteps": 250,
        "learning_starts": 50,
        "batch_size": 32,
        "wandb_project": "tomato",
    }
    return dataclasses.replace(get_preset("td3"), **{**short, **changes})


@dataclasses.dataclass
class StandInRun:
    """What `wandb.init` gives: it keeps everything that it is told."""

    settings: dict[str, Any]
    rows: list[tuple[int, dict[str, float]]] = dataclasses.field(default_factory=list)
    exit_code: int | None = None

    def log(self, row: dict[str, float], step: int) -> None:
        assert self.exit_code is None, "logged after its end"
        assert not self.rows or step > self.rows[-1][0], (
            "Weights & Biases drops rows whose step does not rise"
        )
        self.rows.append((step, row))

    def finish(self, exit_code: int) -> None:
        self.exit_code = exit_code


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[StandInRun]:
    """The runs begun with a stand-in of the package."""
    begun: list[StandInRun] = []

    def init(**settings: Any) -> StandInRun:
        begun.append(StandInRun(settings))
        return begun[-1]

    package = types.ModuleType("wandb")
    package.init = init  # type: ignore[attr-defined]
    package.Settings = dict  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", package)
    return begun


def tensorboard_scalars(run_dir: Path) -> dict[str, list[tuple[int, float]]]:
    events = EventAccumulator(str(run_dir / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    return {name: [(e.step, e.value) for e in events.Scalars(name)] for name in events.Tags()["scalars"]}


def test_it_gets_the_scalars_that_tensorboard_gets(tmp_path: Path, runs: list[StandInRun]) -> None:
    run_dir = tmp_path / "guided" / "seed-3"
    train(GUIDED, short_config(), run_dir, 3, {}, show_progress=False)
    (run,) = runs
    sent: dict[str, list[tuple[int, float]]] = {}
    for step, row in run.rows:
        for name, value in row.items():
            sent.setdefault(name, []).append((step, value))
    expected = tensorboard_scalars(run_dir)
    assert {"charts/episodic_return", "charts/SPS", "losses/qf1_loss"} <= sent.keys() == expected.keys()
    for name, points in expected.items():
        assert [step for step, _ in sent[name]] == [step for step, _ in points]
        assert [value for _, value in sent[name]] == pytest.approx([value for _, value in points], rel=1e-6)
    assert run.exit_code == 0
    assert (run.settings["project"], run.settings["name"]) == ("tomato", "guided/seed-3")
    assert run.settings["config"] == json.loads((run_dir / "config.json").read_text())
    assert run.settings["config"]["seed"] == 3


def test_a_continued_run_keeps_its_identity_and_a_new_one_gets_another(
    tmp_path: Path, runs: list[StandInRun]
) -> None:
    train(GUIDED, short_config(total_timesteps=60), tmp_path, 0, {}, show_progress=False)
    train(GUIDED, short_config(total_timesteps=90), tmp_path, 0, {}, resume=True, show_progress=False)
    (tmp_path / "wandb").mkdir()  # As the package itself makes it.
    clear_run(tmp_path)
    assert not (tmp_path / "wandb").exists()
    train(GUIDED, short_config(total_timesteps=60), tmp_path, 0, {}, show_progress=False)
    first, continued, new = (run.settings["id"] for run in runs)
    assert first == continued != new


def test_a_run_that_fails_is_ended_as_failed(
    tmp_path: Path, runs: list[StandInRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    from maniskill_tomato.learning.rl.trainer import Trainer

    env = make_learner_env(GUIDED)
    monkeypatch.setattr(env, "step", lambda actions: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        Trainer(env, GUIDED, short_config(), tmp_path, show_progress=False).run()
    env.close()
    assert [run.exit_code for run in runs] == [1]


def test_without_the_package_nothing_is_begun(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for stand_in in (
        None,
        types.ModuleType("wandb"),
    ):  # None makes the import fail; an empty folder is imported.
        monkeypatch.setitem(sys.modules, "wandb", stand_in)
        with pytest.raises(SystemExit) as ended:
            main(["train", GUIDED, "--wandb-project", "tomato", "--out", str(tmp_path / "run")])
        assert ended.value.code == 2
        assert "pip install 'maniskill-tomato[wandb]'" in capsys.readouterr().err
        assert not (tmp_path / "run").exists()
    with pytest.raises(InvalidInputError, match="must be the name of a project"):
        train(GUIDED, short_config(wandb_project=" "), tmp_path / "run", 0, {}, show_progress=False)


def test_where_it_cannot_begin_a_run_the_reason_is_told(
    tmp_path: Path, runs: list[StandInRun], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**settings: Any) -> StandInRun:
        raise RuntimeError("api_key not configured\nmore")

    monkeypatch.setattr(sys.modules["wandb"], "init", refuse)
    with pytest.raises(InvalidInputError, match=r"\(api_key not configured\): log in .* WANDB_MODE=offline"):
        train(GUIDED, short_config(), tmp_path, 0, {}, show_progress=False)


def test_runs_that_log_elsewhere_are_compared_as_the_same(tmp_path: Path, runs: list[StandInRun]) -> None:
    for seed, project in ((0, "tomato"), (1, None)):
        config = short_config(total_timesteps=60, wandb_project=project)
        train(GUIDED, config, tmp_path / str(seed), seed, {}, show_progress=False)
    (group,) = group_runs([load_run(tmp_path / str(seed)) for seed in (0, 1)])
    assert [run.seed for run in group.runs] == [0, 1]
    assert "wandb" not in group.label


def test_the_real_package_logs_without_a_network(tmp_path: Path) -> None:
    pytest.importorskip("wandb", reason="wandb is not installed; it is an extra")
    program = (
        "import sys\nfrom maniskill_tomato.cli import main\n"
        f"main(['train', '{GUIDED}', '--out', sys.argv[1], '--total-timesteps', '250', '--learning-starts', '50',"
        " '--batch-size', '32', '--wandb-project', 'tomato'])"
    )
    environment = {**os.environ, "WANDB_MODE": "offline"}
    command = [sys.executable, "-c", program, str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    run_id = json.loads((tmp_path / "run" / "wandb.json").read_text())["id"]
    (record,) = (tmp_path / "run" / "wandb").glob(f"offline-run-*-{run_id}/run-{run_id}.wandb")
    content = record.read_bytes()
    for name in (b"charts/episodic_return", b"charts/SPS", b"losses/qf1_loss"):
        assert name in content
