"""How long the stages of a loop take."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


class StageTimes:
    """Wall times by stage, of the step under way and of all."""

    def __init__(self) -> None:
        self._all: dict[str, list[float]] = defaultdict(list)
        self._step: dict[str, float] = {}

    def begin_step(self) -> None:
        """A new step begins; `step_ms` is empty again."""
        self._step = {}

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Measures what is inside, also where it raises."""
        began = time.perf_counter()
        try:
            yield
        finally:
            taken = 1e3 * (time.perf_counter() - began)
            self._all[stage].append(taken)
            self._step[stage] = round(taken, 3)

    @property
    def step_ms(self) -> dict[str, float]:
        """Of the step under way, in [ms]."""
        return dict(self._step)

    @property
    def mean_ms(self) -> dict[str, float]:
        """Means over all steps, in [ms]."""
        return {stage: round(float(np.mean(values)), 2) for stage, values in self._all.items()}
