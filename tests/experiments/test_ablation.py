"""The ablation of the learner: what is run, what is kept, and the table."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError, SeedsFailedError
from maniskill_tomato.experiments.ablation import ablation_rows, plan_trials, run_ablation, write_ablation
from maniskill_tomato.experiments.configs import AblationConfig
from maniskill_tomato.experiments.training_runs import find_runs, load_run
from maniskill_tomato.experiments.training_study import run_trials, steps_to_solved
from maniskill_tomato.experiments.variants import choose_variants, learner_variants
from maniskill_tomato.learning.rl.history import TrainingCurves
from maniskill_tomato.learning.rl.presets import get_preset
from maniskill_tomato.tasks import THESIS_IDS

GUIDED, SPARSE = THESIS_IDS


def test_every_variant_changes_what_it_says_and_nothing_else() -> None:
    base = get_preset("td3").to_dict()
    variants = learner_variants()
    assert variants[0].changes == {}
    for variant in variants:
        config = variant.config("td3").to_dict()
        changed = {name for name in base if config[name] != base[name]}
        assert changed == set(variant.changes), variant.name
    assert len({variant.name for variant in variants}) == len(variants)


def test_the_plan_leaves_out_what_makes_no_sense_and_names_what_it_does_not_know(tmp_path: Path) -> None:
    variants = learner_variants()
    trials = plan_trials(AblationConfig(seeds=(0, 1), out=tmp_path), variants)
    assert len(trials) == 2 * (2 * len(variants) - 1)
    assert len({trial.folder for trial in trials}) == len(trials)
    assert all(trial.env_id == SPARSE for trial in trials if trial.variant.name == "hindsight-targets")
    assert [trial.seed for trial in trials] == sorted(trial.seed for trial in trials)
    with pytest.raises(InvalidInputError, match="a variant must be one of 'base'.*; got 'her'"):
        choose_variants(["her"])
    with pytest.raises(InvalidInputError, match="--seeds must be one or more different numbers"):
        AblationConfig(seeds=(1, 1))
    with pytest.raises(InvalidInputError, match="--episodes must be 1 or more"):
        AblationConfig(episodes=0)
    with pytest.raises(InvalidInputError, match="a task must be one of"):
        plan_trials(AblationConfig(env_ids=("Reach-v0",)), variants)


def short(out: Path, *variants: str, **changes: Any) -> AblationConfig:
    options = {"env_ids": (GUIDED,), "seeds": (3,), "episodes": 2, "total_timesteps": 64, **changes}
    return AblationConfig(variants=variants, out=out, **options)


def test_a_run_is_done_once_and_kept(tmp_path: Path) -> None:
    config = short(tmp_path, "base")
    lines: list[str] = []
    text = run_ablation(config, lines.append)
    page = (tmp_path / "report.html").read_text()
    assert (
        f'<th scope="row">{GUIDED}</th>' in page and "n = 1 trainings" in page and text.startswith("| task |")
    )
    assert lines[0].startswith(f"1 of 1: {GUIDED} base, seed 3: success ")
    (result,) = json.loads((tmp_path / "ablation.json").read_text())["runs"]
    assert result["training_steps"] == 64 and result["updates"] == 0
    assert result["training_cpu_seconds"] > 0.0 and 0.0 <= result["success_rate"] <= 1.0
    (trial,) = plan_trials(config, choose_variants(["base"]))
    written = (trial.folder / "policy.pt").stat().st_mtime_ns
    assert run_ablation(config) == text and (trial.folder / "policy.pt").stat().st_mtime_ns == written
    (found,) = [load_run(path) for path in find_runs([tmp_path / GUIDED / "base"])]
    assert found.metrics is not None and found.metrics["success_rate"] == result["success_rate"]
    with pytest.raises(InvalidInputError, match=r"another experiment \(config differ\)"):
        run_ablation(short(tmp_path, "base", total_timesteps=50))


@pytest.mark.slow
def test_a_run_that_fails_does_not_stop_the_others(tmp_path: Path) -> None:
    config = short(tmp_path, "base", "no-delay", seeds=(0,), episodes=1, total_timesteps=40)
    good, bad = plan_trials(config, choose_variants(config.variants))
    bad = replace(bad, config=replace(bad.config, action_scale=(0.1, 0.1)))
    done = []
    with pytest.raises(SeedsFailedError, match="1 of 2 runs failed: .*no-delay"):
        for trial, _ in run_trials([bad, good], 2):
            done.append(trial)
    assert done == [good] and good.result() is not None


def curves(success: list[float], lengths: list[int]) -> TrainingCurves:
    episodes = {"success": np.array(success), "end_step": np.cumsum(lengths).astype(np.float64)}
    return TrainingCurves(episodes, np.zeros(0, np.float32), np.zeros(0, np.float32))


def test_steps_to_solved_against_a_plain_loop() -> None:
    random = np.random.default_rng(0)
    for rise in (60.0, 150.0, 1000.0):
        success = [float(random.random() < k / rise) for k in range(400)]
        lengths = [int(n) for n in random.integers(1, 30, 400)]
        history = curves(success, lengths)
        for learning_starts in (0, 3000):
            wanted = None
            kept = [i for i in range(400) if sum(lengths[: i + 1]) > learning_starts]
            for last in range(49, len(kept)):
                window = [success[i] for i in kept[last - 49 : last + 1]]
                if sum(window) / 50 >= 0.95:
                    wanted = sum(lengths[: kept[last] + 1])
                    break
            assert steps_to_solved(history, learning_starts) == wanted
    assert steps_to_solved(curves([1.0] * 49, [1] * 49), 0) is None


def result(env_id: str, variant: str, seed: int, success: float, **changes: Any) -> dict[str, Any]:
    return {
        "env_id": env_id,
        "variant": variant,
        "seed": seed,
        "episodes": 100,
        "success_rate": success,
        "mean_steps": 10.0 - success,
        "training_seconds": 40.0 + seed,
        "training_cpu_seconds": 30.0 + seed,
        "steps_to_solved": None if success < 0.9 else 1000 * (seed + 1),
        "config": {},
        **changes,
    }


def test_the_table_has_interquartile_means_over_seeds_and_over_tasks(tmp_path: Path) -> None:
    variants = choose_variants(["base", "hindsight-targets"])
    base = {GUIDED: [0.0, 0.9, 0.92, 1.0], SPARSE: [0.5, 0.6, 0.7, 0.8]}
    results = [result(env, "base", seed, s) for env, all_ in base.items() for seed, s in enumerate(all_)]
    results += [result(SPARSE, "hindsight-targets", 0, 0.75)]
    rows = ablation_rows(variants, results)
    assert [(row.task, row.variant) for row in rows] == [
        (GUIDED, "base"),
        (SPARSE, "base"),
        (SPARSE, "hindsight-targets"),
        ("2 tasks", "base"),
    ]
    guided, sparse, hindsight, both = rows
    assert guided.success_rate.estimate == pytest.approx((0.9 + 0.92) / 2)
    assert sparse.success_rate.estimate == pytest.approx(0.65)
    assert both.success_rate.estimate == pytest.approx((0.6 + 0.7 + 0.8 + 0.9) / 4)
    assert hindsight.success_rate.low is None  # A single run has no interval.
    assert guided.success_rate.low is not None and guided.success_rate.low < 0.9
    assert (guided.steps_to_solved, guided.solved_runs, guided.runs) == (3000.0, 3, 4)
    assert (sparse.steps_to_solved, both.training_cpu_seconds) == (None, 31.5)
    text = write_ablation(AblationConfig(out=tmp_path), variants, results)
    assert "| never (0 of 4) |" in text and "3,000 (3 of 4)" in text
    content = json.loads((tmp_path / "ablation.json").read_text())
    assert len(content["rows"]) == 4 and len(content["runs"]) == 9
    page = (tmp_path / "report.html").read_text()
    assert "<td>never (0 of 4)</td>" in page and page.count("<svg") == 3 and "n = 9 trainings" in page
