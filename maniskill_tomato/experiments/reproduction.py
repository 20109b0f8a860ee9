"""The thesis's experiments over several seeds: trained, judged, drawn; finished parts are kept."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.experiments import thesis_figures
from maniskill_tomato.experiments.configs import ReproductionConfig
from maniskill_tomato.experiments.statistics import mean_interval
from maniskill_tomato.experiments.training_study import SATURATED, Trial, run_trials
from maniskill_tomato.experiments.variants import Experiment, Variant, experiments, find_variant, variants_of
from maniskill_tomato.files import write_atomically, write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.rl.agent import make_actor, make_normalizer
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.report_design import markdown_table
from maniskill_tomato.robot.inverse_kinematics import Reach

logger = logging.getLogger(__name__)

HEAD = (
    "variant",
    "success at the training pose, mean over seeds (95 % interval)",
    "per seed",
    "mean steps",
    "unreachable steps, training / evaluation",
    "saturated outputs",
    "training steps",
    "first action unreachable",
)


def run_reproduction(config: ReproductionConfig, report: Callable[[str], None] = lambda line: None) -> None:
    """Trains and judges every variant, draws the figures, and says where the results are.

    Args:
        config: What to reproduce.
        report: Told a row of the table after each variant, and where the results are.

    Raises:
        InvalidInputError: There is no such variant, or a folder holds a run of other settings.
        StudyStoppedError: A signal ended a training.
        CheckpointError: Another process reproduces the experiment in the folder.
    """
    experiment = experiments()[config.experiment]
    with only_writer(config.out / experiment.name, "measures"):
        _run_reproduction(config, experiment, report)


def _run_reproduction(
    config: ReproductionConfig, experiment: Experiment, report: Callable[[str], None]
) -> None:
    names = config.variant or (tuple(variants_of(experiment)) if config.ablate else ("exact",))
    chosen = [find_variant(experiment, name) for name in names]
    rows = []
    for number, variant in enumerate(chosen, start=1):
        logger.info("%s, variant %d of %d: %s", experiment.name, number, len(chosen), variant.title)
        trials = plan_trials(config, experiment, variant)
        results = {trial.seed: result for trial, result in run_trials(trials, config.jobs)}
        summaries = [results[seed] for seed in config.seeds]
        folder = trials[0].folder.parent
        untrained = untrained_first_steps(experiment.env_id, trials[0].config, config.untrained)
        write_json(folder / "untrained.json", untrained)
        write_json(folder / "summary.json", summaries)
        rows.append(_cells(variant.title, summaries, untrained))
        report(markdown_table(HEAD, rows[-1:]))
        if not config.ablate:
            _draw(config, experiment, trials, report)
    if config.ablate:
        path = config.out / experiment.name / "ablation.md"
        write_atomically(path, (markdown_table(HEAD, rows) + "\n").encode())
        report(f"table   {path}")


def plan_trials(config: ReproductionConfig, experiment: Experiment, variant: Variant) -> list[Trial]:
    """A training for every seed, judged as the thesis did, or at the training pose only."""
    training = variant.config(experiment.preset)
    if config.training_episodes is not None:
        training = replace(training, total_episodes=config.training_episodes)
    return [
        Trial(
            env_id=experiment.env_id,
            variant=variant,
            config=training,
            seed=seed,
            folder=config.out / experiment.name / variant.name / f"seed-{seed}",
            evaluations=experiment.evaluations[:1] if config.ablate else experiment.evaluations,
            episodes=config.episodes,
            show_progress=config.progress,
        )
        for seed in config.seeds
    ]


def _draw(
    config: ReproductionConfig, experiment: Experiment, trials: Sequence[Trial], report: Callable[[str], None]
) -> None:
    folder: Path = trials[0].folder.parent
    thesis_figures.draw_all(experiment, trials, folder / "figures")
    if config.views:
        left_out = thesis_figures.take_views(experiment, trials[0], folder / "figures")
        if left_out is not None:
            report(left_out)
    report(f"summary {folder / 'summary.json'}")
    report(f"figures {folder / 'figures'}")


def untrained_first_steps(env_id: str, config: TrainConfig, actors: int) -> dict[str, float]:
    """What freshly initialised actors do first: each of `actors` takes one step from a start of its own.

    Returns:
        `mean_move_m` (length of the position increment), `mean_output` and `saturated_output_share` of the
        actor, `unreachable_share` and `neighbour_share` of the poses asked for.
    """
    env = make_env(env_id)
    outputs: list[Tensor] = []
    reached: list[int] = []
    scale = torch.tensor(config.action_scale)
    try:
        for seed in range(actors):
            torch.manual_seed(seed)
            observations, _ = env.reset(seed=seed)
            actor = make_actor(config, observations.shape[1], len(scale))
            with torch.no_grad():
                output = actor(make_normalizer(config, observations.shape[1])(observations))
            info = env.step(output * scale)[4]
            outputs.append(output[0])
            reached.append(int(info["reachability"]))
    finally:
        env.close()
    values = torch.stack(outputs)
    return {
        "mean_move_m": float((values * scale)[:, :3].norm(dim=-1).mean()),
        "mean_output": float(values.abs().mean()),
        "saturated_output_share": float((values.abs() >= SATURATED).float().mean()),
        "unreachable_share": reached.count(Reach.UNREACHABLE) / actors,
        "neighbour_share": reached.count(Reach.NEIGHBOUR) / actors,
    }


def _cells(title: str, summaries: Sequence[dict[str, Any]], untrained: dict[str, float]) -> tuple[str, ...]:
    """One row of the table."""
    first = next(iter(summaries[0]["evaluations"]))
    results = [s["evaluations"][first] for s in summaries]
    trained = [s["training"] for s in summaries]
    rates = [r["success_rate"] for r in results]
    low, high = mean_interval(rates)

    def mean(figures: Sequence[dict[str, Any]], name: str) -> float:
        return float(np.mean([figure[name] for figure in figures]))

    return (
        title,
        f"{np.mean(rates):.0%} ({low:.0%} to {high:.0%})",
        ", ".join(f"{100 * r:.0f}" for r in rates),
        f"{mean(results, 'mean_steps'):.1f}",
        f"{mean(trained, 'unreachable_step_share'):.0%} / {mean(results, 'unreachable_step_share'):.0%}",
        f"{mean(results, 'saturated_output_share'):.0%}",
        f"{mean(trained, 'steps'):.0f}",
        f"{untrained['unreachable_share']:.0%}",
    )
