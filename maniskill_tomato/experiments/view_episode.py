"""One episode of a policy that moves the camera: what it saw, where it went, what it touched."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError

Float64 = NDArray[np.float64]

ROUNDED = {"visible_fraction": 5, "camera": 5, "qpos": 5, "target": 5, "clearance": 5, "decision_ms": 4}
"""Decimals of what is stored: 10 um, 10 urad."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewEpisode:
    """An episode of T moves, from the start view 0 to the last view T."""

    episode: int
    """Which episode of the list, or the seed of its reset."""
    success: bool
    """Whether V_f passed the task's threshold."""
    visible_fraction: Float64
    """True V_f at every view. Shape (T + 1,)."""
    camera: Float64
    """Camera positions in the world frame, in [m]. Shape (T + 1, 3)."""
    qpos: Float64
    """Joint angles, in [rad]. Shape (T + 1, 7)."""
    target: Float64
    """Position of the target in the world frame, in [m]. Shape (3,)."""
    refused: NDArray[np.bool_]
    """Whether the arm refused each move. Shape (T,)."""
    contact: NDArray[np.bool_]
    """Whether each move touched the plant. Shape (T,)."""
    clearance: Float64
    """Smallest distance between arm and plant during each move, in [m]; NaN where it is not known. Shape (T,)."""
    decision_ms: Float64
    """Wall time of each decision, in [ms]. Shape (T,)."""
    oracle_moves: int | None = None
    """Fewest moves known for this episode; None if no solution is known."""

    def __post_init__(self) -> None:
        moves = len(self.decision_ms)
        shapes = {
            "visible_fraction": (moves + 1,),
            "camera": (moves + 1, 3),
            "qpos": (moves + 1, 7),
            "target": (3,),
            "refused": (moves,),
            "contact": (moves,),
            "clearance": (moves,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InvalidInputError(
                    f"{name} of an episode with {moves} moves must have shape {shape}, "
                    f"got {getattr(self, name).shape}"
                )

    @property
    def moves(self) -> int:
        """Number of moves T."""
        return len(self.decision_ms)

    @property
    def best_visible_fraction(self) -> float:
        """Largest V_f of any view, the start view among them."""
        return float(self.visible_fraction.max())

    @property
    def path_length(self) -> float:
        """Way of the camera as the sum of the straight distances between views, in [m]."""
        return float(np.linalg.norm(np.diff(self.camera, axis=0), axis=1).sum())

    @property
    def joint_path_length(self) -> float:
        """Way of all joints together: the sum over moves and joints of |dq|, in [rad]."""
        return float(np.abs(np.diff(self.qpos, axis=0)).sum())

    def moves_to(self, threshold: float, horizon: int) -> int | None:
        """After how many moves V_f was first above a threshold; None if not within the horizon."""
        above = np.flatnonzero(self.visible_fraction[: horizon + 1] > threshold)
        return int(above[0]) if len(above) else None

    def best_so_far(self, horizon: int) -> Float64:
        """Largest V_f seen after 1, 2, ... moves; an episode that ended keeps its last value. Shape (horizon,)."""
        best = np.maximum.accumulate(self.visible_fraction)
        after = np.minimum(np.arange(1, horizon + 1), self.moves)
        held: Float64 = best[after]
        return held

    def to_json(self) -> dict[str, Any]:
        """Plain numbers and lists; NaN becomes None."""
        content: dict[str, Any] = {
            "episode": self.episode,
            "success": self.success,
            "oracle_moves": self.oracle_moves,
            "refused": self.refused.astype(int).tolist(),
            "contact": self.contact.astype(int).tolist(),
        }
        for name, decimals in ROUNDED.items():
            content[name] = _plain(np.round(getattr(self, name), decimals))
        return content

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "ViewEpisode":
        """The episode that `to_json` wrote.

        Raises:
            InvalidInputError: A value is missing or has another shape.
        """
        try:
            moves = len(content["refused"])
            arrays = {name: np.array(content[name], dtype=np.float64) for name in ROUNDED}
            arrays["clearance"] = arrays["clearance"].reshape(moves)
            return cls(
                episode=int(content["episode"]),
                success=bool(content["success"]),
                oracle_moves=content["oracle_moves"],
                refused=np.array(content["refused"], dtype=np.bool_),
                contact=np.array(content["contact"], dtype=np.bool_),
                **arrays,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInputError(f"a stored episode cannot be read: {error}") from error


def _plain(values: Any) -> Any:
    """Nested lists of numbers, with None for those that are not finite."""
    listed = values.tolist()
    if values.ndim == 1:
        return [value if math.isfinite(value) else None for value in listed]
    return listed
