"""The order and the units of what a policy observes and does, by task."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from maniskill_tomato.task_registry import GENERAL_IDS, base_of

if TYPE_CHECKING:
    from maniskill_tomato.sensing.image_layout import Sight

OBSERVATION_NAMES = (
    "ee_x",
    "ee_y",
    "ee_z",
    "ee_roll",
    "ee_pitch",
    "ee_yaw",
    "target_x",
    "target_y",
    "target_z",
)
"""The observation, in order; world frame, [m] and [rad]."""

OBSERVATION_UNITS = ("m", "m", "m", "rad", "rad", "rad", "m", "m", "m")
"""The unit of each observed value."""

ACTION_NAMES = ("dx", "dy", "dz", "droll", "dpitch", "dyaw")
"""The action, in order; an action of 1 is 1 m or 1 rad."""

ACTION_UNITS = ("m", "m", "m", "rad", "rad", "rad")
"""The unit of each action value."""

TARGET_POSITION = slice(6, 9)
"""Where the target's position is in the observation."""

GENERAL_OBSERVATION_SIZE = 786
"""Numbers of the general tasks' default observation, `sensing.observation.ObservationLayout`."""


@dataclass(frozen=True, kw_only=True)
class PolicyLayout:
    """What the policies of a task observe and do."""

    observation_names: tuple[str, ...]
    observation_units: tuple[str, ...]
    action_names: tuple[str, ...]
    action_units: tuple[str, ...]
    frame: str
    """What the observation is expressed in."""
    action_meaning: str


THESIS_LAYOUT = PolicyLayout(
    observation_names=OBSERVATION_NAMES,
    observation_units=OBSERVATION_UNITS,
    action_names=ACTION_NAMES,
    action_units=ACTION_UNITS,
    frame="world = robot base, z up, x towards the plant; fixed-axis R = Rz(yaw) Ry(pitch) Rx(roll)",
    action_meaning="added to the end-effector's x, y, z, roll, pitch, yaw",
)

GENERAL_LAYOUT = PolicyLayout(
    observation_names=tuple(f"value_{i}" for i in range(GENERAL_OBSERVATION_SIZE)),
    observation_units=("1",) * GENERAL_OBSERVATION_SIZE,
    action_names=("right", "up", "forward"),
    action_units=("0.12 m",) * 3,
    frame="ViewpointObserver's vector, docs/observation.md",
    action_meaning="move of the camera in its look frame, cut to norm 1; it looks at the target from there",
)

EPSILON_GREEDY_LOW = (-0.07, -0.2, -0.1, -0.17, -0.17, -0.17)
"""Lower ends of Eq. 5-6 in the order of `ACTION_NAMES`; the thesis lists pitch before roll. [m], [rad]."""

EPSILON_GREEDY_HIGH = (0.1, 0.1, 0.1, 0.43, 0.17, 0.26)
"""Upper ends of Eq. 5-6 in the order of `ACTION_NAMES`. [m], [rad]."""


def has_belief(env_id: str) -> bool:
    """Whether a task keeps a `Belief`, beside its state vector."""
    return base_of(env_id) in GENERAL_IDS


def unknown_task(env_id: str) -> str:
    """The end of a message about a layout that does not fit, where that may be for want of the task's package."""
    if base_of(env_id) is not None:
        return ""
    return f"; the task {env_id} is not known here: is the package that has it installed?"


def layout_of(env_id: str, sight: "Sight | None" = None) -> PolicyLayout:
    """What the policies of a task observe and do; the thesis's for tasks that this package does not know.

    Args:
        env_id: The task.
        sight: The images that they see; beside them only some parts of the general tasks' observation are observed.
    """
    if not has_belief(env_id):
        return THESIS_LAYOUT
    if sight is None:
        return GENERAL_LAYOUT
    from maniskill_tomato.sensing.observation import ObservationLayout

    slices = ObservationLayout(parts=sight.state_parts).slices
    names = tuple(f"{part}_{i}" for part, place in slices.items() for i in range(place.stop - place.start))
    return replace(GENERAL_LAYOUT, observation_names=names, observation_units=("1",) * len(names))
