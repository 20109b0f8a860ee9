"""Resets with plants that are kept against new ones, how fast plants grow, and two processes beside one.

Work of several processes is measured by the clock: by their processor time they never wait for each other. What else
the machine does is in such a rate too, so that the load stands beside it. The same work by the processor time of each
process tells what the processes take from each other whatever else runs: caches and memory, but not cores.
"""

import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import count
from multiprocessing.connection import Connection
from typing import Any, Final

import gymnasium as gym
import torch

from benchmarking.simulator import GENERAL, GUIDED, PLAIN, make_vector, resident_mib, small_actions
from benchmarking.turns import Rate, four_digits, in_turns, per_second, summary
from maniskill_tomato.plants.growers import PlantGrowers
from maniskill_tomato.plants.plant_store import LIMIT_VARIABLE
from maniskill_tomato.plants.spec import ROW_PLANT, PlantSpec
from maniskill_tomato.tasks.making import make_setup
from maniskill_tomato.worker_pool import run_jobs, start_worker

KEPT: Final[Mapping[str, int]] = {"guided": 1000, "general": 100}
"""Plants of the stores that are measured; a plant of the general task has its neighbours."""

ENV_IDS: Final[Mapping[str, str]] = {"guided": GUIDED, "general": GENERAL}

STORE_MB: Final = 4000
"""Room for the plants of a store and the new ones beside them."""

MANY: Final = 64
"""Environments that step, and that are reset with kept plants."""

FEW: Final = 8
"""Environments that are reset with a new plant each."""

MOVES: Final = 10
"""Of an episode between resets with new plants."""


def plants_and_processes(repeats: int) -> Iterator[dict[str, Any]]:
    """All of this module's results, one after the other, since they take minutes.

    Args:
        repeats: Turns; each rate is the median of as many measurements.
    """
    yield {"kept_plants": kept_plants(repeats)}
    for name, measure in (("growers", growers), ("two_processes", two_processes)):
        before = os.getloadavg()[0]
        found: dict[str, Any] = dict(measure(repeats))
        yield {name: {**found, "load_average": [round(before, 1), round(os.getloadavg()[0], 1)]}}


# ------------------------------------------------------------------ kept plants


def kept_plants(repeats: int) -> dict[str, Any]:
    """Rates of resets with a kept and with a new plant each, by task, and what the kept plants take.

    Args:
        repeats: Turns.
    """
    with _store_limit(STORE_MB):
        # A process of its own has an empty store, and reads its limit anew.
        return {name: dict(_in_another_process(_kept_plants, (name, repeats))) for name in KEPT}


def _in_another_process(function: Callable[[Any], Any], job: Any) -> Any:
    (_, result), *_ = run_jobs(function, [job], processes=2)
    return result


@contextmanager
def _store_limit(megabytes: int) -> Iterator[None]:
    before = os.environ.get(LIMIT_VARIABLE)
    os.environ[LIMIT_VARIABLE] = str(megabytes)
    try:
        yield
    finally:
        del os.environ[LIMIT_VARIABLE]
        if before is not None:
            os.environ[LIMIT_VARIABLE] = before


def _kept_plants(job: tuple[str, int]) -> dict[str, Any]:
    name, repeats = job
    env_id, plants = ENV_IDS[name], KEPT[name]
    kept, new = {"seed": "train", "pool": plants}, {"seed": "train", "pool": None}
    vector_new = make_vector(env_id, FEW, "cpu", plant=new)
    before, start = resident_mib(), time.monotonic()
    growing = PlantGrowers(make_setup(env_id, plant=kept).plant, 2, vector_new.world.scene.prepare)
    growing.expect(dict(enumerate(range(plants))))
    growing.wait()
    seconds, taken = time.monotonic() - start, resident_mib() - before
    envs: dict[str, Any] = {
        "vector_kept": make_vector(env_id, MANY, "cpu", plant=kept),
        "vector_new": vector_new,
        "maniskill_kept": gym.make(env_id, plant=kept, **PLAIN),
        "maniskill_new": gym.make(env_id, plant=new, **PLAIN),
    }
    calls = {"vector_kept": 3, "vector_new": 1, "maniskill_kept": 60, "maniskill_new": 5}
    rates = in_turns({key: partial(_resets_per_second, envs[key], calls[key]) for key in envs}, repeats)
    growing.close()
    return {
        "plants": plants,
        "mib": round(taken, 1),
        "mib_a_plant": round(taken / plants, 2),
        "filled_in_s": round(seconds, 1),
        "rates": rates,
        "kept_over_new": {
            shell: round(rates[f"{shell}_kept"]["median"] / rates[f"{shell}_new"]["median"], 1)
            for shell in ("vector", "maniskill")
        },
    }


def _resets_per_second(env: Any, calls: int) -> float:
    """Rate of single environments' resets."""
    return float(getattr(env, "num_envs", 1) * per_second(env.reset, calls))


# ---------------------------------------------------------------------- growers


def growers(repeats: int) -> dict[str, dict[str, Rate]]:
    """Episodes a second by the clock with a new plant each, by task and number of worker processes.

    Args:
        repeats: Turns.
    """
    rates: dict[str, dict[str, list[float]]] = {name: {} for name in ENV_IDS}
    # All share one store of plants, so that each measurement needs plants of its own.
    seeds = count(FEW, FEW)
    for name, env_id in ENV_IDS.items():
        plant = {"seed": "train", "pool": None}
        envs = {
            str(n): make_vector(env_id, FEW, "cpu", plant=plant, **({"growers": n} if n else {}))
            for n in (0, 1, 2)
        }
        for _ in range(repeats):
            for key, env in envs.items():
                rates[name].setdefault(key, []).append(_episodes_per_second(env, 3, next(seeds)))
        for env in envs.values():
            env.close()
    return {name: {key: summary(values) for key, values in each.items()} for name, each in rates.items()}


def _episodes_per_second(env: Any, calls: int, seed: int) -> float:
    moves = torch.from_numpy(small_actions(env.single_action_space.shape[0])[:FEW])
    env.reset(seed=seed)
    start = time.monotonic()
    for _ in range(calls):
        for _ in range(MOVES):
            env.step(moves)
        env.reset()
    return float(calls * env.num_envs / (time.monotonic() - start))


# -------------------------------------------------------------------- processes


def _steps_of(env_id: str) -> Callable[[], int]:
    env = make_vector(env_id, MANY, "cpu")
    moves = torch.from_numpy(small_actions(env.single_action_space.shape[0])).reshape(8, MANY, -1)
    taken = count()

    def step() -> int:
        if next(taken) % 30 == 29:
            env.reset()
        env.step(moves[next(taken) % 8])
        return MANY

    return step


def _plants_of(spec: PlantSpec) -> Callable[[], int]:
    seeds = count(os.getpid() * 1000 % 2**20)

    def grow() -> int:
        spec.grow(next(seeds))
        return 1

    return grow


WORK: Final[Mapping[str, Callable[[], Callable[[], int]]]] = {
    "guided_steps": partial(_steps_of, GUIDED),
    "general_steps": partial(_steps_of, GENERAL),
    "plants_alone": partial(_plants_of, PlantSpec(seed="train")),
    "plants_in_their_row": partial(_plants_of, ROW_PLANT),
}
"""Makes what a process does again and again; a call returns how much of it is done."""


def two_processes(repeats: int, seconds: float = 3.0) -> dict[str, Any]:
    """What one and two processes do a second, by the work, and the ratios.

    Args:
        repeats: Turns.
        seconds: How long each measurement lasts.
    """
    results = {}
    for name in WORK:
        by_clock: dict[int, list[float]] = {1: [], 2: []}
        by_processor: dict[int, list[float]] = {1: [], 2: []}
        with _workers(name, 2) as connections:
            for _ in range(repeats):
                for processes in (1, 2):
                    clock, processor = _work_together(connections[:processes], seconds)
                    by_clock[processes].append(clock)
                    by_processor[processes].append(processor)
        results[name] = {
            "one": summary(by_clock[1]),
            "two": summary(by_clock[2]),
            "two_over_one": _ratio(by_clock),
            "two_over_one_by_processor_time": _ratio(by_processor),
        }
    return results


def _ratio(rates: Mapping[int, list[float]]) -> float:
    """Median of the ratios of the turns."""
    return four_digits(statistics.median(two / one for one, two in zip(rates[1], rates[2], strict=True)))


@contextmanager
def _workers(name: str, processes: int) -> Iterator[list[Connection]]:
    started = [start_worker(_work, name) for _ in range(processes)]
    try:
        for _, connection in started:
            connection.recv()
        yield [connection for _, connection in started]
    finally:
        for process, connection in started:
            connection.close()
            process.wait()


def _work(connection: Connection, name: str) -> None:
    """A process that works for as many seconds as it is sent, and tells its rates by the clock and processor time."""
    torch.set_num_threads(1)
    work = WORK[name]()
    for _ in range(3):
        work()
    connection.send(None)
    while True:
        seconds = connection.recv()
        done, start, spent = 0, time.monotonic(), time.process_time()
        while time.monotonic() - start < seconds:
            done += work()
        connection.send((done / (time.monotonic() - start), done / (time.process_time() - spent)))


def _work_together(connections: list[Connection], seconds: float) -> tuple[float, float]:
    """Sums of the processes' rates, by the clock and by the processor time of each."""
    for connection in connections:
        connection.send(seconds)
    rates = [connection.recv() for connection in connections]
    return sum(clock for clock, _ in rates), sum(processor for _, processor in rates)
