"""An evaluation from policy to report: episodes, metrics, plots, pictures, film, page."""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments import plots
from maniskill_tomato.experiments.comparison import Run
from maniskill_tomato.experiments.metrics import make_metrics, write_metrics
from maniskill_tomato.experiments.report import Picture, ReportInput, write_report
from maniskill_tomato.experiments.rollout import Episode, run_episodes
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.history import load_history
from maniskill_tomato.policies.adapters import as_policy, as_state_policy, describe
from maniskill_tomato.policies.opening import RANDOM, open_policy
from maniskill_tomato.policies.protocol import Policy, StatePolicy
from maniskill_tomato.rendering import vulkan_probe

logger = logging.getLogger(__name__)

LEFT_OUT = (
    "Left out because this machine cannot render: the film, and the first and last views of the camera. {hint}. "
    "Then run this evaluation again."
)


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """What to evaluate and what to write."""

    env_id: str
    episodes: int
    seed: int
    out: Path
    """Folder of the results."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options for `gymnasium.make` beside the defaults, for instance another plant."""
    baseline: bool = True
    """Also run uniformly random actions from the same seeds."""
    video: bool = True
    """Film the first episodes where the machine can render."""
    films: int = 3
    """How many episodes to film."""
    title: str = "Evaluation"
    training_run: Path | None = None
    """A run whose training curves the report shows."""
    training_windows: tuple[int, int] | None = None
    """Moving-average windows of those curves, in episodes and steps."""
    show_progress: bool = True


@dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """What an evaluation wrote."""

    metrics: dict[str, Any]
    report: Path
    video: Path | None
    left_out: str | None
    """Which pictures are missing and how to get them; None if none are."""


def evaluate(
    config: EvaluationConfig, policy: Policy | StatePolicy | str, policy_path: Path | None = None
) -> EvaluationResult:
    """Evaluates `policy` and writes metrics.json, trajectories.npz, plots, pictures, a film and report.html.

    Args:
        config: What to evaluate and where to write.
        policy: Chooses the actions, without exploration; a string names a planner for the general tasks.
        policy_path: Its file, for the record.

    Returns:
        Metrics and the paths of what was written.
    """
    start = time.perf_counter()
    episodes, baseline, threshold = _run(config, policy)
    description = _describe(policy, policy_path)
    metrics = make_metrics(
        config.env_id,
        episodes,
        seed=config.seed,
        success_threshold=threshold,
        policy=description,
        wall_seconds=time.perf_counter() - start,
        baseline=baseline,
    )
    config.out.mkdir(parents=True, exist_ok=True)
    write_metrics(config.out / "metrics.json", metrics)
    write_trajectories(config.out / "trajectories.npz", episodes)
    evaluation, training = _plot(config, episodes, threshold)
    views: list[Picture] = []
    video = left_out = None
    if config.video:
        if vulkan_probe.rendering_available():
            video, views = _film(config, policy)
        else:
            left_out = LEFT_OUT.format(hint=vulkan_probe.NO_RENDERING_HINT)
    report = config.out / "report.html"
    facts = {key.replace("_", " "): str(value) for key, value in description.items() if key != "path"}
    facts["evaluation time"] = f"{metrics['wall_seconds']:.0f} s"
    content = ReportInput(
        title=config.title,
        metrics=metrics,
        facts=facts,
        training=training,
        evaluation=evaluation,
        views=views,
        video=video,
        policy=policy_path,
        left_out=left_out,
    )
    write_report(report, content)
    return EvaluationResult(metrics=metrics, report=report, video=video, left_out=left_out)


def evaluate_run(run: Run, episodes: int, seed: int) -> EvaluationResult:
    """Evaluates the policy of a run on the task and plants of its training; the results go into its folder `eval`.

    Args:
        run: Its folder holds `policy.pt`, or `policy.onnx` if another learner trained it.
        episodes: How many episodes.
        seed: Seed of the first; the others follow.

    Raises:
        InvalidInputError: The folder holds neither.
        CheckpointError: Its policy cannot be read.
    """
    policies = [path for name in ("policy.pt", "policy.onnx") if (path := run.path / name).is_file()]
    if not policies:
        raise InvalidInputError(
            f"{run.path} holds no policy to evaluate (policy.pt or policy.onnx); finish the run with "
            f"`maniskill-tomato train --resume {run.path}`, or compare without evaluating"
        )
    config = EvaluationConfig(
        env_id=run.env_id,
        episodes=episodes,
        seed=seed,
        out=run.path / "eval",
        env_options=run.config.get("env_options", {}),
        baseline=False,
        video=False,
        title=f"Evaluation of {run.path.name}",
        training_run=run.path if (run.path / "history.npz").is_file() else None,
    )
    logger.info("evaluating %s", run.path)
    return evaluate(config, open_policy(policies[0], env_id=run.env_id), policies[0])


def write_trajectories(path: Path, episodes: Sequence[Episode]) -> None:
    """Writes every view of every episode as arrays.

    `first_view[i]` is the row of episode i's start view in `viewpoints` (x, y, z [m], roll, pitch, yaw [rad])
    and `visible_fraction`; `target[i]` is its target's position [m].
    """
    lengths = np.array([len(e.visible_fraction) for e in episodes])
    np.savez_compressed(
        path,
        seed=np.array([e.seed for e in episodes]),
        first_view=np.concatenate(([0], np.cumsum(lengths)[:-1])),
        target=np.stack([e.target for e in episodes]),
        viewpoints=np.concatenate([e.viewpoints for e in episodes]),
        visible_fraction=np.concatenate([e.visible_fraction for e in episodes]),
    )


def _run(
    config: EvaluationConfig, policy: Policy | StatePolicy | str
) -> tuple[list[Episode], list[Episode] | None, float]:
    """The policy's episodes, the baseline's if wanted, and the task's threshold of V_f."""
    env = make_env(config.env_id, **config.env_options)
    try:
        threshold = float(cast(Any, env.unwrapped).task.full_visibility)
        episodes = run_episodes(
            env, opened_in(env, policy, config), config.episodes, config.seed, config.show_progress
        )
        baseline = None
        if config.baseline:
            logger.info("the same episodes with random actions, to compare")
            random = opened_in(env, RANDOM, config)
            baseline = run_episodes(env, random, config.episodes, config.seed, config.show_progress)
    finally:
        env.close()
    return episodes, baseline, threshold


def _plot(
    config: EvaluationConfig, episodes: Sequence[Episode], threshold: float
) -> tuple[list[Picture], list[Picture]]:
    """Plots of the evaluation and, where a run is given, of its training."""
    out = config.out
    plots.plot_steps(episodes, out / "steps.png")
    plots.plot_visible_fraction(episodes, threshold, out / "visible_fraction.png")
    plots.plot_trajectories(episodes, out / "trajectories.png")
    evaluation = [
        Picture(path=out / "steps.png", caption="Steps that each episode took (thesis Fig. 5-6)."),
        Picture(
            path=out / "visible_fraction.png",
            caption="Visible fraction of the target at the start and at its best in each episode (thesis Fig. 5-7).",
        ),
        Picture(
            path=out / "trajectories.png",
            caption="Way of the end-effector in the first episodes, with the viewing direction at the first, "
            "middle and last pose (thesis Fig. 5-8).",
        ),
    ]
    if config.training_run is None:
        return evaluation, []
    path = out / "training_curves.png"
    plots.plot_training_curves(load_history(config.training_run), path, config.training_windows)
    caption = (
        "Loss and reward of each episode, reward and visible fraction of each step (thesis Fig. 5-1 to 5-4)."
    )
    return evaluation, [Picture(path=path, caption=caption)]


def _film(config: EvaluationConfig, policy: Policy | StatePolicy | str) -> tuple[Path, list[Picture]]:
    """Films the first episodes; returns the film and the first and last view of the first one."""
    from maniskill_tomato.experiments.video import film_episodes, make_film_options

    count = min(config.films, config.episodes)
    logger.info("filming %d episodes", count)
    options = {"render_backend": vulkan_probe.render_backend(), **make_film_options(), **config.env_options}
    env = make_env(config.env_id, **options)
    path = config.out / "video.mp4"
    try:
        acting = as_state_policy(opened_in(env, policy, config), env)
        films = film_episodes(env, acting, [config.seed + i for i in range(count)], path)
    finally:
        env.close()
    first = films[0]
    start, end = first.first_visible_fraction, first.last_visible_fraction
    steps = "1 step" if first.steps == 1 else f"{first.steps} steps"
    pictures: list[Picture] = []
    for name, image, caption in (
        ("first_view", first.first_wrist, f"First view of the wrist camera, V_f {start:.2f}."),
        ("last_view", first.last_wrist, f"Last view, after {steps}, V_f {end:.2f} (thesis Fig. 5-9)."),
        ("first_pose", first.first_outside, "The robot and the plant at the start."),
        ("last_pose", first.last_outside, "At the end of the episode."),
    ):
        picture = config.out / f"{name}.png"
        imageio.imwrite(picture, image)
        pictures.append(Picture(path=picture, caption=caption))
    return path, pictures


def opened_in(
    env: gym.Env[Any, Any], policy: Policy | StatePolicy | str, config: EvaluationConfig
) -> Policy | StatePolicy:
    """A policy that can act in an environment; a name is opened with what the environment knows."""
    if not isinstance(policy, str):
        return policy
    return open_policy(
        policy,
        env_id=config.env_id,
        ground_truth=getattr(env.unwrapped, "ground_truth", None),
        seed=config.seed,
        device=getattr(env.unwrapped, "device", "cpu"),
    )


def _describe(policy: Policy | StatePolicy | str, path: Path | None) -> dict[str, Any]:
    """Where a policy comes from, for metrics.json."""
    if isinstance(policy, str):
        return {"path": None, "kind": policy}
    return {"path": None if path is None else str(path), **describe(as_policy(policy))}
