"""What got slower between two runs of `scripts/benchmark.py` on machines of the same kind."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from benchmarking.turns import YARDSTICK, Rate
from maniskill_tomato.errors import InvalidInputError

SMALLEST_CHANGE: Final = 0.1
"""Changes below this share are no news, however little the turns differ."""

Verdict = Literal["slower", "faster", "same"]


@dataclass(frozen=True)
class Change:
    """One rate of both runs."""

    name: str
    """Of the rate."""
    ratio: float
    """New over old, each divided by its run's yardstick."""
    verdict: Verdict
    """`same` unless the turns of the runs do not overlap and the medians differ by `SMALLEST_CHANGE`."""


def read_run(path: Path) -> dict[str, Any]:
    """A file that the benchmark wrote.

    Raises:
        InvalidInputError: There is none, or it is something else.
    """
    try:
        run = json.loads(path.read_text())
    except OSError as error:
        raise InvalidInputError(
            f"cannot read {path}: {error.strerror}; --compare takes a JSON of an older run"
        ) from error
    except ValueError as error:
        raise InvalidInputError(
            f"{path} is not JSON: {error}; --compare takes a JSON of an older run"
        ) from error
    if not isinstance(run, dict) or not _has_rates(run):
        raise InvalidInputError(
            f"{path} has no rates of scripts/benchmark.py; measure it anew with --out {path}"
        )
    return dict(run)


def _has_rates(run: dict[str, Any]) -> bool:
    rates, machine = run.get("rates"), run.get("machine")
    if not isinstance(rates, dict) or not isinstance(machine, dict) or YARDSTICK not in rates:
        return False
    return "processor" in machine and all(map(_is_rate, rates.values()))


def _is_rate(rate: object) -> bool:
    if not isinstance(rate, dict):
        return False
    return all(isinstance(rate.get(key), int | float) and rate[key] > 0 for key in ("median", "low", "high"))


def check_same_kind(old: dict[str, Any], machine: dict[str, Any]) -> None:
    """Accepts a run of this kind of machine.

    Args:
        old: As of `read_run`.
        machine: Of this run.

    Raises:
        InvalidInputError: It ran on another processor or accelerator.
    """
    for key in ("processor", "accelerator"):
        if old["machine"].get(key) != machine.get(key):
            raise InvalidInputError(
                f"the older run is of another machine ({key} {old['machine'].get(key)!r}, here {machine.get(key)!r}); "
                "compare runs of one kind of machine"
            )


def compare_rates(old: dict[str, Rate], new: dict[str, Rate]) -> tuple[list[Change], list[str]]:
    """What changed, and the rates that only one of the runs has.

    A rate is slower where its fastest turn is slower than the slowest of the old run, and its median by more than
    `SMALLEST_CHANGE`. All rates are divided by the yardstick of their run first, so that a busy machine is no change.
    """
    scale = old[YARDSTICK]["median"] / new[YARDSTICK]["median"]
    changes = []
    for name in sorted(old.keys() & new.keys() - {YARDSTICK}):
        before, after = old[name], {key: value * scale for key, value in new[name].items()}
        ratio = after["median"] / before["median"]
        verdict: Verdict = "same"
        if after["high"] < before["low"] and ratio < 1 - SMALLEST_CHANGE:
            verdict = "slower"
        elif after["low"] > before["high"] and ratio > 1 + SMALLEST_CHANGE:
            verdict = "faster"
        changes.append(Change(name, ratio, verdict))
    return changes, sorted(old.keys() ^ new.keys())


def comparison_text(changes: list[Change], alone: list[str]) -> str:
    """A line for every rate that changed, and what was not compared."""
    moved = [change for change in changes if change.verdict != "same"]
    lines = [f"{change.verdict:<7} {change.ratio:5.2f} x  {change.name}" for change in moved]
    lines.append(f"{len(changes) - len(moved)} of {len(changes)} rates are the same within the noise")
    if alone:
        lines.append(f"in one run only: {', '.join(alone)}")
    return "\n".join(lines) + "\n"
