"""What a real camera, segmenter and calibration get wrong, as an option of the general tasks."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

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
    """Makes the errors of views; those of one view follow from its seed alone."""

    def __init__(self, noise: SensorNoise, device: torch.device) -> None:
        """Keeps how much is wrong.

        Args:
            noise: How much.
            device: Where tensors live.
        """
        self._noise = noise
        self._generator = torch.Generator(device=device)

    @property
    def are_in_rays(self) -> bool:
        """Whether rays are disturbed at all."""
        noise = self._noise
        return any((noise.depth_noise, noise.dropout, noise.false_target, noise.missed_target))

    def rays(self, rays: ViewRays, seeds: Mapping[int, int]) -> ViewRays:
        """The rays as they are measured.

        Args:
            rays: What is there, in B environments.
            seeds: Of each environment that looks, by its index; the rays of the others stay as they are.
        """
        noise = self._noise
        direction_c, distance, label = rays.direction_c, rays.distance.clone(), rays.label.clone()
        for k, seed in seeds.items():
            self._generator.manual_seed(seed)
            own = slice(k, k + 1)
            measured = disturb(
                ViewRays(direction_c[own], distance[own], label[own]),
                self._generator,
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
