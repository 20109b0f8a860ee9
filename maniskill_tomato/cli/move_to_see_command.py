"""`maniskill-tomato train-deep-3dmts`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_count
from maniskill_tomato.cli.shared_options import tell_policy
from maniskill_tomato.learning.imitation.imitation_config import RegressionConfig


@dataclass(frozen=True, kw_only=True)
class TrainDeepMoveToSee:
    """Train the network of the planner deep_3dmts: the moves of 3D Move To See from single views.

    `benchmark --policies deep_3dmts=FILE` takes it.
    """

    out: Path
    """File of the network."""
    episodes: int = 1000
    """Episodes on training plants whose views are learned from."""
    moves: int = 10
    """Views of each episode."""
    config: Annotated[RegressionConfig, Flat] = RegressionConfig()
    """How the network is trained."""

    def run(self) -> None:
        """Trains and says where the network is."""
        check_count("--episodes", self.episodes)
        check_count("--moves", self.moves)

        from maniskill_tomato.learning.imitation.move_to_see_training import train_move_to_see

        tell_policy(
            lambda report: train_move_to_see(self.out, self.config, self.episodes, self.moves, report)
        )
