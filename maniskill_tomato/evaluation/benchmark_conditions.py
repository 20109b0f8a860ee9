"""The conditions of a benchmark: the fixed list of held-out episodes, and sweeps over one difficulty at a time."""

from dataclasses import dataclass, field
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
    """The fixed list."""
    return Condition(name=episode_list, env_options={"episodes": episode_list}, episode_list=episode_list)


def _leaf_density(value: float) -> dict[str, Any]:
    return {"plant": {"seed": MAIN, "pool": None, "leaf_density": [value, value]}}


def _start(low: float, high: float) -> dict[str, Any]:
    return {"plant": {"seed": MAIN, "pool": None}, "start_visibility": [low, high]}


def _noise(**values: float) -> dict[str, Any]:
    return {"episodes": MAIN, "sensor_noise": values}


SWEEPS: dict[str, dict[float, dict[str, Any]]] = {
    "leaf_density": {value: _leaf_density(value) for value in (0.5, 0.75, 1.0, 1.25, 1.5, 2.0)},
    "start_visibility": {
        0.05: _start(0.0, 0.05),
        0.1: _start(0.05, 0.1),
        0.2: _start(0.1, 0.2),
        0.3: _start(0.2, 0.3),
        0.5: _start(0.3, 0.5),
    },
    "segmentation": {
        value: _noise(false_target=0.2 * value, missed_target=value) for value in (0.0, 0.1, 0.2, 0.4)
    },
    "depth": {value: _noise(depth_noise=value, dropout=0.1 * value) for value in (0.0, 1.0, 2.0, 4.0)},
    "pose": {value: _noise(target_position=value) for value in (0.0, 0.01, 0.02, 0.04)},
}
"""The values of each sweep with what they change.

- `leaf_density`: of the preset's foliage; new held-out plants by seed.
- `start_visibility`: upper end of the range of the first view's V_f; new held-out plants by seed.
- `segmentation`: share of the target's rays that the segmenter misses, with a fifth of that taken for target elsewhere.
- `depth`: noise in multiples of the D435's, with a tenth of that as the share of rays without an answer.
- `pose`: standard deviation of each coordinate of the target's position as it is known, in [m].
"""


def sweep_conditions(axis: str) -> list[Condition]:
    """The conditions of one sweep.

    Raises:
        InvalidInputError: There is no such sweep.
    """
    if axis not in SWEEPS:
        raise InvalidInputError.choice("the sweep", axis, SWEEPS)
    conditions = []
    for value, options in SWEEPS[axis].items():
        listed = options.get("episodes")
        conditions.append(
            Condition(
                name=f"{axis}_{value:g}", axis=axis, value=value, env_options=options, episode_list=listed
            )
        )
    return conditions
