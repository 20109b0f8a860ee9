"""The state of N episodes: one table of tensors with the environment as first axis."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError

MAX_VIEWS = 64
"""Views of a target that are remembered; as many as the occlusion memory counts."""

MAX_TARGETS = 64
"""Ripe fruits of a row that are kept track of."""

NOISE_SEEDS = 2**24
"""Seeds of sensors' errors are below this, so that a saved state can hold them as float32."""


def _column(*shape: int, dtype: torch.dtype = torch.float32) -> Any:
    return field(metadata={"shape": shape, "dtype": dtype})


@dataclass(eq=False, kw_only=True)
class WorldState:
    """Everything that decides how N episodes go on, but for their random generators.

    Counts are int64. What a task does not use stays 0.
    """

    qpos: Tensor = _column(7)
    """Joint positions, in [rad]. Shape (N, 7)."""
    viewpoint: Tensor = _column(6)
    """Of the flange: x, y, z [m], roll, pitch, yaw [rad], base frame. Shape (N, 6)."""
    reach: Tensor = _column(dtype=torch.int64)
    """`Reach` of the last move. Shape (N,)."""
    plant_seed: Tensor = _column(dtype=torch.int64)
    """Seeds of the plants. Shape (N,)."""
    plant_pose: Tensor = _column(3)
    """Stem's x, y [m] and yaw [rad], world frame. Shape (N, 3)."""
    target: Tensor = _column(dtype=torch.int64)
    """Index of the target in `Plant.fruits`. Shape (N,)."""
    visible_fraction: Tensor = _column()
    """V_f of the target in the present view, as success and reward go by. Shape (N,)."""
    fraction_before: Tensor = _column()
    """V_f before the last move, of the target that it was made for. Shape (N,)."""
    fraction_after: Tensor = _column()
    """The same after it. Shape (N,)."""
    moves: Tensor = _column(dtype=torch.int64)
    """Moves of the episode. Shape (N,)."""
    path_length: Tensor = _column()
    """Length of the camera's way, in [m]. Shape (N,)."""
    joint_path_length: Tensor = _column()
    """Way of all joints together, in [rad]. Shape (N,)."""
    clearance: Tensor = _column()
    """Smallest distance of arm and plant on the last move, in [m]. Shape (N,)."""
    views: Tensor = _column(MAX_VIEWS, 7)
    """Joint positions at every view of the present target, in [rad]. Shape (N, `MAX_VIEWS`, 7)."""
    view_count: Tensor = _column(dtype=torch.int64)
    """How many these are. Shape (N,)."""
    looks: Tensor = _column(dtype=torch.int64)
    """Views of the episode. Shape (N,)."""
    noise_seed: Tensor = _column(dtype=torch.int64)
    """What the sensors' errors of the episode follow from. Shape (N,)."""
    position_error: Tensor = _column(3)
    """Where the target is believed to be, before a camera locates it, less where it is, in [m]. Shape (N, 3)."""
    hidden_below: Tensor = _column()
    """The first view of the first target shows less of it than this V_f; 0 if that is not known. Shape (N,)."""
    open_targets: Tensor = _column(MAX_TARGETS, dtype=torch.bool)
    """The fruits that are yet to be looked for, the target among them. Shape (N, `MAX_TARGETS`)."""
    targets_begun: Tensor = _column(dtype=torch.int64)
    """Targets of the episode so far. Shape (N,)."""
    seen_count: Tensor = _column(dtype=torch.int64)
    """Targets that were seen. Shape (N,)."""
    target_count: Tensor = _column(dtype=torch.int64)
    """Targets of the episode. Shape (N,)."""
    target_moves: Tensor = _column(dtype=torch.int64)
    """Moves made for the present target. Shape (N,)."""
    target_done: Tensor = _column(dtype=torch.bool)
    """Whether the target of the last move was seen. Shape (N,)."""
    transits: Tensor = _column(dtype=torch.int64)
    """Transits of the last move. Shape (N,)."""

    @classmethod
    def zeros(cls, num_envs: int, device: torch.device) -> "WorldState":
        """The state of N environments before their first reset."""
        return cls(
            **{
                f.name: torch.zeros(num_envs, *f.metadata["shape"], dtype=f.metadata["dtype"], device=device)
                for f in fields(cls)
            }
        )

    def rows(self, names: Iterable[str]) -> dict[str, Tensor]:
        """Copies of some columns as float32, each of shape (N, D)."""
        columns: dict[str, Tensor] = {name: getattr(self, name) for name in names}
        return {
            name: column.reshape(len(column), -1).to(torch.float32, copy=True)
            for name, column in columns.items()
        }

    def put(self, env_idx: Tensor, rows: Mapping[str, Tensor]) -> None:
        """Takes back what `rows` gave, for some environments.

        Args:
            env_idx: Which. Shape (b,).
            rows: Each of shape (b, D).
        """
        for name, values in rows.items():
            column: Tensor = getattr(self, name)
            column = column.clone()
            column[env_idx] = values.to(column.dtype).view(len(env_idx), *column.shape[1:])
            setattr(self, name, column)

    def save(self) -> dict[str, Tensor]:
        """Copies of all columns on the CPU."""
        return {f.name: getattr(self, f.name).detach().cpu().clone() for f in fields(self)}

    def restore(self, saved: Mapping[str, Tensor]) -> None:
        """Takes back what `save` gave.

        Raises:
            InvalidInputError: It is of another number of environments, or something is missing.
        """
        for f in fields(self):
            own: Tensor = getattr(self, f.name)
            if f.name not in saved or saved[f.name].shape != own.shape:
                found = tuple(saved[f.name].shape) if f.name in saved else "nothing"
                raise InvalidInputError(
                    f"the state's {f.name} must have shape {tuple(own.shape)}, got {found}"
                )
            setattr(self, f.name, saved[f.name].to(own).clone())
