"""What a real camera, segmenter and calibration get wrong, as an option of the general tasks."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.sensing.view_pattern import disturb


@dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """How much is wrong; nothing by default."""

    depth_noise: float = 0.0
    """Noise of depths in multiples of the D435's."""
    dropout: float = 0.0
    """Share of the rays without an answer."""
    false_target: float = 0.0
    """Share of the rays on leaves, stems and other fruits that are taken for the target."""
    missed_target: float = 0.0
    """Share of the rays on the target that are taken for something else; the measured V_f shrinks by it."""
    target_position: float = 0.0
    """Standard deviation of each coordinate of the target's position as it is known in an episode, in [m]."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            most = 1.0 if field.name in ("dropout", "false_target", "missed_target") else math.inf
            number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
            if not number or not 0.0 <= value <= most:
                raise InvalidInputError(
                    f"sensor_noise {field.name} must be a number from 0 to {most:g}; got {value!r}"
                )

    @classmethod
    def parse(cls, value: "SensorNoise | Mapping[str, float] | None") -> "SensorNoise":
        """The noise that an option describes; none for None.

        Raises:
            InvalidInputError: A name is unknown or a number out of range.
        """
        if value is None:
            return cls()
        if isinstance(value, SensorNoise):
            return value
        known = [field.name for field in fields(cls)]
        for name in value:
            if name not in known:
                raise InvalidInputError.choice("a key of sensor_noise", name, known)
        return cls(**value)


class SensorErrors:
    """Draws the errors of N environments, each from its own random numbers."""

    def __init__(self, noise: SensorNoise, num_envs: int, device: torch.device) -> None:
        """Begins without errors.

        Args:
            noise: How much is wrong.
            num_envs: Number of environments B.
            device: Where tensors live.
        """
        self._noise = noise
        self._generators = [torch.Generator(device=device) for _ in range(num_envs)]
        self._offset = torch.zeros(num_envs, 3, device=device)
        self._errs_in_rays = any((noise.depth_noise, noise.dropout, noise.false_target, noise.missed_target))

    def begin(self, env_index: int, rng: np.random.RandomState) -> None:
        """Draws the errors of an episode."""
        if self._noise.target_position:
            offset = rng.normal(0.0, self._noise.target_position, 3)
            self._offset[env_index] = torch.as_tensor(offset).to(self._offset)
        if self._errs_in_rays:
            self._generators[env_index].manual_seed(int(rng.randint(2**31 - 1)))

    def known_target(self, target_position: Tensor) -> Tensor:
        """Where targets are believed to be. Shape (B, 3)."""
        return target_position + self._offset if self._noise.target_position else target_position

    def rays(self, rays: ViewRays, mask: Tensor | None = None) -> ViewRays:
        """The rays as they are measured.

        Args:
            rays: What is there.
            mask: The environments that look, all if None; the rays of the others stay as they are. Shape (B,), bool.
        """
        if not self._errs_in_rays:
            return rays
        noise = self._noise
        direction_c, distance, label = rays.direction_c.clone(), rays.distance.clone(), rays.label.clone()
        for k, generator in enumerate(self._generators):
            if mask is not None and not bool(mask[k]):
                continue
            own = slice(k, k + 1)
            measured = disturb(
                ViewRays(direction_c[own], distance[own], label[own]),
                generator,
                depth_noise=noise.depth_noise,
                dropout=noise.dropout,
                false_target=noise.false_target,
                missed_target=noise.missed_target,
            )
            distance[own], label[own] = measured.distance, measured.label
        return ViewRays(direction_c, distance, label)

    def visible_fraction(self, visible_fraction: Tensor) -> Tensor:
        """V_f as it is measured. Shape (B,)."""
        return visible_fraction * (1.0 - self._noise.missed_target)
