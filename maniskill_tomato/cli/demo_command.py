"""`maniskill-tomato demo`: training, evaluation and report in one go."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from maniskill_tomato.cli.early_checks import check_counts
from maniskill_tomato.cli.eval_command import summary
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.presets import PRESETS


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Train the guided task, evaluate the policy and write a report with a film."""

    out: Path = Path("runs/demo")
    """Folder of the demo; an earlier demo in it is replaced."""
    minutes: float = 6.0
    """Longest training time, in [min]; it usually ends sooner."""
    episodes: int = 100
    """Evaluation episodes."""
    seed: int = 0
    """Seed of the training."""
    video: bool = True
    """Film the first episodes where this machine can render."""

    def run(self) -> None:
        """Runs both parts and names the results."""
        check_counts(episodes=self.episodes)
        if not self.minutes > 0:
            raise InvalidInputError(f"--minutes must be above 0, got {self.minutes:g}")

        from maniskill_tomato.experiments.configs import EvaluationConfig
        from maniskill_tomato.experiments.evaluation import evaluate
        from maniskill_tomato.learning.rl.trainer import train

        env_id = "TomatoViewpointGuided-v1"
        print(f"1/2 training on {env_id}, at most {self.minutes:g} minutes")
        config = dataclasses.replace(PRESETS["td3"], max_minutes=self.minutes)
        trained = train(env_id, config, self.out / "training", self.seed, {}, overwrite=True)
        print(f"    {trained.steps} steps in {trained.seconds:.0f} s ({trained.stop_reason})")
        print(f"2/2 evaluating {self.episodes} episodes")
        evaluation = EvaluationConfig(
            env_id=env_id,
            policy=str(trained.policy_path),
            episodes=self.episodes,
            seed=1000,
            out=self.out,
            video=self.video,
            title="Where to look: a policy that uncovers a hidden tomato",
            training_run=trained.run_dir,
        )
        result = evaluate(evaluation)
        print(summary(result.metrics))
        if result.left_out:
            print(result.left_out)
        print(f"report  {result.report}")
        print(f"video   {result.video or 'none, see above' if self.video else 'not wanted'}")
        print(f"policy  {trained.policy_path}")
