"""Plants of coming resets, grown ahead by worker processes and kept until they are shown."""

import contextlib
import logging
import subprocess
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Final

from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.plants.plant_store import PLANT_STORE, plant_bytes
from maniskill_tomato.plants.spec import PlantSpec
from maniskill_tomato.worker_pool import start_worker

logger = logging.getLogger(__name__)

CLOSE_SECONDS: Final = 5.0
"""How long a worker that was told to end may take before nobody waits for it."""

Prepare = Callable[[Plant], object]
"""What else a plant needs before it is shown; what it returns is kept with the plant. Called in any thread."""


def grow(spec: PlantSpec, seed: int) -> Plant:
    """The plant of a spec and seed; the last ones are kept, as environments often share them."""
    return PLANT_STORE.get((spec, seed), lambda: spec.grow(seed), plant_bytes)


class PlantGrowers:
    """Worker processes that grow the plants of one spec; whoever asks for plants works with them.

    The plants are those that this process would grow. They go to the store of plants; besides, those that an
    environment is expected to show are kept until it shows another. The log tells of a worker that ends early; its
    plants are grown here.
    """

    def __init__(self, spec: PlantSpec, count: int, prepare: Prepare | None = None) -> None:
        """Starts the processes, which end with this one or with `close`.

        Args:
            spec: Which plants.
            count: Of the processes, at least 1.
            prepare: Called with every plant that a worker has grown.
        """
        self._tasks = _Tasks(spec, prepare)
        self._workers: list[subprocess.Popen[bytes]] = []
        for _ in range(count):
            process, connection = start_worker(_grow_on_demand, spec)
            self._workers.append(process)
            # The thread must not keep this object alive, whose end is that of the processes.
            self._tasks.begin_tending()
            threading.Thread(target=_tend, args=(self._tasks, connection), daemon=True).start()
        self.close = weakref.finalize(self, _end, self._tasks, self._workers)
        """Ends the processes, also while they grow something; plants are grown here from then on."""

    @property
    def process_ids(self) -> list[int]:
        """Of the workers."""
        return [process.pid for process in self._workers]

    def expect(self, seeds: Mapping[int, int]) -> None:
        """Has plants grown that environments will show next.

        Args:
            seeds: Of the plants, by the environment's index. What was expected of these environments before is
                forgotten.
        """
        self._tasks.expect(seeds)

    def plants(self, seeds: Mapping[int, int]) -> dict[int, Plant]:
        """Plants that environments show now, by the environment's index.

        Those that no worker has begun are grown by this process and the workers together.

        Args:
            seeds: Of the plants, by the environment's index.
        """
        return self._tasks.plants(seeds)

    def wait(self) -> None:
        """Until all expected plants are there, or no worker is left to grow them."""
        self._tasks.wait()


class _Tasks:
    """What is to be grown and what has been, for the threads that tend the workers."""

    def __init__(self, spec: PlantSpec, prepare: Prepare | None) -> None:
        self._spec, self._prepare = spec, prepare
        self._changed = threading.Condition()
        self._expected: dict[int, int] = {}
        self._open: OrderedDict[int, None] = OrderedDict()
        self._growing: set[int] = set()
        self._ready: dict[int, tuple[Plant, object]] = {}
        self._tended = 0
        self._is_closed = False

    def expect(self, seeds: Mapping[int, int]) -> None:
        with self._changed:
            self._expected.update(seeds)
            self._forget()
            self._begin(seeds)

    def plants(self, seeds: Mapping[int, int]) -> dict[int, Plant]:
        wanted = list(dict.fromkeys(seeds.values()))
        with self._changed:
            self._expected.update(seeds)
            self._begin(seeds)
            for seed in reversed(wanted):
                if seed in self._open:
                    self._open.move_to_end(seed, last=False)
        found: dict[int, Plant] = {}
        for seed in reversed(wanted):
            with self._changed:
                self._open.pop(seed, None)
                is_elsewhere = seed in self._growing or seed in self._ready
            if not is_elsewhere:
                found[seed] = grow(self._spec, seed)
        with self._changed:
            self._changed.wait_for(lambda: not self._growing.intersection(wanted))
            found |= {seed: self._ready[seed][0] for seed in wanted if seed in self._ready}
            for env_index in seeds:
                del self._expected[env_index]
            self._forget()
        # A worker that failed leaves its plant, and with it the error, to this process.
        found |= {seed: grow(self._spec, seed) for seed in wanted if seed not in found}
        return {env_index: found[seed] for env_index, seed in seeds.items()}

    def wait(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: not self._tended or not (self._open or self._growing))

    def _begin(self, seeds: Mapping[int, int]) -> None:
        """Puts on the list what is neither there nor under way."""
        for seed in seeds.values():
            if seed in self._ready or seed in self._growing:
                continue
            plant = PLANT_STORE.find((self._spec, seed))
            if plant is None:
                self._open[seed] = None
            else:
                self._ready[seed] = plant, None
        self._changed.notify_all()

    def _forget(self) -> None:
        """Lets go what nobody expects."""
        expected = set(self._expected.values())
        self._ready = {seed: kept for seed, kept in self._ready.items() if seed in expected}
        self._open = OrderedDict.fromkeys(seed for seed in self._open if seed in expected)

    # ---------------------------------------------------- of the threads that tend workers

    def begin_tending(self) -> None:
        with self._changed:
            self._tended += 1

    def next(self) -> int | None:
        """The seed of the next plant, waited for; None when all is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._open or self._is_closed)
            if self._is_closed:
                return None
            seed, _ = self._open.popitem(last=False)
            self._growing.add(seed)
            return seed

    def grown(self, seed: int, plant: Plant | None) -> None:
        """Takes a plant from a worker; None if it has failed."""
        kept: tuple[Plant, object] | None = None
        if plant is not None:
            made = plant
            stored = PLANT_STORE.get((self._spec, seed), lambda: made, plant_bytes)
            # What cannot be prepared fails again where it is to be shown, with its error.
            with contextlib.suppress(Exception):
                kept = stored, None if self._prepare is None else self._prepare(stored)
        with self._changed:
            self._growing.discard(seed)
            if kept is not None:
                self._ready[seed] = kept
                self._forget()
            self._changed.notify_all()

    def end_tending(self) -> bool:
        """Whether a worker has ended though nobody ended it."""
        with self._changed:
            self._tended -= 1
            self._changed.notify_all()
            return not self._is_closed

    def close(self) -> None:
        with self._changed:
            self._is_closed = True
            self._open.clear()
            self._changed.notify_all()


def _tend(tasks: _Tasks, connection: Connection) -> None:
    """Hands plants to one worker, one at a time, for as long as it lives."""
    with contextlib.closing(connection):
        while (seed := tasks.next()) is not None:
            plant = None
            is_gone = False
            try:
                connection.send(seed)
                plant = connection.recv()
            except (EOFError, OSError):
                is_gone = True
            finally:
                tasks.grown(seed, plant)
            if is_gone:
                break
    if tasks.end_tending():
        logger.warning(
            "a process that grew plants ahead has ended early; its plants are grown by the environment's process"
        )


def _end(tasks: _Tasks, workers: list[subprocess.Popen[bytes]]) -> None:
    tasks.close()
    for worker in workers:
        worker.kill()
    for worker in workers:
        with contextlib.suppress(subprocess.TimeoutExpired):
            worker.wait(CLOSE_SECONDS)


def _grow_on_demand(connection: Connection, spec: PlantSpec) -> None:
    """The work of a process: grows the plants whose seeds it is sent, None in place of one that fails."""
    while True:
        seed = connection.recv()
        plant: Plant | None = None
        with contextlib.suppress(Exception):
            plant = spec.grow(seed)
        connection.send(plant)
