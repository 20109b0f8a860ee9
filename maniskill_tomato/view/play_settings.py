"""Which episode is played; free of anything that is slow to import."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, get_args

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.layout import has_belief
from maniskill_tomato.policies.opening import RANDOM
from maniskill_tomato.policies.registry import policy_names
from maniskill_tomato.sensing.perception_kinds import RENDERED, Naming, Perception
from maniskill_tomato.task_registry import base_of, check_task_name

LISTED_ID: Final = "TomatoViewpoint-v1"
"""The task that has lists of episodes, and that names its target to a camera."""

SHIPPED: Final = "shipped"
"""The trained policy that ships for a task."""

PERCEPTIONS: Final = tuple(kind for kind in get_args(Perception) if kind not in RENDERED)
"""Those that need no renderer."""

NAMINGS: Final[tuple[str, ...]] = get_args(Naming)
"""How a robot that sees through a camera is told its target."""


@dataclass(frozen=True, kw_only=True)
class PlaySettings:
    """Task, policy, episode and senses."""

    env_id: str = LISTED_ID
    """Id of the task."""
    policy: str = SHIPPED
    """`SHIPPED`, a name, or a file."""
    seed: int = 0
    """Of the episode; its number where the task has a list."""
    perception: str = "ground_truth"
    """What V_f and the target's position come from, one of `PERCEPTIONS`."""
    target: str | None = None
    """How the target is named to a camera, one of `Naming`; only some settings use it."""
    plant_options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the task about other plants than its own."""
    episode_list: str | None = None
    """A list of episodes, for the task that has some; held-out ones if None, unless the plants are others
    or somebody demonstrates."""
    is_demonstrated: bool = False
    """Whether a person shows learners what to do, who must not see the plants on which they are judged."""

    def __post_init__(self) -> None:
        check_task_name(self.env_id, "env_id")
        for name, value, allowed in (
            ("perception", self.perception, PERCEPTIONS),
            ("target", self.target or "track", NAMINGS),
        ):
            if value not in allowed:
                raise InvalidInputError.choice(name, value, allowed)
        if not 0 <= self.seed < 2**31:
            raise InvalidInputError(f"seed must be from 0 to {2**31 - 1}, got {self.seed}")

    def world_options(self) -> dict[str, Any]:
        """Options of the task, as `tasks.making.make_world` takes them."""
        options = dict(self.plant_options)
        listed = self.episode_list
        if listed is None and not options and not self.is_demonstrated:
            listed = "held_out"
        if self.env_id == LISTED_ID and listed is not None:
            options["episodes"] = listed
        if self.perception != "ground_truth":
            options["perception"] = self.perception
            if self.target is not None and base_of(self.env_id) == LISTED_ID:
                options["target"] = self.target
        return options

    def policies(self) -> tuple[str, ...]:
        """The policies that can act in the task, and the given one."""
        named = (SHIPPED, *policy_names(), RANDOM) if has_belief(self.env_id) else (SHIPPED, RANDOM)
        return named if self.policy in named else (self.policy, *named)
