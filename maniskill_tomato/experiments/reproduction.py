"""The thesis's experiments over several seeds: trained, judged, drawn; finished parts are kept."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from maniskill_tomato import report_design as design
from maniskill_tomato.experiments import thesis_figures
from maniskill_tomato.experiments.configs import ReproductionConfig
from maniskill_tomato.experiments.statistics import mean_interval
from maniskill_tomato.experiments.training_study import SATURATED, Trial, run_trials
from maniskill_tomato.experiments.variants import Experiment, Variant, experiments, find_variant, variants_of
from maniskill_tomato.files import write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.rl.agent import make_actor, make_normalizer
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.report_design import figure, markdown_table, paragraph, section, table
from maniskill_tomato.report_plots import plot_intervals
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.run_facts import run_facts

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

ABOUT = (
    "The experiment of the thesis, trained from several seeds and judged without exploration. An episode is solved "
    "when the target is fully visible."
)

COLUMNS = (
    "Steps of an episode that is not solved are its longest length. A step is unreachable if the arm cannot take the "
    f"pose that the policy asks for. An output of the actor is saturated from {SATURATED} of its largest size on; "
    "saturated actors hardly learn. First action unreachable: the share of freshly initialised actors whose first "
    "action leads out of reach."
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
    experiment = experiments(config.scene)[config.experiment]
    with only_writer(config.out / experiment.name, "measures"):
        _run_reproduction(config, experiment, report)


def _run_reproduction(
    config: ReproductionConfig, experiment: Experiment, report: Callable[[str], None]
) -> None:
    names = config.variant or (tuple(variants_of(experiment)) if config.ablate else ("exact",))
    chosen = [find_variant(experiment, name) for name in names]
    rows = []
    shares: dict[str, tuple[float, float, float] | float] = {}
    for number, variant in enumerate(chosen, start=1):
        logger.info("%s, variant %d of %d: %s", experiment.name, number, len(chosen), variant.title)
        trials = plan_trials(config, experiment, variant)
        results = {}
        # One training at a time draws bars of its own.
        silent = True if not config.progress or config.jobs == 1 else None
        with tqdm(total=len(trials), unit="training", desc=variant.name, disable=silent) as bar:
            for trial, result in run_trials(trials, config.jobs):
                results[trial.seed] = result
                bar.update()
        summaries = [results[seed] for seed in config.seeds]
        folder = trials[0].folder.parent
        untrained = untrained_first_steps(
            experiment.env_id, trials[0].config, config.untrained, experiment.env_options
        )
        write_json(folder / "untrained.json", untrained)
        write_json(folder / "summary.json", summaries)
        rows.append(_cells(variant.title, summaries, untrained))
        shares[variant.title] = _share(summaries)
        report(markdown_table(HEAD, rows[-1:]))
        if not config.ablate:
            pictures = _draw(config, experiment, trials, report)
            page = _write_report(
                config, folder, variant.title, rows[-1:], {variant.title: _share(summaries)}, pictures
            )
            report(f"report  {page}")
    if config.ablate:
        page = _write_report(config, config.out / experiment.name, "variants", rows, shares, ())
        report(f"report  {page}")


def _share(summaries: Sequence[dict[str, Any]]) -> tuple[float, float, float] | float:
    """Mean over the seeds of the success at the training pose, with its interval if there are several."""
    first = next(iter(summaries[0]["evaluations"]))
    rates = [s["evaluations"][first]["success_rate"] for s in summaries]
    return (float(np.mean(rates)), *mean_interval(rates)) if len(rates) > 1 else rates[0]


def _write_report(
    config: ReproductionConfig,
    folder: Path,
    what: str,
    rows: Sequence[Sequence[str]],
    shares: dict[str, tuple[float, float, float] | float],
    pictures: Sequence[Path],
) -> Path:
    """Writes report.html; the plot of the success stands beside it."""
    plot = folder / "success.png"
    bare = {_plain(title): share for title, share in shares.items()}
    plot_intervals(bare, "Success at the training pose", "share of episodes solved", plot, (0.0, 1.0))
    of = f"n = {len(config.seeds)} training seeds, {config.episodes} episodes each"
    return design.report(
        folder,
        f"The thesis's experiment, {config.experiment}",
        f"{_plain(what)}; {of}",
        [
            paragraph(ABOUT),
            section(
                f"Results, {of}",
                table(HEAD, [(_plain(row[0]), *row[1:]) for row in rows], words=(0,)),
                paragraph(COLUMNS, "caption"),
                figure(
                    plot,
                    "Share of episodes solved at the training pose (0 to 1): mean over the seeds, 95 % interval; "
                    f"{of}.",
                ),
            ),
            section("Figures", *(figure(path, f"{_caption(path, of)}.") for path in pictures))
            if pictures
            else "",
        ],
        run_facts(),
    )


def _plain(title: str) -> str:
    """A variant's title without Markdown."""
    return title.replace("`", "")


def _caption(path: Path, of: str) -> str:
    """What a figure of the thesis's counterparts shows, with units; `of` says of how many."""
    kind, _, evaluation = path.stem.partition("_")
    where = evaluation.replace("-", " ")
    return {
        "training": "Training: loss and reward of episodes, reward and V_f (0 to 1) of steps, moving averages "
        f"(thesis Fig. 5-1 to 5-4); {of}",
        "plants": "Where the plant stands in each evaluation, in metres, from the front and from above (thesis "
        "Fig. 5-5). The black square is the robot's base; start views lie in the dashed box",
        "evaluation": f"Evaluation at {where}: steps and largest V_f (0 to 1) of the first episodes and of all, sorted "
        f"(thesis Fig. 5-6, 5-7). An episode above the dashed V_f is solved; {of}",
        "trajectories": f"Ways of the camera at {where}, in metres (thesis Fig. 5-8); the first episodes of one seed",
        "views": f"First view, last view and the scene at the end, at {where} (thesis Fig. 5-9); one episode of one "
        "seed",
    }[kind]


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
            env_options=experiment.env_options,
            show_progress=config.progress,
        )
        for seed in config.seeds
    ]


def _draw(
    config: ReproductionConfig, experiment: Experiment, trials: Sequence[Trial], report: Callable[[str], None]
) -> list[Path]:
    """Draws the figures, and returns their files."""
    folder: Path = trials[0].folder.parent
    drawn = thesis_figures.draw_all(experiment, trials, folder / "figures")
    if config.views:
        left_out = thesis_figures.take_views(experiment, trials[0], folder / "figures")
        if left_out is None:
            drawn += [folder / "figures" / f"views_{one.name}.png" for one in experiment.evaluations]
        else:
            report(left_out)
    report(f"summary {folder / 'summary.json'}")
    report(f"figures {folder / 'figures'}")
    return drawn


def untrained_first_steps(
    env_id: str, config: TrainConfig, actors: int, env_options: Mapping[str, Any] | None = None
) -> dict[str, float]:
    """What freshly initialised actors do first: each of `actors` takes one step from a start of its own.

    Args:
        env_id: Id of the task.
        config: How actors are initialised.
        actors: How many.
        env_options: Options of the task.

    Returns:
        `mean_move_m` (length of the position increment), `mean_output` and `saturated_output_share` of the
        actor, `unreachable_share` and `neighbour_share` of the poses asked for.
    """
    env = make_env(env_id, **(env_options or {}))
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
        f"{100 * np.mean(rates):.0f} % ({100 * low:.0f} to {100 * high:.0f} %)",
        f"{', '.join(f'{100 * r:.0f}' for r in rates)} %",
        f"{mean(results, 'mean_steps'):.1f}",
        " / ".join(f"{100 * mean(one, 'unreachable_step_share'):.0f} %" for one in (trained, results)),
        f"{100 * mean(results, 'saturated_output_share'):.0f} %",
        f"{mean(trained, 'steps'):.0f}",
        f"{100 * untrained['unreachable_share']:.0f} %",
    )
