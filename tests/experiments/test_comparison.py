"""The comparison of runs: statistics against hand values, runs made by hand, the report and PPO."""

import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.tensorboard import SummaryWriter

from maniskill_tomato.cli import main
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.comparison_plots import trailing_mean, training_curve
from maniskill_tomato.experiments.configs import RunComparisonConfig
from maniskill_tomato.experiments.evaluation import evaluate_run
from maniskill_tomato.experiments.run_comparison import (
    compare_runs,
    group_runs,
    make_rows,
    write_comparison,
)
from maniskill_tomato.experiments.training_runs import Group, find_runs, load_run, read_clock
from maniskill_tomato.files import write_tensors
from maniskill_tomato.learning.rl.agent import make_agent
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.presets import get_preset
from maniskill_tomato.tasks import THESIS_IDS

ROOT = Path(__file__).resolve().parents[2]
GUIDED, SPARSE = THESIS_IDS
TD3 = get_preset("td3").to_dict()
HEADER = "episode,end_step,steps,success\n"


def make_run(
    path: Path,
    seed: int = 0,
    success: float | None = 1.0,
    steps: float = 2.0,
    env_id: str = GUIDED,
    config: dict[str, Any] | None = None,
    episodes: str = "0,10,10,False\n1,14,4,True\n",
) -> Path:
    """A run folder as training and evaluation leave it, in short."""
    path.mkdir(parents=True)
    content = {
        "env_id": env_id,
        "seed": seed,
        "package_version": "1",
        "config": TD3 if config is None else config,
    }
    (path / "config.json").write_text(json.dumps(content))
    (path / "episodes.csv").write_text(HEADER + episodes)
    if success is not None:
        metrics = {
            "env_id": env_id,
            "episodes": 100,
            "seed": 1000,
            "success_rate": success,
            "mean_steps": steps,
        }
        (path / "eval").mkdir()
        (path / "eval" / "metrics.json").write_text(json.dumps(metrics))
    return path


def groups_of(*paths: Path) -> list[Group]:
    return group_runs([load_run(path) for path in paths])


def test_a_folder_stands_for_the_runs_in_it(tmp_path: Path) -> None:
    first, second = (
        make_run(tmp_path / "several" / "seed-0"),
        make_run(tmp_path / "several" / "seed-1", seed=1),
    )
    (tmp_path / "several" / "notes").mkdir()
    assert find_runs([tmp_path / "several", second]) == [first, second]
    with pytest.raises(InvalidInputError, match="holds no run"):
        find_runs([tmp_path / "several" / "notes"])


def test_the_evaluation_is_found_in_the_run_below_it_and_beside_it(tmp_path: Path) -> None:
    below = make_run(tmp_path / "a", success=0.1)
    beside = make_run(tmp_path / "b", success=0.2)
    (beside / "eval").rename(tmp_path / "b-eval")
    inside = make_run(tmp_path / "c", success=0.3)
    (inside / "eval" / "metrics.json").rename(inside / "metrics.json")
    found = [load_run(path).metrics for path in (below, beside, inside)]
    assert [metrics and metrics["success_rate"] for metrics in found] == [0.1, 0.2, 0.3]
    assert load_run(make_run(tmp_path / "d", success=None)).metrics is None


def test_damaged_and_mismatched_runs_are_refused(tmp_path: Path) -> None:
    other_task = make_run(tmp_path / "other")
    metrics = json.loads((other_task / "eval" / "metrics.json").read_text())
    (other_task / "eval" / "metrics.json").write_text(json.dumps({**metrics, "env_id": SPARSE}))
    with pytest.raises(InvalidInputError, match="evaluated on TomatoViewpointSparse"):
        load_run(other_task)
    (other_task / "eval" / "metrics.json").write_text('{"env_id": "x"}')
    with pytest.raises(InvalidInputError, match="must hold env_id, episodes, seed, success_rate"):
        load_run(other_task)
    with pytest.raises(InvalidInputError, match=r"episodes\.csv cannot be read"):
        load_run(make_run(tmp_path / "cut", episodes="0,10,10,True\n1,1"))
    unreadable = make_run(tmp_path / "unreadable")
    (unreadable / "config.json").write_text('{"env_id"')
    with pytest.raises(InvalidInputError, match=r"config\.json cannot be read as JSON"):
        load_run(unreadable)
    (unreadable / "config.json").write_text('{"env_id": "x", "config": {}}')
    with pytest.raises(InvalidInputError, match="does not describe a run"):
        load_run(unreadable)


def test_runs_that_differ_in_their_seed_only_are_one_configuration(tmp_path: Path) -> None:
    paths = [
        make_run(tmp_path / "td3-1", seed=1),
        make_run(tmp_path / "td3-0", seed=0),
        make_run(tmp_path / "gamma", config={**TD3, "gamma": 0.5}),
        make_run(tmp_path / "sparse", env_id=SPARSE),
        make_run(tmp_path / "ppo", config={"algorithm": "PPO", "n_steps": 500, "gamma": 0.9}),
        make_run(tmp_path / "ppo-short", config={"algorithm": "PPO", "n_steps": 50, "gamma": 0.9}),
    ]
    found = [(group.env_id, group.label, [run.seed for run in group.runs]) for group in groups_of(*paths)]
    assert found == [
        (GUIDED, "td3", [0, 1]),
        (GUIDED, "td3, gamma 0.5", [0]),
        (GUIDED, "PPO, n_steps 500", [0]),
        (GUIDED, "PPO, n_steps 50", [0]),
        (SPARSE, "td3", [0]),
    ]


def test_the_same_seed_twice_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="same task, configuration and seed"):
        groups_of(make_run(tmp_path / "a"), make_run(tmp_path / "b"))


def test_the_clock_goes_on_where_an_interrupted_run_ended(tmp_path: Path) -> None:
    folder = tmp_path / "tensorboard"
    for suffix, points in ((".a", ((10, 1.0), (20, 2.0), (30, 3.0))), (".b", ((25, 1.5), (40, 4.0)))):
        writer = SummaryWriter(str(folder), filename_suffix=suffix)
        writer.add_scalar("charts/SPS", 0.0, 0)
        start = time.time()
        for step, seconds in points:
            writer.add_scalar("charts/SPS", 1.0, step, walltime=start + seconds)
        writer.close()
        for path in folder.glob(f"*{suffix}"):
            path.rename(folder / f"events.out.tfevents.1{suffix}")
    clock = read_clock(folder)
    assert clock is not None
    np.testing.assert_array_equal(clock[:, 0], [10, 20, 25, 40])
    # Step 30 was lost, but its time was spent. A file's clock starts when it is made, a moment before `start`.
    np.testing.assert_allclose(clock[:, 1], [1.0, 2.0, 4.5, 7.0], atol=0.5)
    assert read_clock(tmp_path) is None


def test_a_trailing_mean_takes_the_values_of_its_window_only() -> None:
    at, values = np.array([1.0, 2.0, 4.0, 4.0, 9.0]), np.array([1.0, 3.0, 5.0, 7.0, 9.0])
    means = trailing_mean(at, values, np.array([0.5, 2.0, 4.0, 6.0, 9.0]), 2.0)
    # (-1.5, 0.5] none; (0, 2] 1, 3; (2, 4] 5, 7; (4, 6] none; (7, 9] 9.
    np.testing.assert_array_equal(means, [np.nan, 2.0, 6.0, np.nan, 9.0])


def test_a_training_curve_averages_episodes_and_then_runs(tmp_path: Path) -> None:
    always = "".join(f"{i},{i + 1},1,True\n" for i in range(400))
    never = "".join(f"{i},{i + 1},1,False\n" for i in range(200))
    paths = [
        make_run(tmp_path / "0", seed=0, episodes=always),
        make_run(tmp_path / "1", seed=1, episodes=never),
    ]
    (group,) = groups_of(*paths)
    curve = training_curve(group, "success", wall_time=False)
    assert curve is not None
    assert curve.at[-1] == 200.0  # Where the shorter run ends.
    np.testing.assert_allclose(curve.mean, 0.5)
    np.testing.assert_allclose((curve.low.max(), curve.high.min()), (0.0, 1.0))
    assert training_curve(group, "success", wall_time=True) is None
    (lonely,) = groups_of(make_run(tmp_path / "2", seed=2, episodes=""))
    assert training_curve(lonely, "success", wall_time=False) is None


def test_a_configuration_evaluated_on_both_tasks_gets_a_row_for_both_together(tmp_path: Path) -> None:
    paths = [
        make_run(tmp_path / f"{env_id}-{seed}", seed, success, env_id=env_id)
        for env_id, scores in ((GUIDED, (0.5, 0.5)), (SPARSE, (1.0, 1.0)))
        for seed, success in enumerate(scores)
    ]
    rows = make_rows(groups_of(*paths, make_run(tmp_path / "new", 7, None)))
    assert [(row.task, row.seeds) for row in rows] == [
        (GUIDED, (0, 1)),
        (SPARSE, (0, 1)),
        ("2 tasks", (0, 1)),
    ]
    both = rows[2].success_rate
    assert both is not None
    assert (both.estimate, both.low, both.high) == (0.75, 0.75, 0.75)


def test_the_report_needs_no_other_file_and_says_what_was_not_evaluated(tmp_path: Path) -> None:
    paths = [
        make_run(tmp_path / "0", 0, 0.9),
        make_run(tmp_path / "1", 1, 1.0),
        make_run(tmp_path / "2", 2, None),
    ]
    paths.append(make_run(tmp_path / "<x>", config={"algorithm": "<PPO>"}, success=None))
    groups = groups_of(*paths)
    comparison = write_comparison(groups, tmp_path / "out")
    page = comparison.report.read_text()
    assert re.findall(r'src="(?!data:)', page) == []
    assert "&lt;PPO&gt;" in page and "<PPO>" not in page
    assert "95.0 [90.0, 100.0] %" in page
    assert "Not evaluated: 2 of the runs." in page
    content = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert content["rows"][0]["success_rate"] == {"estimate": pytest.approx(0.95), "low": 0.9, "high": 1.0}
    assert content["rows"][1]["success_rate"] is None
    table = comparison.table.splitlines()
    assert (
        table[2] == f"| {GUIDED} | td3 | 0, 1 | 95.0 [90.0, 100.0] % | 2.00 [2.00, 2.00] | 14 | not logged |"
    )
    assert "n = 2 seeds" in page and "n = 4 runs" in page


def test_a_comparison_reads_folders_and_refuses_what_is_no_run(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    comparison = compare_runs(RunComparisonConfig(runs=(run,), out=tmp_path / "out"))
    assert comparison.report == tmp_path / "out" / "report.html" and comparison.report.is_file()
    with pytest.raises(InvalidInputError, match="holds no run"):
        compare_runs(RunComparisonConfig(runs=(tmp_path / "nothing",), out=tmp_path / "out"))
    with pytest.raises(InvalidInputError, match="--evaluate must be 1 or more"):
        RunComparisonConfig(runs=(run,), evaluate=0)


def test_runs_without_an_evaluation_get_one_on_the_plants_of_their_training(tmp_path: Path) -> None:
    options: dict[str, Any] = {"plant": {"preset": "three_tomatoes", "seed": 4}}
    new = make_run(tmp_path / "runs" / "new", success=None)
    config = json.loads((new / "config.json").read_text())
    (new / "config.json").write_text(json.dumps({**config, "env_options": options}))
    checkpoint = make_checkpoint(
        make_agent(get_preset("td3"), 9, 6), GUIDED, (-torch.ones(6), torch.ones(6)), {}, env_options=options
    )
    write_tensors(new / "policy.pt", checkpoint)
    kept = make_run(tmp_path / "runs" / "old", success=0.25)
    compare_runs(
        RunComparisonConfig(runs=(tmp_path / "runs",), evaluate=2, eval_seed=7, out=tmp_path / "out")
    )
    metrics = json.loads((new / "eval" / "metrics.json").read_text())
    assert (metrics["episodes"], metrics["per_episode"]["seed"]) == (2, [7, 8])
    assert metrics["policy"]["trained_with"] == options
    with np.load(new / "eval" / "trajectories.npz") as data:
        heights = set(np.round(data["target"][:, 2], 3))
    env = make_env(GUIDED, **options)
    observations = [env.reset(seed=seed)[0] for seed in (7, 8)]
    env.close()
    assert heights == {round(float(o[0, 8]), 3) for o in observations}
    rates = {
        r["path"]: r["success_rate"]
        for r in json.loads((tmp_path / "out/comparison.json").read_text())["runs"]
    }
    assert rates[str(kept)] == 0.25 and rates[str(new)] == metrics["success_rate"]
    (kept / "eval" / "metrics.json").unlink()
    with pytest.raises(InvalidInputError, match="holds no policy to evaluate"):
        evaluate_run(load_run(kept), 2, 7)


def test_ppo_trains_evaluates_and_can_be_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = (
        *("train-ppo", SPARSE, "--seeds", "3", "--out", str(tmp_path)),
        "--no-progress",
        "--episodes",
        "2",
        "--total-timesteps",
        "300",
        "--n-steps",
        "100",
    )
    main(list(arguments))
    run = load_run(tmp_path / "seed-3")
    assert run.metrics is not None
    assert (run.metrics["episodes"], run.metrics["seed"]) == (2, 1000)
    assert run.metrics["policy"]["training_steps"] == 300
    assert run.training_steps is not None and 200 < run.training_steps <= 300
    (group,) = group_runs([run])
    assert group.label == "PPO"
    assert training_curve(group, "success", wall_time=True) is not None
    evaluated = tmp_path / "again"
    exported = str(tmp_path / "seed-3" / "policy.onnx")
    main(["eval", SPARSE, "--policy", exported, "--episodes", "2", "--out", str(evaluated), "--no-video"])
    assert f"PPO, ONNX, trained on {SPARSE} with the task's own plant" in capsys.readouterr().out
    metrics = json.loads((evaluated / "metrics.json").read_text())
    # The same policy on the same seeds: its actions agree to 1e-5, and so do the views that they lead to.
    assert metrics["per_episode"]["steps"] == run.metrics["per_episode"]["steps"]
    largest = metrics["per_episode"]["max_visible_fraction"]
    np.testing.assert_allclose(largest, run.metrics["per_episode"]["max_visible_fraction"], atol=0.02)
    assert "Training" in (evaluated / "report.html").read_text()
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    assert ended.value.code == 2 and "already holds a run" in capsys.readouterr().err
