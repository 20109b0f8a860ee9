"""A run in data: its settings, the question before a move, one step for each picture, the result."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, Protocol

from maniskill_tomato.deploy.fault_state import FaultState
from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.deploy.robot_perception import Sighting
from maniskill_tomato.errors import InvalidInputError, check_ranges

Mode = Literal["dry_run", "confirm", "unattended"]
"""Show the first move and end; ask before every move; go on alone."""


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """When a run ends."""

    threshold: float = 0.8
    """The target is fully visible when V_f is above this."""
    max_moves: int = 20
    """Moves in which it must be."""
    lost_after: int = 12
    """Looks without any of the target in a row after which it counts as lost."""
    refused_after: int = 8
    """Refused moves in a row after which the run ends."""
    settle: float = 0.2
    """Between the end of a move and the next picture, in [s]."""

    def __post_init__(self) -> None:
        if not 0.0 < self.threshold < 1.0:
            raise InvalidInputError(f"threshold must be between 0 and 1, got {self.threshold}")
        at_least_one = (1, math.inf)
        check_ranges(self, max_moves=at_least_one, lost_after=at_least_one, refused_after=at_least_one)
        check_ranges(self, settle=(0.0, 10.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """A move that a person is asked about."""

    number: int
    """How many moves there were before."""
    visible_fraction: float
    """V_f now."""
    turn: Float64
    """How far each joint would turn, in [rad]. Shape (7,)."""
    camera_step: float
    """How far the camera would move, in [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Step:
    """A look, and the decision that followed."""

    number: int
    """Counts the looks from 0."""
    frame: Frame
    view: Sighting
    joint_positions: Float64
    """When the picture was taken, in [rad]. Shape (7,)."""
    T_world_camera: Float64
    """Pose of the optical frame. Shape (4, 4)."""
    target_position: Float64
    """In [m]. Shape (3,)."""
    moves_left: int
    action: tuple[float, float, float] | None = None
    """Right, up, forward; None where the run ended with this look, or went back because it had no depth."""
    commanded: Float64 | None = None
    """Joint positions that went out, in [rad]; None if none did. Shape (7,)."""
    outcome: str = ""
    """`moved`, `refused`, `dry_run`, `declined` or why the run ended."""
    detail: str = ""
    """Why a move was refused or the run ended."""
    timing_ms: dict[str, float] = field(default_factory=dict)
    """Wall time of each stage."""


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """How a run ended."""

    success: bool
    """Whether V_f passed the threshold."""
    reason: str
    """`success`, `budget`, `target_lost`, `no_target`, `refused`, `dry_run`, `declined`, `stopped`, or a fault's."""
    detail: str
    """In words."""
    is_fault: bool
    """Whether something was broken."""
    moves: int
    """Moves decided on, refused ones among them, as the simulated task counts."""
    refused_moves: int
    """Those that did not reach the arm."""
    visible_fraction: float
    """V_f of the last look."""
    best_visible_fraction: float
    """Of all looks."""
    true_visible_fraction: float | None
    """V_f of the last look by ray casting; None where the camera is real."""
    visible_fractions: tuple[float, ...]
    """Of each look."""
    seconds: float
    """Wall time, in [s]."""
    device_seconds: float
    """By the run's clock, in [s]: what it takes, or would take, on hardware."""
    stage_ms: dict[str, float]
    """Mean wall time of each stage of a step, in [ms]."""
    end_state: str
    """What the arm does now."""
    report_error: str = ""
    """Why its report could not be written; empty if it was."""
    fault: FaultState | None = None
    """What is known of a fault, or of a number that was not finite; None if there was neither."""
    fault_file: str = ""
    """The recording in the output folder that holds it; empty if none does."""

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, strings and lists; a fault's state is in its file."""
        return {name: value for name, value in asdict(self).items() if name not in ("report_error", "fault")}


class Recorder(Protocol):
    """Keeps what happened."""

    def step(self, step: Step) -> None:
        """Writes a step.

        Raises:
            RecordingError: It cannot.
        """
        ...

    def event(self, stamp: float, text: str) -> None:
        """Writes a line of the log.

        Raises:
            RecordingError: It cannot.
        """
        ...


class KeptSteps:
    """A recorder that keeps the steps in memory, for programs that look at them afterwards."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.events: list[str] = []

    def step(self, step: Step) -> None:
        self.steps.append(step)

    def event(self, stamp: float, text: str) -> None:
        self.events.append(text)
