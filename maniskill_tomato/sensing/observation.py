"""The observation of the general viewpoint task: one function for the simulated and the real camera.

The vector has named parts (`ObservationLayout`), all scaled to about [-1, 1]. The patch and the maps stand in the look
frame (`robot.look_at.look_frame`) as the moves do: their columns go to the camera's right, their rows from above down,
whatever its roll.
"""

from dataclasses import dataclass
from typing import Any, Final, get_args

import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.view_rays import RAYS_PER_SIDE, ViewRays
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.sensing import observation_kernels as kernels
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.occlusion_memory import OcclusionMemory
from maniskill_tomato.sensing.perception_kinds import Part
from maniskill_tomato.sensing.view_lattice import FIRST_DISTANCE, ViewLattice
from maniskill_tomato.warp_runtime import RecordedLaunch

PATCH_SIDE: Final = int(kernels.PATCH)
MAP_SIDE: Final = int(kernels.MAP)
NEAR_MAP_SIDE: Final = int(kernels.NEAR_MAP)

PART_SHAPES: Final[dict[Part, tuple[int, ...]]] = {
    "viewpoint": (6,),
    "pose": (7,),
    "target": (3,),
    "visible_fraction": (1,),
    "time": (1,),
    "patch": (3, PATCH_SIDE, PATCH_SIDE),
    "map": (4, MAP_SIDE, MAP_SIDE),
    "near_map": (2, NEAR_MAP_SIDE, NEAR_MAP_SIDE),
}
"""The shape that each part has before it is laid flat."""

WORKSPACE_MIDDLE: Final = (0.7, 0.0, 0.8)
"""The place in the base frame that becomes 0, in [m]."""
WORKSPACE_HALF_SIZE: Final = (0.5, 0.5, 0.6)
"""The distances from there that become 1, in [m]."""


@dataclass(frozen=True, kw_only=True)
class ObservationLayout:
    """Which parts the vector has, in this order.

    - `viewpoint` (6): the flange's x, y, z about the middle of the workspace, roll, pitch, yaw by pi.
    - `pose` (7): camera relative to the target by 0.5 m, distance by 0.5 m less 1, direction from the target; axes of
      the world.
    - `target` (3): its position about the middle of the workspace.
    - `visible_fraction` (1): 2 V_f - 1.
    - `time` (1): twice the share of the moves left, less 1.
    - `patch` (3 x 8 x 8): of 2 x 2 rays each the share that sees the target less the share outside the image; the
      share that meets something in front of the target's plane; the mean gap between what they meet and that plane
      by 0.32 m, positive in front.
    - `map` (4 x 11 x 11): for cameras turned about the target in steps of 10 degrees to the right and up, at the
      present distance: twice the visible share that the memory predicts, less 1; the unknown share of the way; looked
      from before; unreachable.
    - `near_map` (2 x 7 x 7): the same in steps of 15 degrees at 0.6 of the distance: predicted, unreachable.
    """

    parts: tuple[Part, ...] = ("pose", "target", "visible_fraction", "time", "patch", "map", "near_map")
    """What the vector holds."""

    def __post_init__(self) -> None:
        if not self.parts:
            raise InvalidInputError(f"parts must name at least one of {get_args(Part)}")
        for part in self.parts:
            if part not in PART_SHAPES:
                raise InvalidInputError.choice("a part of the observation", part, get_args(Part))
        if len(set(self.parts)) != len(self.parts):
            raise InvalidInputError(f"parts must name each part once, got {self.parts}")

    @classmethod
    def blind(cls) -> "ObservationLayout":
        """The thesis's nine numbers: the flange's viewpoint and the target's position."""
        return cls(parts=("viewpoint", "target"))

    @classmethod
    def without_memory(cls) -> "ObservationLayout":
        """What the present view tells alone."""
        return cls(parts=("pose", "target", "visible_fraction", "time", "patch"))

    @property
    def slices(self) -> dict[Part, slice]:
        """Where each part stands in the vector."""
        slices: dict[Part, slice] = {}
        start = 0
        for part in self.parts:
            length = _length(part)
            slices[part] = slice(start, start + length)
            start += length
        return slices

    @property
    def size(self) -> int:
        """Length D of the vector."""
        return sum(_length(part) for part in self.parts)


class ViewpointObserver:
    """Turns looks into observations, with a memory of each episode."""

    def __init__(
        self,
        num_envs: int = 1,
        device: str | torch.device = "cpu",
        layout: ObservationLayout | None = None,
        max_moves: int = 20,
        memory: OcclusionMemory | None = None,
        model: ArmModel = IIWA14,
    ) -> None:
        """Begins with all targets at the origin.

        Args:
            num_envs: Number of environments B.
            device: Where all tensors live.
            layout: What the vector holds, the defaults if None.
            max_moves: Moves of an episode, which `time` counts by.
            memory: To be filled, a new one with its defaults if None.
            model: Of the arm that carries the camera.

        Raises:
            InvalidInputError: A number is out of range.
        """
        if max_moves < 1:
            raise InvalidInputError(f"max_moves must be at least 1, got {max_moves}")
        self.num_envs = num_envs
        self.device = torch.device(device)
        self.layout = layout or ObservationLayout()
        self.max_moves = max_moves
        self.memory = memory or OcclusionMemory(num_envs, self.device)
        self.lattice = ViewLattice(self.device, model)
        self._needs_memory = bool({"map", "near_map"} & set(self.layout.parts))
        self._belief: Belief | None = None
        self._allocate()

    @property
    def belief(self) -> Belief:
        """What the last `observe` told, for planners.

        Raises:
            InvalidInputError: Nothing has been observed yet.
        """
        if self._belief is None:
            raise InvalidInputError("there is no belief before the first observe")
        return self._belief

    def begin(self, env_idx: Tensor, target_position: Tensor) -> None:
        """Begins episodes: forgets what was seen and works out which candidates the arm reaches.

        Args:
            env_idx: Which environments. Shape (b,).
            target_position: Their targets, in the base frame, in [m]. Shape (b, 3).
        """
        self.memory.begin(env_idx, target_position)
        self._reachable[env_idx] = self.lattice.reachable(target_position.to(self.device)).to(torch.uint8)

    def observe(
        self,
        viewpoint: Tensor,
        T_world_camera: Tensor,
        rays: ViewRays,
        visible_fraction: Tensor,
        moves_left: Tensor,
        mask: Tensor | None = None,
        qpos: Tensor | None = None,
    ) -> Tensor:
        """Takes one view into the memory and describes what is known. To be called once for every view.

        Args:
            viewpoint: Of the flange: x, y, z, in [m], roll, pitch, yaw, in [rad], base frame. Shape (B, 6).
            T_world_camera: Poses of the optical frames in the base frame. Shape (B, 4, 4).
            rays: What the cameras see.
            visible_fraction: V_f as they measure it. Shape (B,).
            moves_left: Moves until the episode ends. Shape (B,).
            mask: The environments that looked anew, all if None; memory and vector of the others stay as they are.
                Shape (B,), bool.
            qpos: Joint positions, in [rad]; None if no arm holds the cameras. Shape (B, 7).

        Returns:
            The vector that `layout` describes. Shape (B, D), float32.

        Raises:
            InvalidInputError: A shape does not fit.
        """
        b = self.num_envs
        for name, tensor, shape in (
            ("viewpoint", viewpoint, (b, 6)),
            ("T_world_camera", T_world_camera, (b, 4, 4)),
            ("rays.label", rays.label, (b, RAYS_PER_SIDE**2)),
            ("visible_fraction", visible_fraction, (b,)),
            ("moves_left", moves_left, (b,)),
        ):
            if tuple(tensor.shape) != shape:
                raise InvalidInputError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
        if qpos is not None and tuple(qpos.shape) != (b, NUM_JOINTS):
            raise InvalidInputError(f"qpos must have shape {(b, NUM_JOINTS)}, got {tuple(qpos.shape)}")
        self.memory.integrate(T_world_camera, rays, mask, visible_fraction=visible_fraction)
        self._viewpoints.copy_(viewpoint)
        self._camera_poses.copy_(T_world_camera)
        self._visible_fractions.copy_(visible_fraction)
        self._time_left.copy_(moves_left)
        self._time_left.mul_(1.0 / self.max_moves)
        self._directions.copy_(rays.direction_c)
        self._distances.copy_(rays.distance)
        self._labels.copy_(rays.label)
        if mask is None:
            self._looked.fill_(1)
        else:
            self._looked.copy_(mask)
        if self._needs_memory:
            self.memory.estimate()
        self._launch()
        observation = self._observation.clone()
        self._belief = Belief(
            observation=observation,
            viewpoint=viewpoint,
            camera_position=self._camera_poses[:, :3, 3].clone(),
            target_position=self.memory.target_position.clone(),
            visible_fraction=visible_fraction,
            moves_left=moves_left.long(),
            rays=rays,
            memory=self.memory,
            lattice=self.lattice,
            reachable=self._reachable.bool(),
            qpos=None if qpos is None else qpos.clone(),
            layout=self.layout,
        )
        return observation

    def state_dict(self) -> dict[str, Tensor]:
        """All that the next observations depend on; copies, each with B rows."""
        return {**self.memory.state(), "reachable": self._reachable.clone()}

    def load_state_dict(self, state: dict[str, Tensor], env_idx: Tensor | None = None) -> None:
        """Takes back what `state_dict` gave.

        Args:
            state: With a row per environment of `env_idx`.
            env_idx: Which environments, all if None. Shape (b,).

        Raises:
            InvalidInputError: A tensor is missing or has the wrong shape.
        """
        rows = self.num_envs if env_idx is None else env_idx.shape[0]
        wanted = (rows, self.lattice.size)
        found = tuple(state["reachable"].shape) if "reachable" in state else "nothing"
        if found != wanted:
            raise InvalidInputError(f"state['reachable'] must have shape {wanted}, got {found}")
        self.memory.load_state(state, env_idx)
        self._reachable[slice(None) if env_idx is None else env_idx] = state["reachable"].to(self._reachable)

    def _allocate(self) -> None:
        b, n, device = self.num_envs, RAYS_PER_SIDE**2, self.device
        self._viewpoints = torch.zeros(b, 6, device=device)
        self._camera_poses = torch.eye(4, device=device).repeat(b, 1, 1)
        self._visible_fractions = torch.zeros(b, device=device)
        self._time_left = torch.zeros(b, device=device)
        self._directions = torch.zeros(b, n, 3, device=device)
        self._distances = torch.zeros(b, n, device=device)
        self._labels = torch.zeros(b, n, dtype=torch.int8, device=device)
        self._reachable = torch.zeros(b, self.lattice.size, dtype=torch.uint8, device=device)
        self._looked = torch.ones(b, dtype=torch.int32, device=device)
        self._observation = torch.zeros(b, self.layout.size, device=device)
        belief: Any = kernels.Belief()
        belief.viewpoints = wp.from_torch(self._viewpoints)
        belief.camera_poses = wp.from_torch(self._camera_poses, dtype=wp.mat44)
        belief.visible_fractions = wp.from_torch(self._visible_fractions)
        belief.time_left = wp.from_torch(self._time_left)
        belief.directions = wp.from_torch(self._directions, dtype=wp.vec3)
        belief.distances = wp.from_torch(self._distances)
        belief.labels = wp.from_torch(self._labels)
        belief.reachable = wp.from_torch(self._reachable)
        belief.looked = wp.from_torch(self._looked)
        layout: Any = kernels.Layout()
        slices = self.layout.slices
        for part in PART_SHAPES:
            setattr(layout, part, slices[part].start if part in slices else -1)
        layout.nearest = FIRST_DISTANCE
        layout.target_middle = wp.vec3(*WORKSPACE_MIDDLE)
        layout.target_scale = wp.vec3(*WORKSPACE_HALF_SIZE)
        threads = (b, 1 + PATCH_SIDE**2 + MAP_SIDE**2 + NEAR_MAP_SIDE**2)
        arguments = [
            belief,
            self.memory.grid,
            self.memory.foliage,
            layout,
            wp.from_torch(self._observation),
        ]
        self._launch = RecordedLaunch(device, (kernels.observe, threads, arguments))


def _length(part: Part) -> int:
    length = 1
    for side in PART_SHAPES[part]:
        length *= side
    return length
