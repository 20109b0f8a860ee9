"""`maniskill-tomato train-ppo`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_count, check_env_id
from maniskill_tomato.cli.shared_options import EnvId
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.ppo_config import PpoConfig, default_ppo
from maniskill_tomato.tasks import TASK_IDS


@dataclass(frozen=True, kw_only=True)
class TrainPpo:
    """Train PPO (Stable-Baselines3, extra `sb3`) with one or more seeds, one after the other, and evaluate each.

    Actions, observations and reward are those of the preset td3, for the general tasks of general-td3, so that only
    the algorithm differs. `eval` takes the policy.onnx of each run, `compare` the runs.
    """

    env_id: EnvId
    out: Path
    """Folder that gets a run folder seed-N for every seed."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the training runs."""
    episodes: int = 100
    """Evaluation episodes."""
    eval_seed: int = 1000
    """Seed of the first evaluation episode; the others follow."""
    progress: bool = True
    """Draw progress bars."""
    config: Annotated[PpoConfig, Flat] = PpoConfig()
    """How to learn."""

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> "TrainPpo":
        """What holds without further options: the general tasks have a configuration of their own."""
        env_id = next((word for word in argv if word in TASK_IDS), None)
        return cls(env_id=tyro.MISSING, out=tyro.MISSING, config=default_ppo(env_id))

    def run(self) -> None:
        """Trains and evaluates every seed; a signal ends the present run and starts no other."""
        check_env_id(self.env_id)
        check_count("--episodes", self.episodes)
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise InvalidInputError("--seeds must be one or more different numbers")

        from maniskill_tomato.experiments.evaluation import evaluate_run
        from maniskill_tomato.experiments.training_runs import load_run
        from maniskill_tomato.learning.rl.ppo import train_ppo

        for seed in self.seeds:
            run_dir = self.out / f"seed-{seed}"
            if not train_ppo(self.env_id, self.config, run_dir, seed, self.progress):
                print(f"stopped; {run_dir} holds what was learned so far")
                return
            run = load_run(run_dir)
            metrics = evaluate_run(run, self.episodes, self.eval_seed).metrics
            print(
                f"{run_dir}: success {metrics['success_rate']:.0%} of {self.episodes}, "
                f"{metrics['mean_steps']:.1f} steps, trained {run.training_steps} steps in "
                f"{run.training_seconds or 0.0:.0f} s"
            )
