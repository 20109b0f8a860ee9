"""What a policy may know when it decides where to look next, and what a policy is."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.sensing.occlusion_memory import OcclusionMemory
from maniskill_tomato.sensing.view_lattice import ViewLattice


@dataclass(frozen=True, eq=False, kw_only=True)
class Belief:
    """What is known in B environments after a look: nothing that a robot with a wrist camera could not know."""

    observation: Tensor
    """`ViewpointObserver.observe`'s vector. Shape (B, D)."""
    viewpoint: Tensor
    """Of the flange: x, y, z, in [m], roll, pitch, yaw, in [rad], in the base frame. Shape (B, 6)."""
    camera_position: Tensor
    """In the base frame, in [m]. Shape (B, 3)."""
    target_position: Tensor
    """In the base frame, in [m]. Shape (B, 3)."""
    visible_fraction: Tensor
    """V_f as the camera measures it. Shape (B,)."""
    moves_left: Tensor
    """Moves until the episode ends. Shape (B,), int64."""
    rays: ViewRays
    """What the last view told."""
    memory: OcclusionMemory
    """What all views told; it changes with the next one."""
    lattice: ViewLattice
    """Candidates round the target."""
    reachable: Tensor
    """Which candidates the arm reaches. Shape (B, K), bool."""


class ViewpointPolicy(Protocol):
    """Decides on moves of the `pd_look_at` control mode."""

    name: str
    """In reports and on the command line."""
    needs_truth: bool
    """Whether it asks the simulator for what no camera could tell."""

    def begin(self, belief: Belief, env_idx: Tensor) -> None:
        """Forgets the episodes of some environments.

        Args:
            belief: The first of the new episodes.
            env_idx: Which environments begin anew. Shape (b,).
        """

    def act(self, belief: Belief) -> Tensor:
        """The next move: right, up, forward, in [-1, 1]. Shape (B, 3)."""
        ...
