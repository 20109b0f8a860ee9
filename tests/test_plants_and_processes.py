"""`scripts/benchmark.py --plants` in small: what it measures, and that its processes end."""

import os
import time

import pytest

from benchmarking import plants_and_processes as measured
from maniskill_tomato.plants.plant_store import LIMIT_VARIABLE
from maniskill_tomato.plants.spec import PlantSpec
from maniskill_tomato.task_registry import TASK_IDS


def test_kept_plants_are_measured_in_a_process_whose_store_holds_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(LIMIT_VARIABLE, "7")
    with measured._store_limit(4000):
        limit, process = measured._in_another_process(_limit_and_process, "guided")
    assert (limit, process != os.getpid()) == ("4000", True)
    assert os.environ[LIMIT_VARIABLE] == "7"


def _limit_and_process(_: str) -> tuple[str, int]:
    return os.environ[LIMIT_VARIABLE], os.getpid()


@pytest.mark.slow
def test_resets_with_kept_and_with_new_plants_have_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measured, "KEPT", {"guided": 3})
    found = measured._kept_plants(("guided", 1))
    assert found["plants"] == 3 and found["filled_in_s"] > 0.0
    assert found["mib_a_plant"] == pytest.approx(found["mib"] / 3, abs=0.1)
    for shell, ratio in found["kept_over_new"].items():
        kept, new = (found["rates"][f"{shell}_{which}"]["median"] for which in ("kept", "new"))
        assert ratio == pytest.approx(kept / new, abs=0.05)


@pytest.mark.slow
def test_every_number_of_growers_is_measured_on_plants_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[int] = []
    draw = PlantSpec.draw_seed

    def noted(self: PlantSpec, rng: object) -> int:
        drawn.append(draw(self, rng))  # type: ignore[arg-type]
        return drawn[-1]

    monkeypatch.setattr(measured, "ENV_IDS", {"guided": TASK_IDS[0]})
    monkeypatch.setattr(PlantSpec, "draw_seed", noted)
    seen: list[set[int]] = []
    count = measured._episodes_per_second

    def counted(env: object, calls: int, seed: int) -> float:
        drawn.clear()
        rate = count(env, 1, seed)
        seen.append(set(drawn))
        return rate

    monkeypatch.setattr(measured, "_episodes_per_second", counted)
    rates = measured.growers(1)["guided"]
    assert list(rates) == ["0", "1", "2"] and all(rate["median"] > 0.0 for rate in rates.values())
    assert len(seen) == 3 and not (seen[0] & seen[1] | seen[0] & seen[2] | seen[1] & seen[2])


def test_processes_work_at_the_same_time_and_end() -> None:
    with measured._workers("plants_alone", 2) as connections:
        start = time.monotonic()
        clock, processor = measured._work_together(connections, 0.5)
        assert time.monotonic() - start >= 0.5
        assert clock > 0.0 and processor > 0.0
    assert all(connection.closed for connection in connections)
