"""What is sensed of the targets: the truth with a sensor's errors, or what a simulated camera measures.

The errors of a view follow from the episode's `noise_seed` and the number of the view, so that no environment changes
another's, and a view that is looked at again is measured the same.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.sensor_noise import SensorErrors, SensorNoise
from maniskill_tomato.tasks.world import World
from maniskill_tomato.tasks.world_state import NOISE_SEEDS

VIEWS_A_SEED = 256
"""Views of an episode are fewer than this."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sight:
    """What N environments sense in a view."""

    rays: ViewRays
    """The pattern about where the targets are believed to be."""
    visible_fraction: Tensor
    """V_f that success and reward go by. Shape (N,)."""
    told_fraction: Tensor
    """V_f that the policy is told. Shape (N,)."""
    true_fraction: Tensor
    """V_f as it is. Shape (N,)."""
    tomato_seen: Tensor
    """Whether any ripe tomato is in view. Shape (N,), bool."""
    chosen_fraction: Tensor | None = None
    """V_f as it is of the fruit that a camera took for the target, 0 if of none; None without a camera. Shape (N,)."""
    chosen_fruit: Tensor | None = None
    """Which that is, as an index in `Plant.fruits`, -1 for none. Shape (N,)."""
    named: Tensor | None = None
    """Whether the robot knows which track its target is. Shape (N,), bool."""

    def where(self, mask: Tensor, other: "Sight") -> "Sight":
        """This sight where `mask` is True, else the other one. Shape (N,), bool."""
        column = mask[:, None]
        mine, others = self.rays, other.rays
        return Sight(
            rays=ViewRays(
                torch.where(column[..., None], mine.direction_c, others.direction_c),
                torch.where(column, mine.distance, others.distance),
                torch.where(column, mine.label, others.label),
            ),
            visible_fraction=torch.where(mask, self.visible_fraction, other.visible_fraction),
            told_fraction=torch.where(mask, self.told_fraction, other.told_fraction),
            true_fraction=torch.where(mask, self.true_fraction, other.true_fraction),
            tomato_seen=torch.where(mask, self.tomato_seen, other.tomato_seen),
            chosen_fraction=_where(mask, self.chosen_fraction, other.chosen_fraction),
            chosen_fruit=_where(mask, self.chosen_fruit, other.chosen_fruit),
            named=_where(mask, self.named, other.named),
        )


def _where(mask: Tensor, mine: Tensor | None, others: Tensor | None) -> Tensor | None:
    return None if mine is None or others is None else torch.where(mask, mine, others)


@dataclass(frozen=True, eq=False, kw_only=True)
class Vantage:
    """From where environments look."""

    T_w_camera: Tensor
    """Poses of the optical frames. Shape (N, 4, 4)."""
    T_w_links: Tensor
    """Poses of the links. Shape (N, 9, 4, 4)."""
    qpos: Tensor
    """Joint positions, in [rad]. Shape (N, 7)."""
    look: Tensor
    """Number of the view in its episode, from 0. Shape (N,)."""
    mask: Tensor | None = None
    """Which environments look; all if None. Shape (N,), bool."""

    def seeds(self, noise_seed: Tensor) -> dict[int, int]:
        """What the errors of this view follow from, for each environment that looks, by its index.

        Args:
            noise_seed: Of the episodes. Shape (N,).
        """
        seeds = (noise_seed * VIEWS_A_SEED + self.look % VIEWS_A_SEED).tolist()
        looks = [True] * len(seeds) if self.mask is None else self.mask.tolist()
        return {i: int(seed) for i, (seed, looked) in enumerate(zip(seeds, looks, strict=True)) if looked}


class Senses(Protocol):
    """What the environments of a world sense."""

    def begin(self, env_index: int, rng: np.random.RandomState, hidden_below: float) -> None:
        """Draws what the errors of an episode follow from; `hidden_below` as in `WorldState`."""
        ...

    def begin_targets(self, env_idx: Tensor) -> None:
        """Begins with other targets, of which nothing was seen yet. Shape (b,)."""
        ...

    def recall_targets(self, env_idx: Tensor) -> None:
        """The same for targets that were begun before, from the state of the world."""
        ...

    def known_target(self) -> Tensor:
        """Where the targets are believed to be, world frame, in [m]. Shape (N, 3)."""
        ...

    def look(self, vantage: Vantage) -> tuple[Sight, Tensor | None]:
        """Looks; the second is which environments have located their target just now. Shape (b,)."""
        ...

    def revise(self, observer: ViewpointObserver, env_idx: Tensor) -> None:
        """Makes an observer take the earlier views of some environments in again, about where their targets are known
        to be now, all but the present view. Shape (b,)."""
        ...


class ExactSenses:
    """The truth, with the errors of a `SensorNoise`."""

    def __init__(self, world: World, noise: SensorNoise) -> None:
        """Senses in a world.

        Args:
            world: The plants and arms.
            noise: How much is wrong.
        """
        self._world = world
        self._noise = noise
        self._errors = SensorErrors(noise, world.device)

    def begin(self, env_index: int, rng: np.random.RandomState, hidden_below: float) -> None:
        """Draws the target's believed position and the seed of the rays' errors, where there are any."""
        state = self._world.state
        if self._noise.target_position:
            error = rng.normal(0.0, self._noise.target_position, 3)
            state.position_error[env_index] = torch.as_tensor(error).to(state.position_error)
        if self._errors.are_in_rays:
            state.noise_seed[env_index] = int(rng.randint(2**31 - 1)) % NOISE_SEEDS

    def begin_targets(self, env_idx: Tensor) -> None:
        """Nothing: the error of a target's position lasts for an episode."""

    def recall_targets(self, env_idx: Tensor) -> None:
        """Nothing."""

    def known_target(self) -> Tensor:
        """Where the targets are, with the episode's error. Shape (N, 3)."""
        position = self._world.target_position_w
        return position + self._world.state.position_error if self._noise.target_position else position

    def look(self, vantage: Vantage) -> tuple[Sight, Tensor | None]:
        """Casts rays."""
        world = self._world
        target, T_w_plant = world.state.target, world.planting.T_world_plant
        seen = world.scene.visibility(vantage.T_w_camera, target, T_w_plant, vantage.T_w_links)
        rays = world.scene.view_rays(
            vantage.T_w_camera, target, self.known_target(), T_w_plant, vantage.T_w_links
        )
        if self._errors.are_in_rays:
            rays = self._errors.rays(rays, vantage.seeds(world.state.noise_seed))
        fraction = seen.visible_fraction
        return Sight(
            rays=rays,
            visible_fraction=fraction,
            told_fraction=self._errors.visible_fraction(fraction),
            true_fraction=fraction,
            tomato_seen=seen.any_visible,
        ), None

    def revise(self, observer: ViewpointObserver, env_idx: Tensor) -> None:
        """Nothing: where a target is believed to be does not change."""
