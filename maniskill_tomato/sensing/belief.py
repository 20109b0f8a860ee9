"""What a policy may know when it decides where to look next."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.sensing.occlusion_memory import OcclusionMemory
from maniskill_tomato.sensing.view_lattice import ViewLattice

if TYPE_CHECKING:
    from maniskill_tomato.sensing.image_observation import ImageSource
    from maniskill_tomato.sensing.observation import ObservationLayout
    from maniskill_tomato.sensing.perception_kinds import Part


@dataclass(frozen=True, eq=False, kw_only=True)
class Belief:
    """What is known in B environments after a view: nothing that a robot with a wrist camera could not know."""

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
    qpos: Tensor | None = None
    """Joint positions, in [rad]; None for a camera that no arm holds. Shape (B, 7)."""
    layout: "ObservationLayout | None" = None
    """What `observation` holds; None where that is not known."""
    images: "ImageSource | None" = None
    """Delivers what the cameras see as images; None where there is no camera."""

    def part(self, name: "Part") -> Tensor:
        """A part of the observation. Shape (B, D).

        Raises:
            InvalidInputError: The observation does not hold it.
        """
        if self.layout is None or name not in self.layout.parts:
            held = "" if self.layout is None else f", which holds {', '.join(self.layout.parts)}"
            raise InvalidInputError(f"this policy needs the part {name!r} of the observation{held}")
        return self.observation[:, self.layout.slices[name]]
