"""Rows searched by policies: which tomatoes were seen, which can be seen at all, and what it cost."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from tqdm import tqdm

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.camera_metrics import summarise_inspections
from maniskill_tomato.experiments.configs import RowBenchmarkConfig
from maniskill_tomato.experiments.episode_listing import episode_list, list_episodes
from maniskill_tomato.experiments.episode_record import EpisodeRecord, RowSearch
from maniskill_tomato.experiments.policy_runs import Condition, parse_policies, run_policies
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.experiments.statistics import mean_interval, sign_flip_p
from maniskill_tomato.files import write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.oracle import FARTHEST, SHOULDER, shell_points
from maniskill_tomato.report_design import (
    figure,
    markdown_table,
    paragraph,
    percent,
    report,
    section,
    table,
    tile,
    tiles,
)
from maniskill_tomato.report_plots import plot_intervals
from maniskill_tomato.robot.iiwa14 import READY_QPOS
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import MIN_DISTANCE, LookAtMover
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.sensing.perception_kinds import RENDERED, Perception
from maniskill_tomato.sensing.view_lattice import ViewLattice
from maniskill_tomato.tasks.row.row_config import GeneralTaskConfig
from maniskill_tomato.worker_pool import run_jobs

ENV_ID = "TomatoViewpointRow-v1"

SEEABLE = "seeable"
"""Name under which the store keeps the tomatoes of each row that can be seen."""

SAMPLES = 4096
"""Places round a tomato from which it is looked at, beside the lattice's candidates, before it counts as hidden."""

FARTHEST_VIEW = 0.75
"""Farthest of them from the tomato, in [m]; the lattice's last is 0.74 m."""

CAMERA_OPTIONS = ("perception", "render_backend", "association", "target", "map_noise")
"""Options of a task that only a robot with a camera has."""

_BLOCK = 128


HEAD = (
    "policy",
    "seen of the seeable",
    "95 %, by row",
    "seen of all",
    "moves per tomato seen",
    "rows finished",
    "moves",
    "way of the camera [m]",
    "joints [rad]",
    "transits",
    "refused moves",
    "moves with contact",
)

METHOD = (
    "A tomato is seeable if the arm can take a place from which more than 80 % of it is visible; the truth says so. "
    "The interval is a bootstrap's over the rows, each counting once. A row is finished when every tomato in reach was "
    "seen; a robot with a camera ends the search itself, when nothing seems worth another move. Moves, the ways of "
    "camera and joints, and transits are means over the rows. A transit is a move by way of the arm's ready posture. "
    "Refused moves and moves with contact (the arm in the plants) are shares of the moves that the policy asked for."
)

INSPECTION = (
    "The robot lists the tomatoes that it found, with place and radius. Recall is the share of the seeable tomatoes "
    "that are listed as fully visible and truly were. Precision is the share of the tomatoes listed as ripe that are "
    "ripe and listed once. Fully seen and ripe is the share of those listed as ripe and fully visible that are both. "
    "Errors of place and radius are those of the tomatoes that are right."
)

PAIRED = (
    "The first policy minus the second on the same rows, each counting once: the mean with its 95 % interval "
    "(bootstrap) and the p-value of a sign-flip permutation test, not corrected for the number of pairs."
)

PAIRED_HEAD = ("policies", "share seen", "95 % interval", "p", "moves", "95 % interval", "p")


@dataclass(frozen=True, kw_only=True)
class RowBenchmark:
    """What a benchmark of rows found and wrote."""

    text: str
    """The table and the comparison of every two policies, as Markdown."""
    report: Path
    """report.html, which needs no other file."""


def run_row_benchmark(config: RowBenchmarkConfig) -> RowBenchmark:
    """Searches the rows that are not in the folder yet; writes rows-SPLIT-TRANSITS.json and report.html.

    Raises:
        InvalidInputError: An option cannot be used, or the folder holds another benchmark.
        CheckpointError: Another process measures in the folder.
    """
    with only_writer(config.out, "measures"):
        return _run_benchmark(config)


def _run_benchmark(config: RowBenchmarkConfig) -> RowBenchmark:
    specs = parse_policies(config.policies)
    name = f"{config.split}-{config.transits}"
    options: dict[str, Any] = {"plant": {"seed": config.split, "pool": None}, "transits": config.transits}
    if config.perception != "ground_truth":
        name += f"-{config.perception}"
        options |= camera_options(config.perception)
    condition = Condition(name=name, env_id=ENV_ID, env_options=options)
    settings = {"env_id": ENV_ID, "package_version": maniskill_tomato.__version__}
    store = ResultStore(config.out, settings, {f"policy {spec.label}": spec.fingerprint for spec in specs})
    seeds = range(config.seed, config.seed + config.rows)
    jobs = [(condition, seed) for seed in store.missing(SEEABLE, config.split, seeds)]
    with tqdm(total=len(jobs), unit="row", desc="what can be seen", disable=None if jobs else True) as bar:
        for (_, seed), fruits in run_jobs(_seeable_in_row, jobs, config.jobs):
            store.add(SEEABLE, config.split, {seed: {"fruits": fruits}})
            bar.update()
    run_policies(store, [(condition, specs, seeds)], config.jobs)
    results = {spec.label: store.episodes(name, spec.label, seeds) for spec in specs}
    known = store.read(SEEABLE, config.split)
    # What was seen can be seen, even where the samples missed the view.
    seeable = {
        seed: set(known[seed]["fruits"]).union(*(searched(rows[i]).seen for rows in results.values()))
        for i, seed in enumerate(seeds)
    }
    path = config.out / f"rows-{name}.json"
    write_json(path, _content(results, seeable))
    parts = [rows_table(results, seeable)]
    if len(results) > 1:
        parts.append(markdown_table(PAIRED_HEAD, compare_rows(results, seeable)) + "\n")
    if config.perception != "ground_truth":
        parts.insert(1, inspection_table(results, seeable))
    sources = {spec.label: spec.source for spec in specs}
    return RowBenchmark(text="\n".join(parts), report=_write_report(config, results, seeable, sources))


def _write_report(
    config: RowBenchmarkConfig,
    results: Mapping[str, Sequence[EpisodeRecord]],
    seeable: Mapping[int, set[int]],
    sources: Mapping[str, str],
) -> Path:
    """Writes report.html with the plot of its first table."""
    shares = {
        name: (_both_share(episodes, seeable), *mean_interval([_seen_share(e, seeable) for e in episodes]))
        for name, episodes in results.items()
    }
    plot = config.out / "seen.png"
    plot_intervals(shares, "Seen of the seeable tomatoes", "share of tomatoes", plot, (0.0, 1.0))
    threshold = GeneralTaskConfig().full_visibility
    count = f"n = {config.rows} rows"

    def listed(name: str, episodes: Sequence[EpisodeRecord]) -> str:
        def replay(seed: int) -> str:
            words = ["--policies", sources[name], "--rows", "1", "--seed", str(seed), "--split", config.split]
            words += ["--transits", config.transits, "--perception", config.perception]
            return shlex.join(["maniskill-tomato", "benchmark-rows", *words, "--out", f"runs/again-{seed}"])

        return episode_list(list_episodes(episodes, threshold, None, replay), name, "row")

    best = max(shares, key=lambda name: shares[name][0])
    share, low, high = shares[best]
    rows = [searched(e) for e in results[best]]
    seen = sum(len(r.seen) for r in rows)
    inspections = (
        section(
            f"Inspection lists, {count} a policy",
            table(INSPECTION_HEAD, _inspection_cells(results, seeable)),
            paragraph(INSPECTION, "caption"),
        )
        if config.perception != "ground_truth"
        else ""
    )
    return report(
        config.out,
        "Rows searched by policies",
        f"{_row_counts(results, seeable)}; split {config.split}, perception {config.perception}",
        [
            tiles(
                tile(
                    percent(share),
                    f"of the seeable tomatoes seen by {best}, the best",
                    count,
                    f"95 % interval over the rows {percent(low)} to {percent(high)}",
                ),
                tile(
                    f"{sum(r.moves for r in rows) / max(seen, 1):.2f} moves",
                    "for each tomato seen",
                    f"n = {seen} tomatoes",
                ),
                tile(
                    f"{sum(r.path_m for r in rows) / len(rows):.1f} m",
                    "way of the camera for a row, mean",
                    count,
                ),
            ),
            section(
                f"Policies, {count} each",
                table(HEAD, _rows_cells(results, seeable)),
                paragraph(METHOD, "caption"),
                figure(
                    plot,
                    f"Share of the seeable tomatoes that each policy saw (0 to 1), with 95 % intervals over {count}.",
                ),
            ),
            inspections,
            section(
                f"Paired differences, {count}",
                table(PAIRED_HEAD, compare_rows(results, seeable)),
                paragraph(PAIRED, "caption"),
            )
            if len(results) > 1
            else "",
            section(
                "Rows, failures first",
                paragraph(
                    "A row is solved when every tomato in reach was seen. V_f is the visible fraction (0 to 1) of the "
                    "tomato that was the target. The command searches the row again."
                ),
                *(listed(name, episodes) for name, episodes in results.items()),
            ),
        ],
        run_facts(),
    )


def camera_options(perception: Perception) -> dict[str, Any]:
    """The options of a task that is seen through a camera."""
    return {"perception": perception, **({"render_backend": "auto"} if perception in RENDERED else {})}


def without_camera(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a task less those of a camera: the truth needs none."""
    return {name: value for name, value in options.items() if name not in CAMERA_OPTIONS}


def searched(record: EpisodeRecord) -> RowSearch:
    """What an episode of a row came to.

    Raises:
        InvalidInputError: It is an episode of another task.
    """
    if record.row is None:
        raise InvalidInputError(f"episode {record.seed} is not the search of a row")
    return record.row


def seeable_in_row(env: gym.Env[Any, Any], seed: int) -> list[int]:
    """The tomatoes of the row of a seed that the arm can see fully, as indices in `Plant.fruits`."""
    env.reset(seed=seed)
    world: Any = env.unwrapped
    return SeeableTomatoes(env).among(world.open_targets(0))


def _seeable_in_row(job: tuple[Condition, int]) -> list[int]:
    condition, seed = job
    env = make_env(condition.env_id, **without_camera(condition.env_options))
    try:
        return seeable_in_row(env, seed)
    finally:
        env.close()


class SeeableTomatoes:
    """Asks the truth which tomatoes of a row the arm can see fully, from any place and in any posture.

    Samples may miss a narrow view, so that a tomato that is said to be hidden may yet be seen; one that is said to be
    seeable can be: the arm takes the place within its joint limits and is itself among what hides the tomato.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Follows an environment of `TomatoViewpointRow-v1`."""
        world: Any = env.unwrapped
        self._world: Any = world
        self._mover = LookAtMover(world.device)
        self._ready = torch.tensor(READY_QPOS, device=world.device)
        spread = shell_points(SAMPLES, MIN_DISTANCE, FARTHEST_VIEW).to(world.device)
        self._offsets = torch.cat([ViewLattice(world.device).offsets, spread])

    def among(self, fruits: Sequence[int], env_index: int = 0) -> list[int]:
        """Those of some fruits that can be seen."""
        return [
            fruit for fruit in fruits if self.best_view(fruit, env_index) > self._world.task.full_visibility
        ]

    def best_view(self, fruit: int, env_index: int = 0) -> float:
        """V_f of the first sampled view that is good enough, or of the best one."""
        target = self._world.fruit_position_w(env_index, fruit).double()
        places = target + self._offsets
        shoulder = places.new_tensor(SHOULDER)
        places = places[((places - shoulder).norm(dim=-1) <= FARTHEST) & (places[:, 2] > 0.0)]
        best = 0.0
        for first in range(0, len(places), _BLOCK):
            block = places[first : first + _BLOCK]
            padded = torch.cat([block, block[:1].expand(_BLOCK - len(block), 3)])
            look = self._mover.look_from(
                self._ready.expand(_BLOCK, 7), padded, target.expand(_BLOCK, 3), largest_joint_step=10.0
            )
            good = look.reach == int(Reach.REACHABLE)
            if not bool(good.any()):
                continue
            seen = self._world.ground_truth.visible_fraction(
                look.T_world_camera[good], env_index, look.qpos[good], fruit
            )
            best = max(best, float(seen.max()))
            if best > self._world.task.full_visibility:
                break
        return best


def rows_table(results: Mapping[str, Sequence[EpisodeRecord]], seeable: Mapping[int, set[int]]) -> str:
    """The policies' figures as Markdown.

    Args:
        results: Of each policy, on the same rows.
        seeable: The tomatoes that can be seen, by the row's seed.
    """
    return f"{_row_counts(results, seeable)}.\n\n{markdown_table(HEAD, _rows_cells(results, seeable))}\n"


def _row_counts(results: Mapping[str, Sequence[EpisodeRecord]], seeable: Mapping[int, set[int]]) -> str:
    first = next(iter(results.values()))
    wanted, possible = _tomatoes(first, seeable)
    return f"{len(first)} rows, {wanted} tomatoes in reach, {possible} of them seeable"


def _tomatoes(episodes: Sequence[EpisodeRecord], seeable: Mapping[int, set[int]]) -> tuple[int, int]:
    """Tomatoes in reach, and those of them that can be seen."""
    return sum(len(searched(e).targets) for e in episodes), sum(len(seeable[e.seed]) for e in episodes)


def _both_share(episodes: Sequence[EpisodeRecord], seeable: Mapping[int, set[int]]) -> float:
    """Share of all rows' seeable tomatoes that were seen."""
    both = sum(len(seeable[e.seed] & set(searched(e).seen)) for e in episodes)
    return both / max(_tomatoes(episodes, seeable)[1], 1)


def _rows_cells(
    results: Mapping[str, Sequence[EpisodeRecord]], seeable: Mapping[int, set[int]]
) -> list[tuple[str, ...]]:
    wanted, _ = _tomatoes(next(iter(results.values())), seeable)
    lines: list[tuple[str, ...]] = []
    for name, episodes in results.items():
        rows = [searched(e) for e in episodes]
        count, asked = len(rows), sum(e.steps for e in episodes)
        seen = sum(len(r.seen) for r in rows)
        low, high = mean_interval([_seen_share(e, seeable) for e in episodes])
        touched = sum(int(e.contact.sum()) for e in episodes if e.contact is not None)
        lines.append(
            (
                name,
                percent(_both_share(episodes, seeable)),
                f"{100 * low:.1f} to {percent(high)}",
                percent(seen / max(wanted, 1)),
                f"{sum(r.moves for r in rows) / max(seen, 1):.2f}",
                percent(sum(e.success for e in episodes) / count, 0),
                f"{sum(r.moves for r in rows) / count:.1f}",
                f"{sum(r.path_m for r in rows) / count:.1f}",
                f"{sum(r.joint_path_rad for r in rows) / count:.0f}",
                f"{sum(r.transits for r in rows) / count:.1f}",
                percent(sum(int(e.refused.sum()) for e in episodes) / asked, 0),
                percent(touched / asked, 0),
            )
        )
    return lines


INSPECTION_HEAD = (
    "policy",
    "recall",
    "precision",
    "fully seen and ripe",
    "place, median [mm]",
    "radius, median [mm]",
    "moves",
)


def inspection_table(results: Mapping[str, Sequence[EpisodeRecord]], seeable: Mapping[int, set[int]]) -> str:
    """What the policies' inspection lists are worth, as Markdown; see `summarise_inspections`."""
    return markdown_table(INSPECTION_HEAD, _inspection_cells(results, seeable)) + "\n"


def _inspection_cells(
    results: Mapping[str, Sequence[EpisodeRecord]], seeable: Mapping[int, set[int]]
) -> list[tuple[str, ...]]:
    lines: list[tuple[str, ...]] = []
    for name, episodes in results.items():
        figures = summarise_inspections(episodes, seeable, GeneralTaskConfig().full_visibility)
        shares = [figures[key] for key in ("recall", "precision", "full_precision")]
        errors = [figures[key] for key in ("position_error_median_m", "radius_error_median_m")]
        lines.append(
            (
                name,
                *("none" if share is None else percent(share) for share in shares),
                *("none" if error is None else f"{1e3 * error:.1f}" for error in errors),
                f"{figures['mean_moves']:.1f}",
            )
        )
    return lines


def compare_rows(
    results: Mapping[str, Sequence[EpisodeRecord]], seeable: Mapping[int, set[int]]
) -> list[tuple[str, ...]]:
    """One line with `PAIRED_HEAD` for every two policies."""
    lines: list[tuple[str, ...]] = []
    for a, b in combinations(results, 2):
        pairs = list(zip(results[a], results[b], strict=True))
        cells = []
        for values in (
            [_seen_share(x, seeable) - _seen_share(y, seeable) for x, y in pairs],
            [float(searched(x).moves - searched(y).moves) for x, y in pairs],
        ):
            low, high = mean_interval(values)
            mean = sum(values) / len(values)
            cells += [f"{mean:+.3f}", f"{low:+.3f} to {high:+.3f}", f"{sign_flip_p(values):.3f}"]
        lines.append((f"{a} minus {b}", *cells))
    return lines


def _seen_share(record: EpisodeRecord, seeable: Mapping[int, set[int]]) -> float:
    """Share of a row's seeable tomatoes that were seen; 1 where there is none."""
    possible = seeable[record.seed]
    return len(possible & set(searched(record).seen)) / len(possible) if possible else 1.0


def _content(
    results: Mapping[str, Sequence[EpisodeRecord]], seeable: Mapping[int, set[int]]
) -> dict[str, Any]:
    """The content of rows-SPLIT-TRANSITS.json."""
    return {
        "seeable": {str(seed): sorted(fruits) for seed, fruits in seeable.items()},
        "rows": {
            label: {
                str(e.seed): {
                    "seed": e.seed,
                    "finished": e.success,
                    "asked": e.steps,
                    "refused": int(e.refused.sum()),
                    "contacts": 0 if e.contact is None else int(e.contact.sum()),
                    **{name: value for name, value in vars(searched(e)).items() if value is not None},
                }
                for e in episodes
            }
            for label, episodes in results.items()
        },
    }
