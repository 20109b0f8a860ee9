"""Rows that the twin of `deploy` inspects, judged as the simulated rows are."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, Final

import gymnasium as gym

from maniskill_tomato.deploy.inspection_run import inspect_row
from maniskill_tomato.deploy.policy_run import RunConfig
from maniskill_tomato.deploy.profile import Profile, load_profile
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.camera_metrics import list_figures
from maniskill_tomato.experiments.configs import TwinConfig
from maniskill_tomato.experiments.episode_listing import ListedEpisode, episode_list
from maniskill_tomato.experiments.row_benchmark import SeeableTomatoes
from maniskill_tomato.experiments.statistics import mean_interval
from maniskill_tomato.experiments.twin_comparison import (
    figures_section,
    mean_of,
    replay_on_twin,
    simulated_task,
    twin_store,
)
from maniskill_tomato.files import write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.report_design import paragraph, percent, report, section, tile, tiles
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.sensing.inspection_judge import JudgedFruit, score_lists, truly_seen
from maniskill_tomato.sensing.view_lattice import ViewLattice

ROWS: Final = "rows"
"""Name under which the store keeps the rows."""


def inspect_twin(config: TwinConfig, tell: Callable[[str], None] = lambda line: None) -> dict[str, Any]:
    """Inspects the rows that are not in the folder yet; writes rows.json, report.html and a folder for each row.

    Args:
        config: Which rows.
        tell: Told one line after each row.

    Returns:
        The content of rows.json.

    Raises:
        CheckpointError: Another process measures in the folder.
        ProfileError: The profile is not of a twin.
    """
    with only_writer(config.out, "measures"):
        return _inspect(config, tell)


def _inspect(config: TwinConfig, tell: Callable[[str], None]) -> dict[str, Any]:
    profile = load_profile(config.profile)
    store, episodes = twin_store(config, profile)
    numbers = range(config.seed, config.seed + config.episodes)
    missing = store.missing(episodes, ROWS, numbers)
    if missing:
        env = simulated_task(profile)
        try:
            for number in missing:
                row = {
                    "episode": number,
                    **_fruits_to_see(env, number),
                    **_inspected(profile, config, number),
                }
                store.add(episodes, ROWS, {number: row})
                alone = summarise_rows([row], profile.loop.threshold)
                tell(
                    f"{number:3d}  {row['reason']:12} {row['moves']:3d} moves   {alone['seen']} of {alone['seeable']} "
                    f"seeable ripe fruits, precision {alone['precision']}"
                )
        finally:
            env.close()
    found = store.read(episodes, ROWS)
    summary = summarise_rows([found[number] for number in numbers], profile.loop.threshold)
    write_json(config.out / "rows.json", summary)
    _write_report(config, profile, [found[number] for number in numbers], summary)
    return summary


def _write_report(
    config: TwinConfig, profile: Profile, rows: Sequence[dict[str, Any]], summary: dict[str, Any]
) -> None:
    """Writes report.html."""
    of = f"n = {len(rows)} rows"

    def share(name: str, label: str, count: str) -> str:
        value, interval = summary[name], summary[f"{name}_interval_95"]
        ends = "" if interval is None else f"95 % interval {percent(interval[0])} to {percent(interval[1])}"
        return tile("none" if value is None else percent(value), label, count, ends)

    listed = [_listed(config, row, profile.loop.threshold) for row in rows]
    report(
        config.out,
        "Rows inspected by the twin",
        f"{len(rows)} rows from {config.seed}, profile {profile.name}",
        [
            paragraph(
                "The twin is the program of the robot, with a simulated arm and a simulated depth camera. It looks at "
                "every ripe fruit of a row and lists what it found; the truth judges the list."
            ),
            tiles(
                share(
                    "recall",
                    "of the seeable ripe fruits seen",
                    f"n = {summary['seeable']} fruits in {len(rows)} rows",
                ),
                share(
                    "precision",
                    "of the fruits listed as ripe are ripe, each once",
                    f"n = {summary['listed_as_ripe']} fruits",
                ),
                tile(f"{summary['mean_moves']:.1f} moves", "a row, mean", of),
            ),
            section(
                "Rows, failures first",
                paragraph(
                    "A row is solved when every seeable ripe fruit was truly seen fully. A fruit is seeable if the "
                    "arm can take a place from which it is fully visible. The command inspects the row again."
                ),
                episode_list(listed, noun="row"),
            ),
            figures_section(summary, of),
        ],
        run_facts(),
    )


def _listed(config: TwinConfig, row: dict[str, Any], threshold: float) -> ListedEpisode:
    alone = summarise_rows([row], threshold)
    done = alone["seen"] == alone["seeable"]
    return ListedEpisode(
        seed=row["episode"],
        success=done,
        reason=""
        if done
        else f"{alone['seen']} of {alone['seeable']} seeable fruits seen; {row['reason']}: {row['detail']}",
        moves=row["moves"],
        start=None,
        best=None,
        command=replay_on_twin(config, row["episode"], "inspect"),
    )


def _fruits_to_see(env: gym.Env[Any, Any], number: int) -> dict[str, list[int]]:
    """The ripe fruits of an episode's row in reach of the arm, and those of them that it can see fully."""
    env.reset(seed=number)
    world: Any = env.unwrapped
    ripe: list[int] = world.plant_batch.ripe_fruits[0]
    fits = ViewLattice(world.device).in_reach(world.plant_batch.fruit_positions_w(0, ripe)).tolist()
    in_reach = [fruit for fruit, is_near in zip(ripe, fits, strict=True) if is_near]
    return {"in_reach": in_reach, "seeable": SeeableTomatoes(env).among(in_reach)}


def _inspected(profile: Profile, config: TwinConfig, number: int) -> dict[str, Any]:
    """One row as `deploy inspect` looks at it; the list of one that cannot begin is empty."""
    began = time.process_time()
    out = config.out / f"row_{number:03d}"
    try:
        done = inspect_row(
            RunConfig(profile=profile, out=out, policy=config.policy, seed=number, record=config.record)
        )
    except TomatoError as error:
        return {"reason": "cannot begin", "detail": str(error), "moves": 0, "refused_moves": 0, "listed": []}
    result = done.run
    return {
        "reason": result.reason,
        "detail": result.detail,
        "moves": result.moves,
        "refused_moves": result.refused_moves,
        "listed": [asdict(fruit) for fruit in done.judged],
        "device_seconds": result.device_seconds,
        "cpu_seconds": time.process_time() - began,
    }


def summarise_rows(rows: Sequence[dict[str, Any]], threshold: float) -> dict[str, Any]:
    """What the rows' lists are worth together, as those of the simulated rows are judged.

    Args:
        rows: One or more; `in_reach` and `seeable` are ripe fruits as indices in `Plant.fruits`, `listed` the list
            beside the truth.
        threshold: V_f above which a fruit is fully visible.

    Returns:
        The figures of `ListScore` with the counts behind them, 95 % intervals over the rows, moves and reasons.
    """
    lists = []
    for row in rows:
        judged = [JudgedFruit(**fruit) for fruit in row["listed"]]
        # What was seen can be seen, even where the samples missed the view.
        seen = truly_seen(judged, threshold) & set(row["in_reach"])
        lists.append((judged, set(row["seeable"]) | seen))
    score = score_lists(lists, threshold)
    alone = [score_lists([one], threshold) for one in lists]
    moves = sum(row["moves"] for row in rows)
    return {
        "rows": len(rows),
        "seeable": score.wanted,
        "seen": score.seen,
        "listed_as_ripe": score.listed,
        "right": len(score.right),
        **list_figures(score),
        "recall_interval_95": _interval([one.recall for one in alone]),
        "precision_interval_95": _interval([one.precision for one in alone]),
        "mean_moves": moves / len(rows),
        "refused_share_of_moves": sum(row["refused_moves"] for row in rows) / moves if moves else None,
        "reasons": dict(Counter(row["reason"] for row in rows)),
        "cpu_seconds_a_row": mean_of([row["cpu_seconds"] for row in rows if "cpu_seconds" in row]),
        "device_seconds_a_row": mean_of([row["device_seconds"] for row in rows if "device_seconds" in row]),
    }


def _interval(shares: Sequence[float | None]) -> tuple[float, float] | None:
    known = [share for share in shares if share is not None]
    return mean_interval(known) if known else None
