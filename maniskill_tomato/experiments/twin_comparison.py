"""The twin of `deploy` and the simulated task on the same episodes with the same policy."""

import json
import shlex
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import gymnasium as gym
import numpy as np

import maniskill_tomato
from maniskill_tomato.deploy.decision import TASK, default_policy
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.mock.twin_world import TwinOptions, twin_options
from maniskill_tomato.deploy.policy_run import RunConfig, run
from maniskill_tomato.deploy.profile import Profile, load_profile
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.configs import TwinConfig
from maniskill_tomato.experiments.episode_listing import ListedEpisode, episode_list
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.experiments.statistics import mcnemar_p, wilson_interval
from maniskill_tomato.files import write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.plants.mesh_set import ALL
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.report_design import figure, paragraph, percent, report, section, table, tile, tiles
from maniskill_tomato.report_plots import plot_intervals
from maniskill_tomato.run_facts import run_facts

FIGURES: Final = {
    "twin_success": "successes of the twin",
    "twin_interval_95": "share of successes of the twin, 95 % interval (Wilson)",
    "twin_success_and_truly_visible": "successes of the twin with the target truly visible",
    "truly_visible_share_of_success": "their share of the twin's successes",
    "truly_visible_share_interval_95": "its 95 % interval (Wilson)",
    "simulation_success": "successes in the simulated task",
    "simulation_interval_95": "share of successes in the simulated task, 95 % interval (Wilson)",
    "only_twin": "episodes that only the twin solved",
    "only_simulation": "episodes that only the simulated task solved",
    "mcnemar_p": "p of McNemar's exact test",
    "reasons": "how the twin's runs ended",
    "failed": "episodes in which the twin failed",
    "false_success": "episodes in which the twin's success was not truly visible",
    "simulation_failed": "episodes in which the simulated task failed",
    "twin_moves_of_successes": "moves of a success of the twin, mean",
    "simulation_moves_of_successes": "moves of a success in the simulated task, mean",
    "refused_share_of_moves": "share of the twin's moves that were refused",
    "simulation_contact_share_of_episodes": "share of simulated episodes in which the arm touched the plant",
    "stage_ms_mean": "wall time of each part of a look and its move, mean [ms]",
    "stage_ms_p95": "the same, 95th percentile [ms]",
    "looks": "looks of the twin",
    "cpu_seconds_a_run": "processor time of a run, mean [s]",
    "cpu_seconds_a_row": "processor time of a row, mean [s]",
    "device_seconds_median": "time of a run by the twin's clock, median [s]",
    "device_seconds_a_row": "time of a row by the twin's clock, mean [s]",
    "seeable": "ripe fruits that the arm can see fully",
    "seen": "of these, listed as fully seen and truly seen",
    "listed_as_ripe": "fruits listed as ripe",
    "right": "of these, ripe and listed once",
    "recall": "recall: seen of the seeable",
    "precision": "precision: right of those listed as ripe",
    "full_precision": "share of those listed as ripe and fully seen that are both",
    "position_error_median_m": "error of the place, median [m]",
    "radius_error_median_m": "error of the radius, median [m]",
    "recall_interval_95": "recall, 95 % interval over the rows",
    "precision_interval_95": "precision, 95 % interval over the rows",
    "mean_moves": "moves of a row, mean",
}
"""What the entries of a summary are."""


def compare_twin(config: TwinConfig, tell: Callable[[str], None] = lambda line: None) -> dict[str, Any]:
    """Runs the episodes that are not in the folder yet; writes summary.json, report.html and a folder for each run.

    Args:
        config: What to compare.
        tell: Told one line after each episode.

    Returns:
        The content of summary.json.

    Raises:
        CheckpointError: Another process measures in the folder.
    """
    with only_writer(config.out, "measures"):
        return _compare(config, tell)


def _compare(config: TwinConfig, tell: Callable[[str], None]) -> dict[str, Any]:
    profile = load_profile(config.profile)
    store, episodes = twin_store(config, profile)
    numbers = range(config.seed, config.seed + config.episodes)
    missing = store.missing(episodes, "twin", numbers)
    if missing:
        policy = open_policy(config.policy or default_policy(), env_id=TASK)
        env = simulated_task(profile)
        try:
            for number in missing:
                record = run_episode(env, policy, number)
                twin = on_the_twin(profile, config, number)
                simulation = {
                    "success": record.success,
                    "moves": record.steps,
                    "contact": record.contact is not None and bool(record.contact.any()),
                    "visible_fraction": round(float(record.visible_fraction[-1]), 4),
                }
                result = {"episode": number, "twin": twin, "simulation": simulation}
                store.add(episodes, "twin", {number: result})
                tell(
                    f"{number:3d}  twin {twin['reason']:12} {twin.get('moves', 0):2d} moves   "
                    f"simulation {'success' if record.success else 'failure'} {record.steps:2d} moves"
                )
        finally:
            env.close()
    found = store.read(episodes, "twin")
    summary = summarise_twin([found[number] for number in numbers])
    write_json(config.out / "summary.json", summary)
    _write_report(config, profile, [found[number] for number in numbers], summary)
    return summary


def _write_report(
    config: TwinConfig, profile: Profile, episodes: Sequence[dict[str, Any]], summary: dict[str, Any]
) -> None:
    """Writes report.html with a plot of both rates."""
    count = len(episodes)
    of = f"n = {count} episodes"
    rates = {
        name: (summary[f"{name}_success"] / count, *summary[f"{name}_interval_95"])
        for name in ("twin", "simulation")
    }
    plot = config.out / "success.png"
    plot_intervals(rates, "Success on the same episodes", "share of episodes", plot, (0.0, 1.0))
    low, high = summary["twin_interval_95"]
    report(
        config.out,
        "The twin beside the simulated task",
        f"{count} episodes from {config.seed}, profile {profile.name}",
        [
            tiles(
                tile(
                    percent(rates["twin"][0]),
                    "solved by the twin",
                    of,
                    f"95 % interval {percent(low)} to {percent(high)}",
                    f"{summary['twin_success_and_truly_visible']} of {summary['twin_success']} truly visible",
                ),
                tile(percent(rates["simulation"][0]), "solved in the simulated task", of),
                tile(
                    f"p = {summary['mcnemar_p']:.2g}",
                    "McNemar's test of the difference",
                    f"{of}; solved by the twin only: {summary['only_twin']}, by the task only: "
                    f"{summary['only_simulation']}",
                ),
            ),
            paragraph(
                "The twin is the program of the robot, with a simulated arm and a simulated depth camera; the "
                "simulated task is what policies are trained and benchmarked on. Both run the same episodes with the "
                "same policy. The difference is what perception, depth noise, the arm's dynamics and the safety "
                "checks cost. An episode of the twin is a success when the robot believes that the target is fully "
                "visible; truly visible is what rays to the target say."
            ),
            section(
                "Success",
                figure(plot, f"Share of episodes solved (0 to 1), with 95 % intervals (Wilson); {of} each."),
            ),
            section(
                "Episodes of the twin, failures first",
                paragraph(
                    "A success in which the target was not truly visible is listed as failed. V_f (0 to 1) is what the "
                    "robot measured. The command runs the episode again."
                ),
                episode_list([_listed(config, one) for one in episodes]),
            ),
            figures_section(summary, of),
        ],
        run_facts(),
    )


def _listed(config: TwinConfig, episode: dict[str, Any]) -> ListedEpisode:
    """An episode of the twin as a line; a success in which the fruit was not truly visible is a failure."""
    twin = episode["twin"]
    seen = twin.get("visible_fractions") or (None,)
    truly = bool(twin.get("truly_visible"))
    false = "success that was not truly visible" if twin["success"] else f"{twin['reason']}: {twin['detail']}"
    return ListedEpisode(
        seed=episode["episode"],
        success=truly,
        reason="" if truly else false,
        moves=twin.get("moves", 0),
        start=seen[0],
        best=twin.get("best_visible_fraction"),
        command=replay_on_twin(config, episode["episode"], "run"),
    )


def replay_on_twin(config: TwinConfig, seed: int, command: str) -> str:
    """The `deploy run` or `deploy inspect` of one episode."""
    policy = [] if config.policy is None else ["--policy", config.policy]
    words = [
        "deploy",
        command,
        "--profile",
        config.profile,
        "--seed",
        str(seed),
        "--out",
        f"runs/again-{seed}",
    ]
    return shlex.join(["maniskill-tomato", *words, *policy])


def figures_section(summary: Mapping[str, Any], of: str) -> str:
    """All figures of a summary as a table; `of` says of how many."""

    def told(value: object) -> str:
        if isinstance(value, float):
            return f"{value:.4g}"
        if isinstance(value, dict):
            return ", ".join(f"{name.replace('_', ' ')}: {told(one)}" for name, one in value.items())
        if isinstance(value, (list, tuple)):
            return ", ".join(told(one) for one in value)
        return "none" if value is None else str(value)

    rows = [
        (FIGURES.get(name, name.replace("_", " ")), told(value))
        for name, value in summary.items()
        if value not in ([], {})
    ]
    return section(f"All figures, {of}", table(("figure", "value"), rows, words=(0, 1)))


def twin_store(config: TwinConfig, profile: Profile) -> tuple[ResultStore, str]:
    """Where the results are kept, and the list that the episodes are from.

    Raises:
        InvalidInputError: The folder holds results of another profile or policy.
        ProfileError: The profile is not of a twin.
    """
    settings = {
        "profile": profile.text,
        "policy": config.policy or default_policy(),
        "package_version": maniskill_tomato.__version__,
    }
    return ResultStore(config.out, settings), _options(profile).episodes


def simulated_task(profile: Profile) -> gym.Env[Any, Any]:
    """The simulated task with the episodes of a twin, without a camera.

    Raises:
        ProfileError: The profile is not of a twin.
    """
    options = _options(profile)
    plants: dict[str, Any] = {}
    if options.plants is not None:
        plants = {"plant": {"mesh": options.plants, "seed": ALL}}
    return make_env(TASK, episodes=options.episodes, **plants)


def _options(profile: Profile) -> TwinOptions:
    if profile.arm_driver != "mock" or profile.camera_driver != "mock":
        raise ProfileError(
            f"the profile {profile.name} is of the arm {profile.arm_driver} and the camera {profile.camera_driver}; "
            "only where both are mock is there a twin, whose truth is known"
        )
    return twin_options(profile.camera_options)


def on_the_twin(profile: Profile, config: TwinConfig, episode: int) -> dict[str, Any]:
    """One run as `deploy run` makes it."""
    began = time.process_time()
    out = config.out / f"{episode:03d}"
    try:
        result = run(
            RunConfig(profile=profile, out=out, policy=config.policy, seed=episode, record=config.record)
        )
    except TomatoError as error:
        return {"success": False, "reason": "cannot begin", "detail": str(error), "steps": []}
    content = result.to_json()
    content["steps"] = json.loads((out / "result.json").read_text())["steps"]
    true_fraction = result.true_visible_fraction
    seen = result.success and true_fraction is not None and true_fraction > profile.loop.threshold
    return {**content, "truly_visible": seen, "cpu_seconds": time.process_time() - began}


def summarise_twin(episodes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rates, their intervals, what differs, and what a look costs; None for a mean of nothing."""
    twin = [episode["twin"] for episode in episodes]
    wins = np.array(
        [
            [run["success"], episode["simulation"]["success"]]
            for run, episode in zip(twin, episodes, strict=True)
        ]
    )
    ran = [run for run in twin if "moves" in run]
    stages: dict[str, list[float]] = {}
    for one in ran:
        for step in one["steps"]:
            for stage, taken in step["timing_ms"].items():
                stages.setdefault(stage, []).append(taken)
    only_twin, only_simulation = int((wins[:, 0] & ~wins[:, 1]).sum()), int((~wins[:, 0] & wins[:, 1]).sum())
    won, truly = int(wins[:, 0].sum()), sum(bool(one.get("truly_visible")) for one in twin)
    moves = sum(one["moves"] for one in ran)
    return {
        "episodes": len(episodes),
        "twin_success": won,
        "twin_interval_95": wilson_interval(won, len(wins)),
        "twin_success_and_truly_visible": truly,
        "truly_visible_share_of_success": truly / won if won else None,
        "truly_visible_share_interval_95": wilson_interval(truly, won) if won else None,
        "simulation_success": int(wins[:, 1].sum()),
        "simulation_interval_95": wilson_interval(int(wins[:, 1].sum()), len(wins)),
        "only_twin": only_twin,
        "only_simulation": only_simulation,
        "mcnemar_p": mcnemar_p(only_twin, only_simulation),
        "reasons": dict(Counter(one["reason"] for one in twin)),
        "failed": [e["episode"] for e, one in zip(episodes, wins[:, 0], strict=True) if not one],
        "false_success": [
            e["episode"] for e in episodes if e["twin"]["success"] and not e["twin"]["truly_visible"]
        ],
        "simulation_failed": [e["episode"] for e, one in zip(episodes, wins[:, 1], strict=True) if not one],
        "twin_moves_of_successes": mean_of([one["moves"] for one in ran if one["success"]]),
        "simulation_moves_of_successes": mean_of(
            [e["simulation"]["moves"] for e in episodes if e["simulation"]["success"]]
        ),
        "refused_share_of_moves": sum(one["refused_moves"] for one in ran) / moves if moves else None,
        "simulation_contact_share_of_episodes": mean_of([e["simulation"]["contact"] for e in episodes]),
        "stage_ms_mean": {stage: round(float(np.mean(taken)), 2) for stage, taken in stages.items()},
        "stage_ms_p95": {stage: round(float(np.percentile(taken, 95)), 2) for stage, taken in stages.items()},
        "looks": sum(len(one["steps"]) for one in ran),
        "cpu_seconds_a_run": mean_of([one["cpu_seconds"] for one in ran]),
        "device_seconds_median": float(np.median([one["device_seconds"] for one in ran])) if ran else None,
    }


def mean_of(values: Sequence[float]) -> float | None:
    """None where there is no value."""
    return float(np.mean(values)) if values else None
