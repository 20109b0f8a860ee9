"""The conditions of a benchmark: the fixed list of held-out episodes, and sweeps over one difficulty at a time."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError

MAIN = "held_out"
"""The condition on which policies are compared; also the name of its list of episodes."""


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What the episodes of a part of the benchmark have in common."""

    name: str
    axis: str | None = None
    """Which sweep it belongs to."""
    value: float | None = None
    """Where it stands on that axis."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options for `gymnasium.make` beside the defaults; plain JSON values."""
    episode_list: str | None = None
    """Name of a fixed list; None draws each episode from its seed."""


def main_condition(episode_list: str = MAIN) -> Condition:
    """The fixed list of a name, or of a `.json` file, which lends the condition its own."""
    name = Path(episode_list).stem
    return Condition(name=name, env_options={"episodes": episode_list}, episode_list=episode_list)


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


def sweep_conditions(axis: str, split: str = MAIN) -> list[Condition]:
    """The conditions of one sweep.

    Args:
        axis: One of `SWEEPS`.
        split: Name of the fixed list, and of the split of seeds for new plants.

    Raises:
        InvalidInputError: There is no such sweep.
    """
    if axis not in SWEEPS:
        raise InvalidInputError.choice("the sweep", axis, SWEEPS)
    conditions = []
    lowest = 0.0
    for value in SWEEPS[axis]:
        options = _options(axis, lowest, value, split)
        lowest = value
        conditions.append(
            Condition(
                name=f"{axis}_{value:g}_{split}",
                axis=axis,
                value=value,
                env_options=options,
                episode_list=options.get("episodes"),
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
