"""The benchmark: policies on the same held-out episodes, and sweeps over one difficulty at a time."""

import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.benchmark_report import (
    BenchmarkFigures,
    BenchmarkInput,
    summarise_runs,
    write_benchmark,
)
from maniskill_tomato.experiments.certified_episodes import PlantPlace, certified_list, parse_place
from maniskill_tomato.experiments.configs import BenchmarkConfig
from maniskill_tomato.experiments.episode_listing import replay_with_eval
from maniskill_tomato.experiments.policy_runs import Condition, PolicySpec, parse_policies, run_policies
from maniskill_tomato.experiments.result_store import ResultStore, fingerprint
from maniskill_tomato.experiments.view_grid import draw_view_grid
from maniskill_tomato.extension_points import source_file
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.plants.episode_list import EPISODE_LISTS, load_episodes
from maniskill_tomato.policies.registry import PRIVILEGED
from maniskill_tomato.rendering import vulkan_probe
from maniskill_tomato.task_registry import GENERAL_IDS, TASK_IDS, TASKS, find_task
from maniskill_tomato.tasks.making import make_options

MAIN = "held_out"
"""The condition on which policies are compared; also the name of its list of episodes."""

LEFT_OUT = "Left out because this machine cannot render: the grid of views. {hint}."

SWEEPS: dict[str, tuple[float, ...]] = {
    "leaf_density": (0.5, 0.75, 1.0, 1.25, 1.5, 2.0),
    "start_visibility": (0.05, 0.1, 0.2, 0.3, 0.5),
    "segmentation": (0.0, 0.1, 0.2, 0.4),
    "depth": (0.0, 1.0, 2.0, 4.0),
    "pose": (0.0, 0.01, 0.02, 0.04),
}
"""The values of each sweep with what they change.

- `leaf_density`: of the preset's foliage; new held-out plants by seed.
- `start_visibility`: upper end of the range of the first view's V_f; new held-out plants by seed.
- `segmentation`: share of the target's rays that the segmenter misses, with a fifth of that taken for target elsewhere.
- `depth`: noise in multiples of the D435's, with a tenth of that as the share of rays without an answer.
- `pose`: standard deviation of each coordinate of the target's position as it is known, in [m].
"""


@dataclass(frozen=True, kw_only=True)
class BenchmarkResult:
    """What a benchmark found and wrote."""

    figures: BenchmarkFigures
    table: str
    """The main table, as Markdown."""
    page: Path
    """report.html."""
    left_out: str | None
    """Which picture is missing and how to get it; None if none is."""


def run_benchmark(config: BenchmarkConfig) -> BenchmarkResult:
    """Runs what is missing, and writes benchmark.json, benchmark_details.json, the plots and report.html.

    Stopped at any time, a second call goes on.

    Raises:
        InvalidInputError: An option cannot be used, or the folder holds another benchmark.
        CheckpointError: Another process measures in the folder.
    """
    with only_writer(config.out, "measures"):
        return _run_benchmark(config)


def _run_benchmark(config: BenchmarkConfig) -> BenchmarkResult:
    specs = parse_policies(config.policies)
    sweep_specs = _chosen_policies(config, specs)
    processes = config.jobs or len(os.sched_getaffinity(0))
    facts: dict[str, Any]
    if config.env_id != GENERAL_IDS[0]:
        main, facts, swept = _drawn_condition(config), {}, []
        store = _open_store(config, specs, **_task_setting(config.env_id))
    elif config.plants is None:
        main = main_condition(config.episode_list, config.contact_free_oracle)
        facts = {}
        swept = _swept_conditions(config, main)
        _check_counts(config, main, bool(swept))
        store = _open_store(config, specs)
    else:
        place = _checked_plants(config, config.plants)
        store = _open_store(config, specs, plants=[place.fingerprint, place.split])
        main, facts = _on_plants(config, place, store, processes)
        swept = []
    numbers = range(config.seed, config.seed + config.episodes)
    few = range(config.seed, config.seed + config.sweep_episodes)
    plan = [(main, specs, numbers), *((condition, sweep_specs, few) for condition in swept)]
    run_policies(store, plan, processes, config.num_envs)
    runs = {
        condition.name: {spec.label: store.episodes(condition.name, spec.label, n) for spec in some}
        for condition, some, n in plan
    }
    threshold = make_options(config.env_id).task.full_visibility
    horizon = find_task(config.env_id).max_episode_steps
    pictures, left_out = [], None
    problem = vulkan_probe.rendering_problem() if config.pictures else None
    if config.pictures and problem is None:
        pictures.append(config.out / "views.jpg")
        draw_view_grid(runs[main.name], main, threshold, pictures[0])
    elif problem is not None:
        left_out = LEFT_OUT.format(hint=problem)
    figures = summarise_runs(runs, (main, *swept), horizon)
    sources = {spec.label: spec.source for spec in specs}

    def replay(label: str, seed: int) -> str:
        again = replay_with_eval(main.env_id, sources[label], seed, main.env_options)
        return _replay(config, sources[label], seed) if again is None or config.contact_free_oracle else again

    content = BenchmarkInput(
        runs=runs[main.name],
        threshold=threshold,
        horizon=horizon,
        privileged=[spec.label for spec in specs if spec.source in PRIVILEGED],
        facts={"first episode": config.seed, "processes": processes, **facts},
        pictures=pictures,
        left_out=left_out,
        replay=replay,
    )
    table, page = write_benchmark(figures, content, config.out)
    return BenchmarkResult(figures=figures, table=table, page=page, left_out=left_out)


def _replay(config: BenchmarkConfig, source: str, seed: int) -> str:
    """The benchmark of one episode, where `eval` has no flag for its plants."""
    words = [
        "benchmark",
        "--policies",
        source,
        "--seed",
        str(seed),
        "--episodes",
        "1",
        "--out",
        f"runs/again-{seed}",
    ]
    flags = [] if config.plants is None else ["--plants", config.plants]
    if config.env_id != GENERAL_IDS[0]:
        flags += ["--env-id", config.env_id]
    if config.contact_free_oracle:
        flags += ["--episode-list", config.episode_list, "--contact-free-oracle"]
    return shlex.join(["maniskill-tomato", *words, *flags])


def _open_store(config: BenchmarkConfig, specs: Sequence[PolicySpec], **settings: Any) -> ResultStore:
    """The folder of the results, and what they depend on."""
    common = {
        "env_id": config.env_id,
        "package_version": maniskill_tomato.__version__,
        "contact_free_oracle": config.contact_free_oracle,
    }
    members = {f"policy {spec.label}": spec.fingerprint for spec in specs}
    return ResultStore(config.out, {**common, **settings}, members)


def _drawn_condition(config: BenchmarkConfig) -> Condition:
    """Episodes of another task than the one with lists, each drawn from its seed.

    Raises:
        InvalidInputError: An option is for that task, or the task is a row.
    """
    if find_task(config.env_id).base == GENERAL_IDS[1]:
        raise InvalidInputError(f"{config.env_id} is a row, which benchmark-rows judges")
    if _words(config.sweeps) or config.episode_list != MAIN or config.plants is not None:
        raise InvalidInputError(
            f"--sweeps, --episode-list and --plants are for {GENERAL_IDS[0]}; leave them out with --env-id"
        )
    if config.episodes < 1 or config.seed < 0:
        raise InvalidInputError(
            f"--episodes must be 1 or more and --seed 0 or more; got {config.episodes} and {config.seed}"
        )
    return Condition(
        name=find_task(config.env_id).env_id, env_id=config.env_id, contact_free=config.contact_free_oracle
    )


def _task_setting(env_id: str) -> dict[str, Any]:
    """What the episodes of somebody else's task depend on: the file that makes it."""
    targets = {task.name: task.target for task in TASKS.extensions()}
    module = source_file(targets.get(env_id, env_id))
    return {} if env_id in TASK_IDS or module is None else {"task": fingerprint(module)}


def _checked_plants(config: BenchmarkConfig, text: str) -> PlantPlace:
    """The plants of `--plants`, if nothing else contradicts them.

    Raises:
        InvalidInputError: There are none, or an option is for our own plants.
    """
    if _words(config.sweeps) or config.episode_list != MAIN:
        raise InvalidInputError("--plants draws its own episodes; leave out --sweeps and --episode-list")
    if config.episodes < 1 or config.seed < 0:
        raise InvalidInputError(
            f"--episodes must be 1 or more and --seed 0 or more; got {config.episodes} and {config.seed}"
        )
    return parse_place(text)


def _on_plants(
    config: BenchmarkConfig, place: PlantPlace, store: ResultStore, processes: int
) -> tuple[Condition, dict[str, Any]]:
    """The condition of other plants, with facts about its episodes."""
    listed = certified_list(place, config.seed + config.episodes, store, config.out, processes)
    condition = Condition(
        name="plants",
        env_options={"episodes": str(listed.path), "plant": listed.plant},
        episode_list=str(listed.path),
        contact_free=config.contact_free_oracle,
    )
    return condition, listed.facts


def main_condition(episode_list: str = MAIN, contact_free: bool = False) -> Condition:
    """The fixed list of a name, or of a `.json` file, which lends the condition its own."""
    return Condition(
        name=Path(episode_list).stem,
        env_options={"episodes": episode_list},
        episode_list=episode_list,
        contact_free=contact_free,
    )


def sweep_conditions(axis: str, split: str = MAIN, contact_free: bool = False) -> list[Condition]:
    """The conditions of one sweep.

    Args:
        axis: One of `SWEEPS`.
        split: Name of the fixed list, and of the split of seeds for new plants.
        contact_free: Whether the oracle avoids the plant.

    Raises:
        InvalidInputError: There is no such sweep.
    """
    if axis not in SWEEPS:
        raise InvalidInputError.choice("the sweep", axis, SWEEPS)
    conditions = []
    for lowest, value in zip((0.0, *SWEEPS[axis]), SWEEPS[axis], strict=False):
        options = _options(axis, lowest, value, split)
        conditions.append(
            Condition(
                name=f"{axis}_{value:g}_{split}",
                axis=axis,
                value=value,
                env_options=options,
                episode_list=options.get("episodes"),
                contact_free=contact_free,
            )
        )
    return conditions


def _options(axis: str, lowest: float, value: float, split: str) -> dict[str, Any]:
    """Options for `gymnasium.make` at one value of a sweep, the value before it being `lowest`."""
    new_plants: dict[str, Any] = {"seed": split, "pool": None}
    if axis == "leaf_density":
        return {"plant": {**new_plants, "leaf_density": [value, value]}}
    if axis == "start_visibility":
        return {"plant": new_plants, "start_visibility": [lowest, value]}
    noise = {
        "segmentation": {"missed_target": value, "false_target": 0.2 * value},
        "depth": {"depth_noise": value, "dropout": 0.1 * value},
        "pose": {"target_position": value},
    }
    return {"episodes": split, "sensor_noise": noise[axis]}


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _swept_conditions(config: BenchmarkConfig, main: Condition) -> list[Condition]:
    axes = list(SWEEPS) if config.sweeps == "all" else _words(config.sweeps)
    if axes and config.episode_list not in EPISODE_LISTS:
        raise InvalidInputError(
            f"--sweeps grows plants of a split and needs --episode-list {' or '.join(EPISODE_LISTS)}"
        )
    return [c for axis in axes for c in sweep_conditions(axis, main.name, config.contact_free_oracle)]


def _check_counts(config: BenchmarkConfig, main: Condition, sweeps: bool) -> None:
    listed = len(load_episodes(config.episode_list))
    counts = {"--episodes": config.episodes} | ({"--sweep-episodes": config.sweep_episodes} if sweeps else {})
    for name, count in counts.items():
        if count < 1 or config.seed < 0 or config.seed + count > listed:
            raise InvalidInputError(
                f"{name} must be 1 or more, --seed 0 or more, and --seed plus {name} at most {listed}, the number of "
                f"episodes in the list {main.name}; got {config.seed} and {count}"
            )


def _chosen_policies(config: BenchmarkConfig, specs: list[PolicySpec]) -> list[PolicySpec]:
    """The policies that are swept, all by default."""
    chosen, labels = _words(config.sweep_policies), [spec.label for spec in specs]
    for label in chosen:
        if label not in labels:
            raise InvalidInputError.choice("--sweep-policies", label, labels)
    return [spec for spec in specs if not chosen or spec.label in chosen]
