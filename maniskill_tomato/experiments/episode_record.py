"""What is kept of one episode of any task: where the camera went, what it saw, what it cost."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.inverse_kinematics import Reach

Float64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class RowSearch:
    """What the search of a row of plants came to."""

    targets: tuple[int, ...]
    """The tomatoes to be seen, as indices in `Plant.fruits`."""
    seen: tuple[int, ...]
    """Those that were fully visible while they were the target."""
    moves: int
    """Moves, each transit counted as `TRANSIT_MOVES`."""
    transits: int
    path_m: float
    """Way of the camera, transits included, in [m]."""
    joint_path_rad: float
    """Way of all joints together, transits included, in [rad]."""
    listed: tuple[dict[str, Any], ...] | None = None
    """The inspection list of a robot with a camera beside the truth, see `JudgedFruit`; None without a camera."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EpisodeRecord:
    """An episode of T steps, from the start view 0 to the last view T; what its task does not tell is None."""

    seed: int
    """The seed of its reset, or its number in a fixed list."""
    success: bool
    """Whether the task counts it as solved."""
    visible_fraction: Float64
    """V_f of the target at every view, as the task measures it. Shape (T + 1,)."""
    viewpoints: Float64
    """End-effector x, y, z [m], roll, pitch, yaw [rad], world frame, at every view. Shape (T + 1, 6)."""
    target: Float64
    """Where the policy takes the target to be at every view, world frame, in [m]. Shape (T + 1, 3)."""
    rewards: Float64
    """R of every step. Shape (T,)."""
    reachability: NDArray[np.int64]
    """`Reach` of every step. Shape (T,)."""
    decision_ms: Float64
    """Wall time of each decision, in [ms]. Shape (T,)."""
    camera: Float64 | None = None
    """Camera positions at every view, world frame, in [m]. Shape (T + 1, 3)."""
    qpos: Float64 | None = None
    """Joint angles at every view, in [rad]. Shape (T + 1, 7)."""
    in_forbidden_zone: NDArray[np.bool_] | None = None
    """Whether each step ended in the forbidden zone. Shape (T,)."""
    contact: NDArray[np.bool_] | None = None
    """Whether the arm touched a plant on each step. Shape (T,)."""
    clearance: Float64 | None = None
    """Smallest distance between arm and plant on each step, in [m]; NaN where it is not known. Shape (T,)."""
    true_visible_fraction: Float64 | None = None
    """True V_f at every view, where `visible_fraction` is measured by a camera. Shape (T + 1,)."""
    true_target: Float64 | None = None
    """Where the target is at every view, world frame, in [m]. Shape (T + 1, 3)."""
    chosen_visible_fraction: Float64 | None = None
    """True V_f of the fruit that a camera took for the target at every view, 0 if of none. Shape (T + 1,)."""
    chosen_fruit: NDArray[np.int64] | None = None
    """Which that is, as an index in `Plant.fruits`, -1 for none. Shape (T + 1,)."""
    target_fruit: NDArray[np.int64] | None = None
    """The target, likewise. Shape (T + 1,)."""
    target_named: NDArray[np.bool_] | None = None
    """Whether the robot knew which of its tracks the target is, at every view. Shape (T + 1,)."""
    oracle_moves: int | None = None
    """Fewest moves known for this episode; None if no solution is known."""
    row: RowSearch | None = None
    """For the search of a row only."""

    SHAPES: ClassVar[dict[str, tuple[int, tuple[int, ...], int]]] = {
        "visible_fraction": (1, (), 5),
        "viewpoints": (1, (6,), 6),
        "target": (1, (3,), 5),
        "rewards": (0, (), 6),
        "reachability": (0, (), 0),
        "decision_ms": (0, (), 4),
        "camera": (1, (3,), 5),
        "qpos": (1, (7,), 5),
        "in_forbidden_zone": (0, (), 0),
        "contact": (0, (), 0),
        "clearance": (0, (), 5),
        "true_visible_fraction": (1, (), 5),
        "true_target": (1, (3,), 5),
        "chosen_visible_fraction": (1, (), 5),
        "chosen_fruit": (1, (), 0),
        "target_fruit": (1, (), 0),
        "target_named": (1, (), 0),
    }
    """Of every array: rows beside T, shape of a row, decimals that are stored (5 are 10 um and 10 urad)."""

    def __post_init__(self) -> None:
        for name, (more, row, _) in self.SHAPES.items():
            values, shape = getattr(self, name), (self.steps + more, *row)
            if values is not None and values.shape != shape:
                raise InvalidInputError(
                    f"{name} of an episode with {self.steps} steps must have shape {shape}, got {values.shape}"
                )

    @property
    def steps(self) -> int:
        """Number of steps T."""
        return len(self.decision_ms)

    @property
    def refused(self) -> NDArray[np.bool_]:
        """Whether the arm refused each step. Shape (T,)."""
        return np.asarray(self.reachability == int(Reach.UNREACHABLE))

    @property
    def max_visible_fraction(self) -> float:
        """Largest V_f after any step; the start view does not count."""
        return float(self.visible_fraction[1:].max())

    @property
    def best_visible_fraction(self) -> float:
        """Largest V_f of any view, the start view among them."""
        return float(self.visible_fraction.max())

    @property
    def path_length(self) -> float:
        """Way of the end-effector as the sum of the straight distances between views, in [m]."""
        return float(np.linalg.norm(np.diff(self.viewpoints[:, :3], axis=0), axis=1).sum())

    @property
    def camera_path_length(self) -> float:
        """Way of the camera as the sum of the straight distances between views, in [m]; NaN if it is not known."""
        if self.camera is None:
            return math.nan
        return float(np.linalg.norm(np.diff(self.camera, axis=0), axis=1).sum())

    @property
    def joint_path_length(self) -> float:
        """Way of all joints together: the sum over steps and joints of |dq|, in [rad]; NaN if it is not known."""
        return math.nan if self.qpos is None else float(np.abs(np.diff(self.qpos, axis=0)).sum())

    def moves_to(self, threshold: float, horizon: int) -> int | None:
        """After how many steps V_f was first above a threshold; None if not within the horizon."""
        above = np.flatnonzero(self.visible_fraction[: horizon + 1] > threshold)
        return int(above[0]) if len(above) else None

    def best_so_far(self, horizon: int) -> Float64:
        """Largest V_f seen after 1, 2, ... steps; an episode that ended keeps its last value. Shape (horizon,)."""
        best = np.maximum.accumulate(self.visible_fraction)
        held: Float64 = best[np.minimum(np.arange(1, horizon + 1), self.steps)]
        return held

    def to_json(self) -> dict[str, Any]:
        """Plain numbers and lists; NaN becomes None."""
        content: dict[str, Any] = {
            "seed": self.seed,
            "success": self.success,
            "oracle_moves": self.oracle_moves,
            "row": None if self.row is None else vars(self.row),
        }
        for name, (_, _, decimals) in self.SHAPES.items():
            values = getattr(self, name)
            content[name] = None if values is None else _plain(np.round(values.astype(np.float64), decimals))
        return content

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "EpisodeRecord":
        """The episode that `to_json` wrote.

        Raises:
            InvalidInputError: A value is missing or has another shape.
        """
        types = {
            **dict.fromkeys(("reachability", "chosen_fruit", "target_fruit"), np.int64),
            **dict.fromkeys(("in_forbidden_zone", "contact", "target_named"), np.bool_),
        }
        try:
            steps = len(content["decision_ms"])
            arrays: dict[str, Any] = {}
            for name, (more, row, _) in cls.SHAPES.items():
                values = content[name]
                if values is not None:
                    array = np.array(values, dtype=np.float64).reshape(steps + more, *row)
                    arrays[name] = array.astype(types.get(name, np.float64))
            search = content["row"]
            if search is not None:
                lists = {name: tuple(search[name]) for name in ("targets", "seen")}
                if search.get("listed") is not None:
                    lists["listed"] = tuple(search["listed"])
                search = RowSearch(**{**search, **lists})
            return cls(
                seed=int(content["seed"]),
                success=bool(content["success"]),
                oracle_moves=content["oracle_moves"],
                row=search,
                **arrays,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInputError(f"a stored episode cannot be read: {error}") from error


def _plain(values: Any) -> Any:
    """Nested lists of numbers, whole ones without decimals, None for those that are not finite."""
    if values.ndim > 1:
        return [_plain(row) for row in values]
    return [(int(v) if v == int(v) else v) if math.isfinite(v) else None for v in values.tolist()]
