"""The page of one run: how it ended, V_f over the looks, every look with what followed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.run_records import RunResult
from maniskill_tomato.report_design import many_small, page, paragraph, pixels, section, table, tile, tiles
from maniskill_tomato.run_facts import run_facts


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """A look as a report shows it."""

    picture: NDArray[np.uint8]
    """With the target's outline. Shape (H, W, 3)."""
    title: str
    """Its number and V_f."""
    outcome: str
    """What followed."""


def run_page(
    result: RunResult, facts: Mapping[str, Any], looks: Sequence[Look], steps: Sequence[Mapping[str, Any]]
) -> bytes:
    """The content of `report.html`.

    Args:
        result: How the run ended.
        facts: What was run, as in `result.json`.
        looks: Each look's picture.
        steps: Its figures, as in `result.json`.
    """
    count = f"n = {len(steps)} look{'' if len(steps) == 1 else 's'}"
    truth = result.true_visible_fraction
    rows = [
        (
            str(step["number"]),
            f"{step['visible_fraction']:.2f}",
            str(step["outcome"]),
            str(step["detail"]),
            ", ".join(f"{value:.2f}" for value in step["camera"]),
            f"{sum(step['timing_ms'].values()):.0f}",
        )
        for step in steps
    ]
    keys = ("profile", "policy", "policy_name", "perception", "seed", "mode", "simulated")
    told = {name.replace("_", " "): str(facts[name]) for name in keys if name in facts}
    devices = facts.get("devices", {})
    return page(
        "A run of the robot" if not facts.get("simulated") else "A run of the twin",
        f"{facts.get('profile')}, seed {facts.get('seed')}, {facts.get('policy_name')}: {result.reason}",
        [
            tiles(
                tile(
                    f"V_f {result.visible_fraction:.2f}",
                    "visible fraction at the end (0 to 1)",
                    f"best {result.best_visible_fraction:.2f}, {count}",
                    "" if truth is None else f"{truth:.2f} by the twin's truth",
                ),
                tile(f"{result.moves} moves", "decided on", f"{result.refused_moves} of them refused"),
                tile(
                    f"{result.device_seconds:.0f} s",
                    "by the run's clock",
                    f"{result.seconds:.1f} s of wall time",
                ),
            ),
            section(
                "How it ended",
                paragraph(f"{result.reason}: {result.detail}. {result.end_state.capitalize()}."),
            ),
            section(
                f"Looks, {count}",
                many_small(*(pixels(look.picture, f"{look.title}. {look.outcome}.") for look in looks)),
                table(
                    ("look", "V_f (0 to 1)", "outcome", "why", "camera x, y, z [m]", "wall time [ms]"),
                    rows,
                    words=(3,),
                    tall=True,
                ),
            ),
        ],
        {**told, **{name: _words(what) for name, what in devices.items()}, **run_facts()},
    ).encode()


def _words(description: object) -> str:
    """What a device says of itself."""
    if isinstance(description, Mapping):
        return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in description.items())
    return str(description)
