"""ManiSkill's rendered observations as learners take them: one state vector, and images with the role of every pixel.

ManiSkill's own `FlattenRGBDObservationWrapper` drops the segmentation, whose ids mean another thing in every scene.
"""

from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import ROLE_OF_CLASS, Role
from maniskill_tomato.sensing.image_observation import STATE

CAMERA = "d435"
"""The wrist's camera among the sensors."""


class FlattenImageObservationWrapper(gym.ObservationWrapper[Any, Any, Any]):
    """Gives `state`, and those of `rgb`, `depth` and `segmentation` that the observation mode has.

    - `state` (N, D): all numbers of the agent and of the task, as ManiSkill orders them.
    - `rgb` (N, H, W, 3), uint8; `depth` (N, H, W, 1), int16, in [mm]; both as rendered.
    - `segmentation` (N, H, W, 1), uint8: values of `plants.organs.Role`.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Wraps one of this package's tasks.

        Args:
            env: Made with an `obs_mode` of images, such as `rgb+depth+segmentation`.

        Raises:
            InvalidInputError: Its observations have no images.
        """
        super().__init__(env)
        self._task = cast(Any, env.unwrapped)
        first = self._task._init_raw_obs
        if not isinstance(first, dict) or CAMERA not in first.get("sensor_data", {}):
            raise InvalidInputError(
                "FlattenImageObservationWrapper needs observations with images; make the task with an obs_mode such as "
                "'rgb+depth+segmentation'"
            )
        self._task.update_obs_space(self.observation(first))

    def observation(self, observation: Any) -> dict[str, Tensor]:
        """The observation in its new form."""
        images: dict[str, Tensor] = dict(observation["sensor_data"][CAMERA])
        numbers = [*observation["agent"].values(), *observation["extra"].values()]
        flat = {STATE: torch.cat([torch.as_tensor(n).flatten(1).float() for n in numbers], dim=-1)}
        for name in ("rgb", "depth"):
            if name in images:
                flat[name] = images[name]
        if "segmentation" in images:
            flat["segmentation"] = self._roles(images["segmentation"])
        return flat

    def _roles(self, ids: Tensor) -> Tensor:
        """Roles of segmentation ids. Shape (N, H, W, 1), int16 to uint8."""
        targets = self._task.world.target_id.tolist()
        rows = []
        for i, (row, target) in enumerate(zip(ids, targets, strict=True)):
            classes = self._task.semantic_classes(i)
            size = max(int(row.max()), *classes, target) + 1
            table = np.full(size, int(Role.BACKGROUND), np.uint8)
            for number, semantic in classes.items():
                table[number] = int(ROLE_OF_CLASS[semantic])
            table[target] = int(Role.TARGET)
            rows.append(torch.from_numpy(table).to(ids.device)[row.long()])
        return torch.stack(rows)
