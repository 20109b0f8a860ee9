"""Commands that learn or record, besides `train` and `train-segmenter`, and `export`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_counts, check_env_id, check_file, check_policy, task_word
from maniskill_tomato.cli.shared_options import EnvId, PlantOptions, parse_env_options, tell_policy
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.imitation.imitation_config import ImitationConfig, RegressionConfig
from maniskill_tomato.learning.rl.ppo_config import PpoConfig, default_ppo
from maniskill_tomato.learning.view_quality.quality_config import QualityTrainConfig
from maniskill_tomato.policies.opening import shipped_policy
from maniskill_tomato.task_registry import GENERAL_IDS, THESIS_IDS, base_of, lasting_name

GENERAL_ID = GENERAL_IDS[0]


@dataclass(frozen=True, kw_only=True)
class TrainImitation:
    """Imitate a teacher that knows the truth by a policy that sees what a camera sees.

    The first round is behaviour cloning, the later ones are DAgger. A training that was stopped goes on where it was.
    `eval` and `benchmark` take its policies round-0.pt (behaviour cloning) and policy.pt, and `train --initial-policy`
    goes on from one by reinforcement.
    """

    out: Path = Path("runs/imitation")
    """Folder of the training."""
    jobs: int = 1
    """Processes that run episodes."""
    env_options: dict[str, str] = field(default_factory=dict)
    """Options of the task: names and values, these as JSON or plain words."""
    config: Annotated[ImitationConfig, Flat] = field(default_factory=ImitationConfig)
    """How to train."""

    def run(self) -> None:
        """Trains and says where the policy is."""
        check_counts(jobs=self.jobs)
        options = parse_env_options(self.env_options)

        from maniskill_tomato.learning.imitation.imitation_training import train_imitation

        tell_policy(lambda report: train_imitation(self.out, self.config, self.jobs, options, report))


@dataclass(frozen=True, kw_only=True)
class TrainViewQuality:
    """Learn how much of the target each candidate view would show: the policy that ships for TomatoViewpoint-v1.

    A training that was stopped goes on where it was.
    """

    out: Path = Path("runs/view-quality")
    """Folder of the training."""
    jobs: int = 1
    """Processes that run episodes."""
    start_from: Path | None = None
    """A policy to go on from instead of beginning with the planner."""
    env_options: dict[str, str] = field(default_factory=dict)
    """Options of the task: names and values, these as JSON or plain words."""
    config: Annotated[QualityTrainConfig, Flat] = field(default_factory=QualityTrainConfig)
    """How to train."""

    def run(self) -> None:
        """Trains and says where the policy is."""
        check_counts(jobs=self.jobs)
        check_file("--start-from", self.start_from)
        options = parse_env_options(self.env_options)

        from maniskill_tomato.learning.view_quality.quality_training import train_view_quality

        tell_policy(
            lambda report: train_view_quality(
                self.out, self.config, self.jobs, options, report, self.start_from
            )
        )


@dataclass(frozen=True, kw_only=True)
class TrainDeepMoveToSee:
    """Train the network of the planner deep_3dmts: the moves of 3D Move To See from single views.

    `benchmark --policies deep_3dmts=FILE` takes it.
    """

    out: Path
    """File of the network."""
    writes_file: ClassVar = True
    episodes: int = 1000
    """Episodes on training plants whose views are learned from."""
    moves: int = 10
    """Views of each episode."""
    config: Annotated[RegressionConfig, Flat] = RegressionConfig()
    """How the network is trained."""

    def run(self) -> None:
        """Trains and says where the network is."""
        check_counts(episodes=self.episodes, moves=self.moves)

        from maniskill_tomato.learning.imitation.move_to_see_training import train_move_to_see

        tell_policy(
            lambda report: train_move_to_see(self.out, self.config, self.episodes, self.moves, report)
        )


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
        env_id = task_word(argv)
        return cls(env_id=tyro.MISSING, out=tyro.MISSING, config=default_ppo(env_id))

    def run(self) -> None:
        """Trains and evaluates every seed; a signal ends the present run and starts no other."""
        check_env_id(self.env_id)
        check_counts(episodes=self.episodes)
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise InvalidInputError("--seeds must be one or more different numbers")

        from maniskill_tomato.experiments.evaluation import evaluate_run
        from maniskill_tomato.experiments.training_runs import load_run
        from maniskill_tomato.learning.rl.ppo import train_ppo

        for seed in self.seeds:
            run_dir = self.out / f"seed-{seed}"
            if not train_ppo(lasting_name(self.env_id), self.config, run_dir, seed, self.progress):
                print(f"stopped; {run_dir} holds what was learned so far")
                return
            run = load_run(run_dir)
            metrics = evaluate_run(run, self.episodes, self.eval_seed).metrics
            print(
                f"{run_dir}: success {metrics['success_rate']:.0%} of {self.episodes}, "
                f"{metrics['mean_steps']:.1f} steps, trained {run.training_steps} steps in "
                f"{run.training_seconds or 0.0:.0f} s"
            )


@dataclass(frozen=True, kw_only=True)
class RecordDemonstrations:
    """Record a policy's successful episodes in ManiSkill's trajectory format.

    `train --reward-from` learns a reward from them.
    """

    env_id: EnvId = GENERAL_ID
    """The task."""
    policy: str | None = None
    """Whose moves to record: a planner's name or a policy's file; by default the oracle, on the thesis's tasks the
    policy that ships with the package."""
    episodes: int = 100
    """How many to try; those that fail are left out."""
    first_seed: int = 0
    """Seed of the first reset."""
    out: Path = Path("runs/demonstrations")
    """Folder of trajectory.h5 and trajectory.json."""
    contact_free: bool = False
    """Let the oracle avoid the plant."""
    plants: Annotated[PlantOptions, Flat] = PlantOptions()
    """Another plant."""

    def run(self) -> None:
        """Records and says what."""
        check_env_id(self.env_id, (*THESIS_IDS, GENERAL_ID))
        shipped = str(shipped_policy(self.env_id)) if base_of(self.env_id) in THESIS_IDS else "oracle"
        policy = self.policy or shipped
        check_policy("--policy", policy, self.env_id)
        check_counts(episodes=self.episodes)
        check_counts(0, first_seed=self.first_seed)

        from maniskill_tomato.experiments.policy_runs import PolicySpec, open_for
        from maniskill_tomato.learning.imitation.demonstrations import record_demonstrations
        from maniskill_tomato.learning.rl.envs import make_simulated_env

        env = make_simulated_env(self.env_id, **self.plants.env_options())
        opened = open_for(PolicySpec.parse(policy), env, self.contact_free)
        seeds = range(self.first_seed, self.first_seed + self.episodes)
        result = record_demonstrations(env, opened, seeds, self.out)
        print(f"{result.path}: {result.recorded} of {result.tried} episodes, {result.moves} moves")


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a policy as an ONNX file and a JSON description, which run without PyTorch and ManiSkill."""

    policy: Path | None = None
    """File of the policy, or a checkpoint of its run; by default those that ship with the package."""
    out: Path = Path("runs/export")
    """Folder of the results; an earlier export of the same name in it is replaced."""

    def run(self) -> None:
        """Exports and says where the files are."""
        check_file("--policy", self.policy)

        from maniskill_tomato.learning.rl.export import export_policy

        for path in [self.policy] if self.policy else [shipped_policy(env_id) for env_id in THESIS_IDS]:
            result = export_policy(path, self.out)
            print(f"model       {result.model}")
            print(f"description {result.description}")
            print(f"largest difference from PyTorch {result.largest_difference:.1e}")
