"""An evaluation from policy to report: episodes, metrics, plots, pictures, film, page."""

import io
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments import plots
from maniskill_tomato.experiments.configs import EvaluationConfig
from maniskill_tomato.experiments.episode_listing import list_episodes, replay_with_eval
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.evaluation_report import (
    FILM_MOVES,
    ReportInput,
    ReportPicture,
    write_report,
)
from maniskill_tomato.experiments.metrics import make_metrics
from maniskill_tomato.experiments.policy_runs import label_of
from maniskill_tomato.experiments.rollout import open_widest, run_episodes
from maniskill_tomato.experiments.row_benchmark import ENV_ID as ROW_ID
from maniskill_tomato.experiments.row_benchmark import seeable_in_row, without_camera
from maniskill_tomato.experiments.stored_episodes import store_episodes
from maniskill_tomato.experiments.training_runs import Run
from maniskill_tomato.files import write_atomically, write_json
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.history import load_history
from maniskill_tomato.plants.plant_generators import check_recorded_plant
from maniskill_tomato.policies.adapters import origin
from maniskill_tomato.policies.opening import (
    RANDOM,
    find_policy,
    needs_colours,
    open_policy,
    shipped_policy,
)
from maniskill_tomato.policies.protocol import Planner, Policy
from maniskill_tomato.rendering import vulkan_probe
from maniskill_tomato.run_facts import duration, is_command_running, run_facts
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.task_registry import base_of, check_recorded_task, find_task

logger = logging.getLogger(__name__)

LEFT_OUT = (
    "Left out because this machine cannot render: the film, and the first and last views of the camera. {hint}. "
    "Then run this evaluation again."
)


@dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """What an evaluation wrote."""

    metrics: dict[str, Any]
    report: Path
    video: Path | None
    left_out: str | None
    """Which pictures are missing and how to get them; None if none are."""
    origin: str
    """What the policy is and where it was trained, in one line."""


@dataclass(frozen=True, kw_only=True)
class EpisodeLimits:
    """When an episode of the task ends."""

    threshold: float
    """V_f above which the target is fully visible."""
    horizon: int | None
    """Most moves; None if the task does not say."""


@dataclass(frozen=True, kw_only=True)
class FilmedEpisodes:
    """What was filmed; nothing where this machine cannot render."""

    video: Path | None = None
    poster: Path | None = None
    """The end of the first filmed episode that was solved, else of the first one."""
    count: int = 0
    """How many episodes."""
    views: Sequence[ReportPicture] = ()


def evaluate(config: EvaluationConfig) -> EvaluationResult:
    """Evaluates a policy; writes metrics.json, trajectories.npz, the episodes, plots, pictures, a film and report.html.

    Raises:
        PolicyError: The policy cannot be used.
    """
    start = time.perf_counter()
    find_task(config.env_id)
    found = find_policy(config.policy or shipped_policy(config.env_id), _required_task(config))
    path = found if isinstance(found, Path) else None
    episodes, baseline, limits, policy = _run(config, found)
    threshold = limits.threshold
    beside = {
        name: _run_policy(config, find_policy(name, _required_task(config)))[0] for name in config.beside
    }
    true_association = _with_true_association(config, found)
    seeable = _seeable(config, episodes)
    description = {
        "path": None if path is None else str(path),
        **(policy.describe() if isinstance(policy, Planner) else {"kind": policy.name}),
    }
    metrics = make_metrics(
        config.env_id,
        episodes,
        seed=config.seed,
        success_threshold=threshold,
        policy=description,
        wall_seconds=time.perf_counter() - start,
        baseline=baseline,
        beside=beside,
        true_association=true_association,
        seeable=seeable,
    )
    write_json(config.out / "metrics.json", metrics)
    write_trajectories(config.out / "trajectories.npz", episodes)
    others = [(find_policy(name, _required_task(config)), beside[name]) for name in beside]
    random = [] if baseline is None else [(RANDOM, baseline)]
    _keep_episodes(config, [(found, episodes), *random, *others])
    shown = FilmedEpisodes()
    left_out = None
    if config.video:
        if (problem := vulkan_probe.rendering_problem()) is None:
            shown = _film(config, found, _worth_watching(episodes, config.films))
        else:
            left_out = LEFT_OUT.format(hint=problem)
    facts = {key.replace("_", " "): str(value) for key, value in description.items() if key != "path"}
    facts["evaluation time"] = duration(metrics["wall_seconds"])
    source = str(config.policy or shipped_policy(config.env_id))

    repeats = policy.name != RANDOM

    def replay(seed: int) -> str | None:
        if not repeats:
            return None
        return replay_with_eval(
            config.env_id, source, seed, config.env_options, allow_other_task=config.allow_other_task
        )

    content = ReportInput(
        title=config.title,
        metrics=metrics,
        facts={**facts, **run_facts(None if is_command_running() else time.perf_counter() - start)},
        training=_plot_training(config, path),
        evaluation=_plot_episodes(config, episodes, threshold),
        views=shown.views,
        episodes=list_episodes(episodes, threshold, limits.horizon, replay),
        repeats=repeats,
        video=shown.video,
        poster=shown.poster,
        filmed=shown.count,
        policy=path,
        left_out=left_out,
    )
    report = config.out / "report.html"
    write_report(report, content)
    return EvaluationResult(
        metrics=metrics, report=report, video=shown.video, left_out=left_out, origin=origin(policy)
    )


def evaluate_run(run: Run, episodes: int, seed: int) -> EvaluationResult:
    """Evaluates the policy of a run on the task and plants of its training; the results go into its folder `eval`.

    Args:
        run: Its folder holds `policy.pt`, or `policy.onnx` if another learner trained it.
        episodes: How many episodes.
        seed: Seed of the first; the others follow.

    Raises:
        InvalidInputError: The folder holds neither.
        PolicyError: Its policy cannot be read.
    """
    policies = [path for name in ("policy.pt", "policy.onnx") if (path := run.path / name).is_file()]
    if not policies:
        raise InvalidInputError(
            f"{run.path} holds no policy to evaluate (policy.pt or policy.onnx); finish the run with "
            f"`maniskill-tomato train --resume {run.path}`, or compare without evaluating"
        )
    check_recorded_task(run.env_id, run.path)
    check_recorded_plant(
        run.config.get("env_options", {}).get("plant"),
        run.path / "config.json",
        f"evaluate it with `maniskill-tomato eval {run.env_id} --policy {policies[0]} --plant {{name}} "
        f"--out {run.path / 'eval'}`",
    )
    logger.info("evaluating %s", run.path)
    return evaluate(
        EvaluationConfig(
            env_id=run.env_id,
            policy=str(policies[0]),
            episodes=episodes,
            seed=seed,
            out=run.path / "eval",
            env_options=run.config.get("env_options", {}),
            baseline=False,
            video=False,
            title=f"Evaluation of {run.path.name}",
        )
    )


def write_trajectories(path: Path, episodes: Sequence[EpisodeRecord]) -> None:
    """Writes every view of every episode as arrays.

    `first_view[i]` is the row of episode i's start view in `viewpoints` (x, y, z [m], roll, pitch, yaw [rad])
    and `visible_fraction`; `target[i]` is its target's position [m].
    """
    lengths = np.array([len(e.visible_fraction) for e in episodes])
    content = io.BytesIO()
    np.savez_compressed(
        content,
        seed=np.array([e.seed for e in episodes]),
        first_view=np.concatenate(([0], np.cumsum(lengths)[:-1])),
        target=np.stack([e.target[0] for e in episodes]),
        viewpoints=np.concatenate([e.viewpoints for e in episodes]),
        visible_fraction=np.concatenate([e.visible_fraction for e in episodes]),
    )
    write_atomically(path, content.getvalue())


def _keep_episodes(
    config: EvaluationConfig, runs: Sequence[tuple[str | Path, Sequence[EpisodeRecord]]]
) -> None:
    """Keeps the episodes of each policy, as it was found, so that they can be shown again."""
    policies: dict[str, str] = {}
    episodes: dict[str, Sequence[EpisodeRecord]] = {}
    for found, records in runs:
        label = label_of(found)
        if label in policies:
            label = str(found)
        policies[label], episodes[label] = str(found), records
    store_episodes(config.out, config.env_id, config.env_options, policies, episodes)


def _required_task(config: EvaluationConfig) -> str | None:
    return None if config.allow_other_task else config.env_id


def _open(config: EvaluationConfig, policy: str | Path, env: gym.Env[Any, Any]) -> Policy:
    world: Any = env.unwrapped
    return open_policy(
        policy,
        env_id=config.env_id if policy == RANDOM else _required_task(config),
        ground_truth=getattr(world, "ground_truth", None),
        seed=config.seed if policy == RANDOM else 0,
        device=getattr(world, "device", "cpu"),
    )


def _run(
    config: EvaluationConfig, found: str | Path
) -> tuple[list[EpisodeRecord], list[EpisodeRecord] | None, EpisodeLimits, Policy]:
    """The policy's episodes, the baseline's if wanted, when the task ends an episode, and the policy."""
    episodes, limits, policy = _run_policy(config, found)
    baseline = None
    if config.baseline:
        logger.info("the same episodes with random actions, to compare")
        baseline = _run_policy(config, RANDOM)[0]
    return episodes, baseline, limits, policy


def _run_policy(
    config: EvaluationConfig, found: str | Path
) -> tuple[list[EpisodeRecord], EpisodeLimits, Policy]:
    def make(num_envs: int) -> tuple[gym.Env[Any, Any], Policy]:
        env = make_env(config.env_id, num_envs, colours=needs_colours(found), **config.env_options)
        return env, _open(config, found, env)

    env, policy = open_widest(make, min(config.num_envs, config.episodes))
    try:
        limits = EpisodeLimits(
            threshold=float(cast(Any, env.unwrapped).task.full_visibility),
            horizon=find_task(config.env_id).max_episode_steps,
        )
        episodes = run_episodes(env, policy, config.episodes, config.seed, config.show_progress)
    finally:
        env.close()
    return episodes, limits, policy


def _with_true_association(config: EvaluationConfig, found: str | Path) -> list[EpisodeRecord] | None:
    """The policy's episodes when the truth tells which fruit each detection is; None where no camera decides, or the
    options say already who tells."""
    options = config.env_options
    if options.get("perception", "ground_truth") == "ground_truth" or "association" in options:
        return None
    if base_of(config.env_id) == ROW_ID:
        return None
    logger.info("the same episodes with a true association, to compare")
    env = make_env(config.env_id, colours=needs_colours(found), **options, association="truth")
    try:
        policy = _open(config, found, env)
        return run_episodes(env, policy, config.episodes, config.seed, config.show_progress)
    finally:
        env.close()


def _seeable(config: EvaluationConfig, episodes: Sequence[EpisodeRecord]) -> dict[int, set[int]] | None:
    """The tomatoes of each row that can be seen, by its seed; None where no inspection list is judged."""
    if any(e.row is None or e.row.listed is None for e in episodes):
        return None
    logger.info("asking the truth which tomatoes of the rows can be seen")
    env = make_env(config.env_id, **without_camera(config.env_options))
    try:
        return {e.seed: set(seeable_in_row(env, e.seed)) for e in episodes}
    finally:
        env.close()


def _plot_episodes(
    config: EvaluationConfig, episodes: Sequence[EpisodeRecord], threshold: float
) -> list[ReportPicture]:
    out, count = config.out, len(episodes)
    plots.plot_steps(episodes, out / "steps.png")
    plots.plot_visible_fraction(episodes, threshold, out / "visible_fraction.png")
    plots.plot_trajectories(episodes, "the first episodes", out / "trajectories.png")
    drawn = min(count, plots.SHOWN_TRAJECTORIES)
    return [
        ReportPicture(
            path=out / "steps.png", caption=f"Moves that each of n = {count} episodes took (thesis Fig. 5-6)."
        ),
        ReportPicture(
            path=out / "visible_fraction.png",
            caption="Visible fraction V_f of the target (0 to 1) at the start and at its best in each of "
            f"n = {count} episodes (thesis Fig. 5-7).",
        ),
        ReportPicture(
            path=out / "trajectories.png",
            caption=f"Way of the end-effector in the first {drawn} of n = {count} episodes, in metres, from two "
            "sides, with the camera at the first, middle and last pose (thesis Fig. 5-8).",
        ),
    ]


def _plot_training(config: EvaluationConfig, policy: Path | None) -> list[ReportPicture]:
    """Curves of the training that the configuration names, or of the one beside the policy."""
    run = config.training_run
    if run is None and policy is not None and (policy.parent / "history.npz").is_file():
        run = policy.parent
    if run is None:
        return []
    path = config.out / "training_curves.png"
    history = load_history(run)
    plots.plot_training_curves(history, path)
    episodes, steps = len(history.episodes["steps"]), len(history.step_reward)
    return [
        ReportPicture(
            path=path,
            caption=f"Loss and reward of each of n = {episodes:,} training episodes, reward and visible fraction "
            f"V_f (0 to 1) of each of {steps:,} steps; one training (thesis Fig. 5-1 to 5-4).",
        )
    ]


def _worth_watching(episodes: Sequence[EpisodeRecord], count: int) -> list[int]:
    """Seeds of the episodes to film: solved ones first, and of these the ones nearest to `FILM_MOVES` moves."""
    order = sorted(episodes, key=lambda e: (not e.success, abs(e.steps - FILM_MOVES), e.seed))
    return [episode.seed for episode in order[:count]]


def _film(config: EvaluationConfig, found: str | Path, seeds: list[int]) -> FilmedEpisodes:
    """Films some episodes, with the first and last view of the first of them."""
    from maniskill_tomato.experiments.film import film_episodes, make_film_options, poster_of

    logger.info("filming %d episodes", len(seeds))
    env = make_env(config.env_id, **make_film_options(config.env_options))
    path = config.out / "video.mp4"
    try:
        films = film_episodes(env, _open(config, found, env), seeds, path)
    finally:
        env.close()
    first = films[0]
    steps = "1 step" if first.steps == 1 else f"{first.steps} steps"
    pictures: list[ReportPicture] = []
    for name, image, caption in (
        (
            "first_view",
            first.first.wrist,
            f"First view of the wrist camera in episode {first.seed}, V_f {first.first.visible_fraction:.2f}.",
        ),
        (
            "last_view",
            first.last.wrist,
            f"Last view, after {steps}, V_f {first.last.visible_fraction:.2f} (thesis Fig. 5-9).",
        ),
        ("first_pose", first.first.outside, f"The robot and the plant at the start of episode {first.seed}."),
        ("last_pose", first.last.outside, f"At its end, after {steps}."),
    ):
        picture = config.out / f"{name}.png"
        write_picture(picture, image)
        pictures.append(ReportPicture(path=picture, caption=caption))
    poster = config.out / "poster.jpg"
    write_picture(poster, poster_of(films), 88)
    return FilmedEpisodes(video=path, poster=poster, count=len(seeds), views=pictures)
