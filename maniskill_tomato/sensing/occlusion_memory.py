"""What an episode's views have told about the foliage around the target: a voxel grid of hits and passes.

The foliage in a voxel is taken for many small leaves at random places, as when leaf area density is estimated from
laser scans: hits divided by the length that rays went through the voxel estimate its density lambda, the expected
hits per length (Beland et al., Agricultural and Forest Meteorology 151, 2011), and a ray of length s through it stays
free with the probability exp(-lambda s). Leaves are larger than voxels, so the estimate of a voxel begins from that of
the 4 cm around it, and that from the 8 cm around those: each time the mean of a gamma posterior.
"""

import math
from typing import Any, Final

import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.sensing import memory_kernels
from maniskill_tomato.warp_runtime import RecordedLaunch, start_warp

GRID_CELLS: Final = int(memory_kernels.CELLS)
"""Voxels along each edge of the grid."""

CELL_SIZE: Final = float(memory_kernels.CELL_SIZE)
"""Edge of a voxel, in [m]."""

MAX_VISITS: Final = int(memory_kernels.MAX_VISITS)
"""Camera positions that are remembered."""

TARGET_RADIUS: Final = 0.028
"""Radius of the disc that stands for the target in predictions, in [m]: the mean of generated ripe fruits."""

_LARGEST_PREDICTION_KEPT = 32


class OcclusionMemory:
    """A grid of 32^3 voxels of 2 cm round the target of each environment, its axes those of the world."""

    def __init__(
        self,
        num_envs: int,
        device: str | torch.device = "cpu",
        unknown_probability: float = 0.01,
        voxel_weight: float = 0.5,
        block_weight: float = 1.0,
    ) -> None:
        """Begins with nothing known and all targets at the origin.

        Args:
            num_envs: Number of environments B.
            device: Where it lives.
            unknown_probability: That something stands on a 2 cm long way through an unknown voxel.
            voxel_weight: How much way observed in a voxel, in voxel edges, counts as much as its surroundings.
            block_weight: The same for the 4 cm around a voxel against the 8 cm around it, and those against the
                assumption.

        Raises:
            InvalidInputError: A number is out of range.
        """
        if num_envs < 1:
            raise InvalidInputError(f"num_envs must be at least 1, got {num_envs}")
        if not 0.0 <= unknown_probability < 1.0:
            raise InvalidInputError(f"unknown_probability must lie in [0, 1), got {unknown_probability}")
        for name, weight in (("voxel_weight", voxel_weight), ("block_weight", block_weight)):
            if not 0.0 < weight < math.inf:
                raise InvalidInputError(f"{name} must be a positive number, got {weight}")
        start_warp()
        self.num_envs = num_envs
        self.device = torch.device(device)
        voxels = GRID_CELLS**3
        self._hits = torch.zeros(num_envs, voxels, dtype=torch.int32, device=self.device)
        self._passes = torch.zeros(num_envs, voxels, dtype=torch.int32, device=self.device)
        self._densities = torch.zeros(num_envs, voxels, device=self.device)
        blocks = int(memory_kernels.BLOCKS)
        self._changed = torch.ones(num_envs, blocks, dtype=torch.int32, device=self.device)
        self._is_estimated = False
        self._centres = torch.zeros(num_envs, 3, device=self.device)
        self._visited = torch.full((num_envs, MAX_VISITS, 3), math.nan, device=self.device)
        self._visits = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
        self._fractions = torch.full((num_envs, MAX_VISITS), math.nan, device=self.device)
        grid: Any = memory_kernels.Grid()
        grid.hits = wp.from_torch(self._hits)
        grid.passes = wp.from_torch(self._passes)
        grid.densities = wp.from_torch(self._densities)
        grid.changed = wp.from_torch(self._changed)
        grid.centres = wp.from_torch(self._centres, dtype=wp.vec3)
        grid.visited = wp.from_torch(self._visited, dtype=wp.vec3)
        grid.visits = wp.from_torch(self._visits)
        grid.fractions = wp.from_torch(self._fractions)
        foliage: Any = memory_kernels.Foliage()
        foliage.density = -math.log1p(-unknown_probability)
        foliage.voxel_weight = voxel_weight
        foliage.block_weight = block_weight
        foliage.radius = TARGET_RADIUS
        self.grid, self.foliage = grid, foliage
        """The same as the kernels see it."""
        self._estimate = RecordedLaunch(
            self.device,
            (memory_kernels.estimate, (num_envs, blocks), [grid, foliage]),
        )
        self._integrations: dict[int, _Integration] = {}
        self._predictions: dict[int, _Prediction] = {}

    @property
    def hits(self) -> Tensor:
        """How many rays ended in each voxel at something other than the target. Shape (B, 32, 32, 32), int32."""
        return self._hits.view(-1, GRID_CELLS, GRID_CELLS, GRID_CELLS)

    @property
    def passed_length(self) -> Tensor:
        """How far rays went through each voxel, in voxel edges. Shape (B, 32, 32, 32), float32."""
        lengths = self._passes.view(-1, GRID_CELLS, GRID_CELLS, GRID_CELLS)
        return lengths / float(memory_kernels.PASS_UNIT)

    @property
    def density(self) -> Tensor:
        """What predictions rest on: expected hits per metre in each voxel. Shape (B, 32, 32, 32), float32."""
        self.estimate()
        # The sign tells known voxels from unknown ones.
        per_edge = self._densities.abs().view(-1, GRID_CELLS, GRID_CELLS, GRID_CELLS)
        return per_edge / CELL_SIZE

    @property
    def known(self) -> Tensor:
        """Which voxels a ray ended in, or went through far enough. Shape (B, 32, 32, 32), bool."""
        self.estimate()
        return ~torch.signbit(self._densities).view(-1, GRID_CELLS, GRID_CELLS, GRID_CELLS)

    @property
    def target_position(self) -> Tensor:
        """The grids' centres, in the world frame, in [m]. Shape (B, 3)."""
        return self._centres

    @property
    def visited(self) -> Tensor:
        """Camera positions so far, in the world frame, in [m]; NaN after the last. Shape (B, 64, 3)."""
        return self._visited

    @property
    def visits(self) -> Tensor:
        """How many views there were. Shape (B,), int32."""
        return self._visits

    @property
    def fractions(self) -> Tensor:
        """V_f of the target as it was measured from each of `visited`; NaN where it was not. Shape (B, 64)."""
        return self._fractions

    def begin(self, env_idx: Tensor, target_position: Tensor) -> None:
        """Forgets everything and centres the grid.

        Args:
            env_idx: Which environments. Shape (b,).
            target_position: Their targets, in the world frame, in [m]. Shape (b, 3).
        """
        if target_position.shape != (env_idx.shape[0], 3):
            raise InvalidInputError(
                f"target_position must have shape ({env_idx.shape[0]}, 3), a row per environment; "
                f"got {tuple(target_position.shape)}"
            )
        self._is_estimated = False
        self._changed[env_idx] = 1
        self._hits[env_idx] = 0
        self._passes[env_idx] = 0
        self._visited[env_idx] = math.nan
        self._visits[env_idx] = 0
        self._fractions[env_idx] = math.nan
        self._centres[env_idx] = target_position.to(self._centres)

    def integrate(
        self,
        T_world_camera: Tensor,
        rays: ViewRays,
        mask: Tensor | None = None,
        *,
        visible_fraction: Tensor | None = None,
    ) -> None:
        """Takes in one view.

        A ray counts as passing up to its distance; OTHER counts as a hit there, TARGET and FREE do not, OUTSIDE counts
        as nothing.

        Args:
            T_world_camera: Where the views were taken: poses of the optical frames. Shape (B, 4, 4).
            rays: What they told.
            mask: The environments that take theirs in, all if None. Shape (B,), bool.
            visible_fraction: V_f of the targets as it was measured; None if it was not. Shape (B,).

        Raises:
            InvalidInputError: A shape does not fit.
        """
        b = self.num_envs
        if T_world_camera.shape != (b, 4, 4) or rays.label.shape[0] != b:
            raise InvalidInputError(
                f"T_world_camera must have shape ({b}, 4, 4) and the rays {b} rows; got "
                f"{tuple(T_world_camera.shape)} and {rays.label.shape[0]} rows"
            )
        if mask is not None and mask.shape != (b,):
            raise InvalidInputError(f"mask must have shape ({b},), got {tuple(mask.shape)}")
        if visible_fraction is not None and visible_fraction.shape != (b,):
            raise InvalidInputError(
                f"visible_fraction must have shape ({b},), got {tuple(visible_fraction.shape)}"
            )
        count = rays.label.shape[1]
        integration = self._integrations.get(count)
        if integration is None:
            integration = self._integrations[count] = _Integration(self, count)
        integration.run(T_world_camera, rays, mask, visible_fraction)
        self._is_estimated = False

    def predict(self, camera_positions: Tensor) -> Tensor:
        """What cameras elsewhere that look at the target would see of it, by what is known.

        Args:
            camera_positions: In the world frame, in [m]. Shape (B, K, 3).

        Returns:
            Expected visible share of the target's disc, and the share of the way from it to the camera, as far as
            the grid reaches, that is unknown. Shape (B, K, 2).

        Raises:
            InvalidInputError: The shape does not fit.
        """
        shape = camera_positions.shape
        if len(shape) != 3 or shape[0] != self.num_envs or shape[2] != 3:
            raise InvalidInputError(
                f"camera_positions must have shape ({self.num_envs}, K, 3), got {tuple(shape)}"
            )
        if shape[1] == 0:
            return camera_positions.new_zeros(shape[0], 0, 2)
        prediction = self._predictions.get(shape[1])
        if prediction is None:
            if len(self._predictions) >= _LARGEST_PREDICTION_KEPT:
                self._predictions.clear()
            prediction = self._predictions[shape[1]] = _Prediction(self, shape[1])
        self.estimate()
        return prediction.run(camera_positions)

    def estimate(self) -> None:
        """Brings the densities that predictions rest on up to date, if anything has changed."""
        if not self._is_estimated:
            self._estimate()
            self._is_estimated = True

    def state(self) -> dict[str, Tensor]:
        """All that is remembered, for `load_state`; copies, each with B rows."""
        return {name: tensor.clone() for name, tensor in self._tensors().items()}

    def load_state(self, state: dict[str, Tensor], env_idx: Tensor | None = None) -> None:
        """Takes back what `state` gave.

        Args:
            state: With a row per environment of `env_idx`.
            env_idx: Which environments, all if None. Shape (b,).

        Raises:
            InvalidInputError: A tensor is missing or has the wrong shape.
        """
        rows = self.num_envs if env_idx is None else env_idx.shape[0]
        own = self._tensors()
        for name, tensor in own.items():
            wanted = (rows, *tensor.shape[1:])
            if name not in state or tuple(state[name].shape) != wanted:
                found = tuple(state[name].shape) if name in state else "nothing"
                raise InvalidInputError(f"state[{name!r}] must have shape {wanted}, got {found}")
        self._is_estimated = False
        rows_of = slice(None) if env_idx is None else env_idx
        for name, tensor in own.items():
            tensor[rows_of] = state[name].to(tensor)
        self._changed[rows_of] = 1

    def _tensors(self) -> dict[str, Tensor]:
        return {
            "hits": self._hits,
            "passes": self._passes,
            "centres": self._centres,
            "visited": self._visited,
            "visits": self._visits,
            "fractions": self._fractions,
        }


class _Integration:
    """The launch for one number of rays, with its tensors."""

    def __init__(self, memory: OcclusionMemory, count: int) -> None:
        b, device = memory.num_envs, memory.device
        self._poses = torch.zeros(b, 4, 4, device=device)
        self._directions = torch.zeros(b, count, 3, device=device)
        self._distances = torch.zeros(b, count, device=device)
        self._labels = torch.zeros(b, count, dtype=torch.int8, device=device)
        self._fractions = torch.zeros(b, device=device)
        self._active = torch.ones(b, dtype=torch.int32, device=device)
        arguments = [
            memory.grid,
            wp.from_torch(self._poses, dtype=wp.mat44),
            wp.from_torch(self._directions, dtype=wp.vec3),
            wp.from_torch(self._distances),
            wp.from_torch(self._labels),
            wp.from_torch(self._fractions),
            wp.from_torch(self._active),
        ]
        self._launch = RecordedLaunch(
            device, (memory_kernels.integrate, (b, -(-count // int(memory_kernels.LANES))), arguments)
        )

    def run(
        self, T_world_camera: Tensor, rays: ViewRays, mask: Tensor | None, visible_fraction: Tensor | None
    ) -> None:
        self._poses.copy_(T_world_camera)
        self._directions.copy_(rays.direction_c)
        self._distances.copy_(rays.distance)
        self._labels.copy_(rays.label)
        if visible_fraction is None:
            self._fractions.fill_(math.nan)
        else:
            self._fractions.copy_(visible_fraction)
        if mask is None:
            self._active.fill_(1)
        else:
            self._active.copy_(mask)
        self._launch()


class _Prediction:
    """The launch for one number of candidates, with its tensors."""

    def __init__(self, memory: OcclusionMemory, count: int) -> None:
        b, device = memory.num_envs, memory.device
        self._positions = torch.zeros(b, count, 3, device=device)
        self._predictions = torch.zeros(b, count, 2, device=device)
        arguments = [
            memory.grid,
            memory.foliage,
            wp.from_torch(self._positions, dtype=wp.vec3),
            wp.from_torch(self._predictions, dtype=wp.vec2),
        ]
        self._launch = RecordedLaunch(device, (memory_kernels.predict, (b, count), arguments))

    def run(self, camera_positions: Tensor) -> Tensor:
        self._positions.copy_(camera_positions)
        self._launch()
        return self._predictions.clone()
