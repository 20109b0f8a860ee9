"""What several commands take, and what they do with it."""

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from maniskill_tomato.tasks import TASK_IDS

EnvId = Annotated[
    str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV_ID", help=f"One of {', '.join(TASK_IDS)}.")
]


@dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Another plant than the task's own."""

    plant: str | None = None
    """Preset of the plant: one_tomato, three_tomatoes or full."""
    plant_seed: str | None = None
    """Its seed, or train, validation or held_out for a new plant of that split in every episode."""
    plant_pool: int | None = None
    """With a split, draw only from this number of its plants; plants seen before need not grow again."""
    plant_pose: tuple[float, float, float] | None = None
    """Where it stands: x [m], y [m], yaw [rad]."""
    plant_pose_noise: tuple[float, float, float] | None = None
    """Half ranges of a uniform addition to that in every episode: x [m], y [m], yaw [rad]."""

    def env_options(self) -> dict[str, Any]:
        """The options for `gymnasium.make`."""
        plant: dict[str, Any] = {}
        if self.plant is not None:
            plant["preset"] = self.plant
        if self.plant_seed is not None:
            plant["seed"] = int(self.plant_seed) if self.plant_seed.isdigit() else self.plant_seed
        if self.plant_pool is not None:
            plant["pool"] = self.plant_pool
        options: dict[str, Any] = {"plant": plant} if plant else {}
        if self.plant_pose is not None:
            options["plant_pose"] = self.plant_pose
        if self.plant_pose_noise is not None:
            options["plant_pose_noise"] = self.plant_pose_noise
        return options


def merge_options(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """The task options `base` with `changes` put over them, one by one within tables such as `plant`."""
    merged = dict(base)
    for name, value in changes.items():
        old = merged.get(name)
        if isinstance(old, str) and name == "plant":
            old = {"preset": old}
        merged[name] = {**old, **value} if isinstance(old, dict) and isinstance(value, dict) else value
    return merged
