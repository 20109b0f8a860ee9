"""What a run is after: a goal says what each look means. `OneFruit` is that of `deploy run`."""

from dataclasses import dataclass
from typing import Protocol

from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.deploy.robot_perception import Perception, Sighting
from maniskill_tomato.deploy.run_records import LoopConfig


@dataclass(frozen=True, kw_only=True)
class End:
    """Why a run is over."""

    reason: str
    """`success`, `budget` or another word of `RunResult.reason`."""
    detail: str
    """In words."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """What a look means: the run is over, the arm goes to another place first, or the policy is asked."""

    view: Sighting
    moves_left: int
    """What the policy is told."""
    end: End | None = None
    """Why the run is over."""
    places: Float64 | None = None
    """Where the camera goes without the policy being asked, because it cannot look at the target from where it is: the
    most wanted place first, base frame, in [m]. Shape (K, 3)."""
    is_new_target: bool = False
    """Whether the policy begins anew."""
    true_fraction: float | None = None
    """V_f of what is looked at by ray casting; None where nobody knows it."""


class Goal(Protocol):
    """What a run is after."""

    max_moves: int
    """The most moves for one target: the length of the policy's episodes."""

    def look(self, frame: Frame, T_world_camera: Float64, joints: Float64, moves: int) -> Look:
        """Takes in a picture; once for every look.

        Args:
            frame: The picture.
            T_world_camera: Pose of the optical frame when it was taken. Shape (4, 4).
            joints: The arm's then, in [rad]. Shape (7,).
            moves: Moves so far.

        Raises:
            PerceptionError: The picture cannot be used.
        """
        ...

    def pass_by(self, frame: Frame, T_world_camera: Float64, joints: Float64) -> None:
        """Takes in a picture on the way to another view; the arguments are those of `look`.

        Raises:
            PerceptionError: The picture cannot be used.
        """
        ...

    def refused(self, in_a_row: int, why: str) -> End | None:
        """Hears that the last move was refused, or that there is no way to the places that it named.

        Args:
            in_a_row: How many were, one after the other.
            why: The last reason.

        Returns:
            Why the run is over; None to go on.
        """
        ...


class OneFruit:
    """One fruit, until it is fully visible."""

    def __init__(
        self, perception: Perception, config: LoopConfig, target_position: Float64 | None = None
    ) -> None:
        """Begins without a view.

        Args:
            perception: Turns pictures into sightings.
            config: When the run ends.
            target_position: Where the target is, world frame, in [m]; None to choose one that a picture shows. Shape
                (3,).
        """
        self.max_moves = config.max_moves
        self._perception, self._config = perception, config
        self._is_chosen = target_position is None
        self._shown: int | None = None
        self._lost_in_a_row = self._refused = 0
        self._is_first = True
        perception.begin(target_position)

    def look(self, frame: Frame, T_world_camera: Float64, joints: Float64, moves: int) -> Look:
        """The sighting, and whether it ends the run; see `Goal`."""
        view = self._perception.look(frame, T_world_camera)
        self._lost_in_a_row = 0 if view.target_seen else self._lost_in_a_row + 1
        is_first, self._is_first = self._is_first, False
        if view.is_new_target:
            self._refused = 0
        return Look(
            view=view,
            moves_left=self.max_moves - moves,
            end=self._end(view, moves),
            is_new_target=is_first or view.is_new_target,
            true_fraction=self._true_fraction(frame, view),
        )

    def pass_by(self, frame: Frame, T_world_camera: Float64, joints: Float64) -> None:
        """Nothing: the way has an end from which the target is looked at."""

    def refused(self, in_a_row: int, why: str) -> End | None:
        """Too many in a row at one target end the run."""
        self._refused = min(self._refused + 1, in_a_row)
        if self._refused < self._config.refused_after:
            return None
        return End(
            reason="refused", detail=f"{self._refused} moves in a row were refused, the last one: {why}"
        )

    def _end(self, view: Sighting, moves: int) -> End | None:
        config, fraction = self._config, f"V_f = {view.visible_fraction:.2f}"
        if view.sure_fraction > config.threshold:
            return End(reason="success", detail=f"{fraction} after {moves} moves")
        if moves >= config.max_moves:
            return End(reason="budget", detail=f"{fraction} after all {config.max_moves} moves")
        if self._lost_in_a_row < config.lost_after:
            return None
        if not view.has_target:
            return End(
                reason="no_target",
                detail=f"{self._lost_in_a_row} looks in a row showed no ripe fruit; start where one is in view",
            )
        return End(
            reason="target_lost",
            detail=f"{self._lost_in_a_row} looks in a row showed nothing of the target",
        )

    def _true_fraction(self, frame: Frame, view: Sighting) -> float | None:
        """Of the fruit that was named, or of the one that was chosen, which is the one that its mask shows."""
        truth = frame.truth
        if truth is None:
            return None
        if not self._is_chosen:
            return truth.visible_fraction
        if view.is_new_target:
            self._shown = None
        shown = truth.shown_label(view.mask)
        self._shown = self._shown if shown is None else shown
        return None if self._shown is None else truth.fraction(self._shown)
