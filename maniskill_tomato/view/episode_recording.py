"""What a viewer needs of an episode, step by step: plain arrays that any page or file can draw."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]


class Voxel(IntEnum):
    """What the occlusion memory believes of a voxel."""

    UNKNOWN = 0
    """No view has told of it."""
    FREE = 1
    """A ray through it is more likely to pass than not."""
    BLOCKED = 2
    """A ray through it is more likely to end there than not."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Foliage:
    """What the occlusion memory believes."""

    centre: Float64
    """Of the grid, in the world frame, in [m]. Shape (3,)."""
    cell_size: float
    """Edge of a voxel, in [m]."""
    voxels: UInt8
    """Values of `Voxel`, along the axes of the world. Shape (X, Y, Z)."""

    def places(self, kind: Voxel) -> Float32:
        """Centres of the voxels of a kind, in the world frame, in [m]. Shape (n, 3)."""
        index = np.argwhere(self.voxels == int(kind))
        half = 0.5 * (np.array(self.voxels.shape) - 1)
        return np.asarray(self.centre + (index - half) * self.cell_size, dtype=np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class Candidates:
    """The views that a policy chooses from."""

    positions: Float32
    """Of the cameras, in the world frame, in [m]. Shape (K, 3)."""
    worth: Float32
    """What the policy thinks of them, in its own unit; negative infinity where one may not be chosen. Shape (K,)."""
    chosen: int
    """The one that the camera moves towards."""


@dataclass(frozen=True, kw_only=True)
class MeasuredFraction:
    """V_f as a camera measures it."""

    value: float
    """The estimate."""
    margin: float
    """How far off it may be, by the perception's own account; a task goes by the value less this."""

    @property
    def band(self) -> tuple[float, float, float]:
        """The lower bound, the estimate, and as much above it, within 0 and 1."""
        return max(self.value - self.margin, 0.0), self.value, min(self.value + self.margin, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class MappedFruit:
    """A fruit as a camera's map has it."""

    number: int
    """Its name in the map."""
    position: Float64
    """Centre in the world frame, in [m]. Shape (3,)."""
    radius: float
    """In [m]."""
    spread: float
    """Standard deviation of its place along the least certain direction, in [m]."""
    is_ripe: bool
    """Whether it is more likely ripe than not."""
    is_target: bool
    """Whether the robot takes it for its target."""
    fraction: MeasuredFraction | None = None
    """V_f in the view that was just taken, with its error; None where the view does not show the fruit."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SeenPoints:
    """What a depth camera saw."""

    positions: Float32
    """In the world frame, in [m]. Shape (n, 3)."""
    colours: UInt8
    """sRGB. Shape (n, 3)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetRays:
    """Rays from the camera that meet the target if nothing hides it."""

    ends: Float32
    """Where each ends, in the world frame, in [m]. Shape (n, 3)."""
    is_seen: NDArray[np.bool_]
    """Whether that is on the target; what hides it otherwise. Shape (n,)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Snapshot:
    """One view of an episode, and what the policy decides on it."""

    joint_positions: Float64
    """In [rad]. Shape (7,)."""
    T_w_camera: Float64
    """Pose of the camera's optical frame. Shape (4, 4)."""
    target_position: Float64
    """Where the target is believed to be, in the world frame, in [m]. Shape (3,)."""
    visible_fraction: float
    """V_f of the target, as the task goes by it."""
    picture: UInt8 | None = None
    """What the wrist camera sees; None where `EpisodeRecording.retake` takes it when it is shown. Shape (H, W, 3)."""
    true_visible_fraction: float | None = None
    """V_f as it is, where a camera measures the other."""
    measured: MeasuredFraction | None = None
    """V_f with its error, where a camera measures it; the task goes by its lower bound."""
    rays: TargetRays | None = None
    """The truth behind V_f, where it is known."""
    target_organ: int | None = None
    """The true target, as an index in `Plant.organs`."""
    event: str = ""
    """What came of the move that led here, in words: a refusal with its reason, a touched plant, the end."""
    was_refused: bool = False
    """Whether the arm refused that move."""
    candidates: Candidates | None = None
    """What the policy chooses from now."""
    T_w_camera_next: Float64 | None = None
    """Where the camera goes next. Shape (4, 4)."""
    foliage: Foliage | None = None
    """What the occlusion memory believes."""
    fruits: tuple[MappedFruit, ...] = ()
    """What a camera's map holds."""
    points: SeenPoints | None = None
    """What the camera saw, where no plant is known."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HandView:
    """What a camera that somebody took by hand sees of the target, as if no arm held it."""

    T_w_camera: Float64
    """Pose of its optical frame: it looks at where the target is believed to be. Shape (4, 4)."""
    visible_fraction: float
    """V_f of the target, as it is."""
    is_reachable: bool
    """Whether the arm could hold it there."""
    picture: UInt8
    """What it sees. Shape (H, W, 3)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PolicyWay:
    """What one of several policies did in the same episode."""

    label: str
    """Name of the policy."""
    colour: tuple[int, int, int]
    """In which it is drawn."""
    is_solved: bool
    """Whether it solved the episode."""
    recording: "EpisodeRecording"
    """Its episode."""


@dataclass(eq=False, kw_only=True)
class EpisodeRecording:
    """An episode so far: the first view, and one more for every move."""

    title: str
    """What it is, in a line."""
    threshold: float
    """V_f above which the target counts as fully visible."""
    plant: Plant | None = None
    """The plant or the row; None where it is not known."""
    T_w_plant: Float64 = field(default_factory=lambda: np.eye(4))
    """Its pose. Shape (4, 4)."""
    fov_y: float = 0.75
    """Vertical field of view of the wrist's camera, in [rad]."""
    model: ArmModel = IIWA14
    """Of the arm."""
    snapshots: list[Snapshot] = field(default_factory=list)
    """In order."""
    outcome: str = ""
    """How it ended; empty while it goes on."""
    retake: Callable[[Snapshot], UInt8] | None = None
    """Takes the picture of a snapshot that has none."""
    ways: tuple[PolicyWay, ...] = ()
    """Where several policies were judged by this episode: what each did, this one among them."""

    @property
    def moves(self) -> int:
        """Moves so far."""
        return len(self.snapshots) - 1

    @property
    def length(self) -> int:
        """Moves of the longest of its ways."""
        return max((way.recording.moves for way in self.ways), default=self.moves)

    def at(self, shown: int) -> Snapshot:
        """The snapshot after a number of moves, the last one where there were fewer."""
        return self.snapshots[min(shown, self.moves)]

    def picture(self, shown: int) -> UInt8:
        """What the wrist camera sees there. Shape (H, W, 3)."""
        snapshot = self.at(shown)
        if snapshot.picture is not None:
            return snapshot.picture
        if self.retake is None:
            return np.full((3, 4, 3), 128, dtype=np.uint8)
        index = min(shown, self.moves)
        self.snapshots[index] = replace(snapshot, picture=self.retake(snapshot))
        return self.picture(shown)

    @property
    def visible_fractions(self) -> Float64:
        """V_f at every view. Shape (moves + 1,)."""
        return np.array([snapshot.visible_fraction for snapshot in self.snapshots])
