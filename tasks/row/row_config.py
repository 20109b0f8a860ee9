"""What tells the general tasks apart: plants never seen before, hard starts, a reward that does not pay for waiting."""

from dataclasses import dataclass, replace

from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.spec import ROW_PLANT, PlantPose, PlantSpec
from maniskill_tomato.tasks import MAX_GENERAL_STEPS
from maniskill_tomato.tasks.own_rules import OwnRules

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class GeneralTaskConfig:
    """One general task."""

    plant: PlantSpec = replace(ROW_PLANT, seed="train", pool=100)
    """The plants that the task draws from unless it is given others."""
    plant_pose: PlantPose = PlantPose(x=0.9, y=0.0)
    """Where the middle plant stands."""
    plant_pose_noise: tuple[float, float, float] = (0.05, 0.08, 0.2)
    """Half ranges of a uniform addition to it, in [m, m, rad]."""
    start_box: tuple[Range, Range, Range] = ((-0.65, -0.2), (-0.45, 0.45), (0.25, 1.05))
    """Where the camera starts: x and y from the middle plant's stem, z from the ground, world axes, in [m]."""
    start_distance: float = 0.25
    """The camera starts at least this far from its target, in [m]."""
    start_visibility: Range = (0.0, 0.3)
    """V_f of the first view: at least the first, below the second."""
    full_visibility: float = 0.8
    """The target is fully visible, and the episode a success, when V_f is above this."""
    max_moves: int = MAX_GENERAL_STEPS
    """Moves in which a target must be seen."""
    step_cost: float = 0.02
    """What every move costs."""
    success_reward: float = 1.0
    """What a full view of the target is worth."""
    contact_penalty: float = 0.0
    """What a move on which the arm touches a plant costs beside that."""
    own: OwnRules = OwnRules()
    """What a task of somebody else's does its own way."""

    def __post_init__(self) -> None:
        low, high = self.start_visibility
        if not 0.0 <= low < high <= 1.0:
            raise InvalidInputError(
                f"start_visibility must be a range (low, high) with 0 <= low < high <= 1; got {self.start_visibility}"
            )
        for name in ("step_cost", "success_reward", "contact_penalty"):
            if not 0.0 <= getattr(self, name) <= 100.0:
                raise InvalidInputError(f"{name} must be from 0 to 100; got {getattr(self, name)!r}")

    def reward(
        self, visible_fraction: Tensor, previous_fraction: Tensor, success: Tensor, contact: Tensor
    ) -> Tensor:
        """R = V_f - V_f' - c + b [success] - k [contact], with V_f' the fraction before the move.

        The first two terms are a potential's difference (Ng, Harada and Russell 1999, with an undiscounted potential):
        over an episode they add up to the last V_f less the first, whichever way the camera took. A camera that stays
        where it sees the target in part loses the step cost c with every move, whereas Eq. 5-9 pays it 0.1 for each.

        Args:
            visible_fraction: V_f after the move. Shape (B,).
            previous_fraction: V_f before it. Shape (B,).
            success: Whether the target is fully visible after it. Shape (B,), bool.
            contact: Whether the arm touched a plant on the way. Shape (B,), bool.

        Returns:
            Shape (B,).
        """
        gain = visible_fraction - previous_fraction
        bonus, penalty = self.success_reward * success.float(), self.contact_penalty * contact.float()
        return gain - self.step_cost + bonus - penalty

    @property
    def largest_reward(self) -> float:
        """Of one move."""
        return 1.0 + self.success_reward if self.own.reward is None else self.own.largest_reward
