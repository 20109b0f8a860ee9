"""`maniskill-tomato demonstrations`."""

from dataclasses import dataclass
from pathlib import Path

from maniskill_tomato.cli.early_checks import check_count, check_policy


@dataclass(frozen=True, kw_only=True)
class RecordDemonstrations:
    """Record a planner's successful episodes on training plants in ManiSkill's trajectory format."""

    planner: str = "oracle"
    """Whose moves to record: a planner's name or a policy's file."""
    episodes: int = 100
    """How many to try; those that fail are left out."""
    first_seed: int = 0
    """Seed of the first reset."""
    out: Path = Path("runs/demonstrations")
    """Folder of trajectory.h5 and trajectory.json."""
    contact_free: bool = False
    """Let the oracle avoid the plant."""

    def run(self) -> None:
        """Records and says what."""
        check_policy("--planner", self.planner)
        check_count("--episodes", self.episodes)
        check_count("--first-seed", self.first_seed, 0)

        from maniskill_tomato.experiments.policy_runs import PolicySpec, open_for
        from maniskill_tomato.learning.imitation.demonstrations import record_demonstrations
        from maniskill_tomato.learning.rl.envs import make_simulated_env

        env = make_simulated_env("TomatoViewpoint-v1")
        planner = open_for(PolicySpec.parse(self.planner), env, self.contact_free)
        seeds = range(self.first_seed, self.first_seed + self.episodes)
        result = record_demonstrations(env, planner, seeds, self.out)
        print(f"{result.path}: {result.recorded} of {result.tried} episodes, {result.moves} moves")
