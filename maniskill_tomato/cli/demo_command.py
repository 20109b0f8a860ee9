"""`maniskill-tomato demo`: training, evaluation and report in one go."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from maniskill_tomato.cli.early_checks import check_counts
from maniskill_tomato.cli.eval_command import beside_summary, summary
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.presets import PRESETS

ENV_ID: Final = "TomatoViewpoint-v1"

TRAINING: Final = dataclasses.replace(
    PRESETS["general-td3"], total_timesteps=20_000, learning_starts=1000, exploration_steps=10_000
)
"""Half the preset's length: what can be learned while one waits."""

TRAINING_PLANTS: Final[dict[str, Any]] = {"seed": "train", "pool": 60}
"""Few plants, since every new one must grow first."""

BESIDE: Final = ("nbv", "lattice_oracle")
"""The best planner, and an oracle that knows the truth."""


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Learn where to look on rows of tomatoes, and evaluate on plants never seen: a report with a film."""

    out: Path = Path("runs/demo")
    """Folder of the demo; an earlier demo in it is replaced."""
    minutes: float = 5.0
    """Longest training time, in [min]; it usually ends sooner."""
    episodes: int = 50
    """Evaluation episodes, on held-out plants."""
    seed: int = 0
    """Seed of the training."""
    video: bool = True
    """Film a search where this machine can render."""

    def run(self) -> None:
        """Runs both parts and names the results."""
        check_counts(episodes=self.episodes)
        if not self.minutes > 0:
            raise InvalidInputError(f"--minutes must be above 0, got {self.minutes:g}")

        from maniskill_tomato.experiments.configs import EvaluationConfig
        from maniskill_tomato.experiments.evaluation import evaluate
        from maniskill_tomato.learning.rl.trainer import train

        config = dataclasses.replace(TRAINING, max_minutes=self.minutes)
        plants = TRAINING_PLANTS["pool"]
        print(f"1/2 TD3 learns {ENV_ID} on {plants} rows of plants, at most {self.minutes:g} minutes")
        trained = train(
            ENV_ID, config, self.out / "training", self.seed, {"plant": TRAINING_PLANTS}, overwrite=True
        )
        print(f"    {trained.steps} steps in {trained.seconds:.0f} s ({trained.stop_reason})")
        print(f"2/2 {self.episodes} episodes on plants never seen, beside {' and '.join(BESIDE)}")
        evaluation = EvaluationConfig(
            env_id=ENV_ID,
            policy=str(trained.policy_path),
            episodes=self.episodes,
            seed=0,
            out=self.out,
            env_options={"episodes": "held_out"},
            beside=BESIDE,
            video=self.video,
            films=1,
            title="Where to look: a policy that uncovers hidden tomatoes",
            training_run=trained.run_dir,
        )
        result = evaluate(evaluation)
        print(f"    {summary(result.metrics)}")
        for line in beside_summary(result.metrics):
            print(line)
        if result.left_out:
            print(result.left_out)
        print(f"report  {result.report}")
        print(f"video   {result.video or 'none, see above' if self.video else 'not wanted'}")
        print(f"policy  {trained.policy_path}")
        print(f"watch   maniskill-tomato play --policy {trained.policy_path}")
