"""The command `maniskill-tomato`: train, evaluate, compare, demonstrate, export.

Examples:
    maniskill-tomato train TomatoViewpointGuided-v1
    maniskill-tomato train TomatoViewpointSparse-v1 --preset thesis-sparse --seeds 0..4 --jobs 2
    maniskill-tomato train --resume runs/guided
    maniskill-tomato eval TomatoViewpointGuided-v1 --policy runs/demo/training/policy.pt --episodes 100
    maniskill-tomato benchmark --policies nbv,oracle,runs/general/policy.pt --episodes 500
    maniskill-tomato demo
    maniskill-tomato export --policy runs/demo/training/policy.pt --out exported
"""

import dataclasses
import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from maniskill_tomato.benchmark_command import Benchmark
from maniskill_tomato.errors import InvalidInputError, SeedsFailedError, TomatoError
from maniskill_tomato.learning.config_file import RunFile, parse_seeds, read_run_config, read_run_file
from maniskill_tomato.learning.presets import MAY_CHANGE, PRESETS, PresetName, TrainConfig
from maniskill_tomato.tasks import TASK_IDS, THESIS_IDS

# PyTorch and ManiSkill take seconds to import, so that every command imports what it needs when it runs.

EnvId = Annotated[
    str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV_ID", help=f"One of {', '.join(TASK_IDS)}.")
]


@dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Another plant than the task's own."""

    plant: str | None = None
    """Preset of the plant: one_tomato, three_tomatoes or full."""
    plant_seed: str | None = None
    """Its seed, or train, validation or held_out for a new plant of that split in every episode."""
    plant_pool: int | None = None
    """With a split, draw only from this number of its plants; plants seen before need not grow again."""
    plant_pose: tuple[float, float, float] | None = None
    """Where it stands: x [m], y [m], yaw [rad]."""
    plant_pose_noise: tuple[float, float, float] | None = None
    """Half ranges of a uniform addition to that in every episode: x [m], y [m], yaw [rad]."""

    def env_options(self) -> dict[str, Any]:
        """The options for `gymnasium.make`."""
        plant: dict[str, Any] = {}
        if self.plant is not None:
            plant["preset"] = self.plant
        if self.plant_seed is not None:
            plant["seed"] = int(self.plant_seed) if self.plant_seed.isdigit() else self.plant_seed
        if self.plant_pool is not None:
            plant["pool"] = self.plant_pool
        options: dict[str, Any] = {"plant": plant} if plant else {}
        if self.plant_pose is not None:
            options["plant_pose"] = self.plant_pose
        if self.plant_pose_noise is not None:
            options["plant_pose_noise"] = self.plant_pose_noise
        return options


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy; the other options start from the preset's, the file's or the continued run's values."""

    env_id: Annotated[
        str | None,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="ENV_ID", help=f"One of {', '.join(TASK_IDS)}; the file or run may say it."),
    ] = None
    """Id of the task."""
    preset: PresetName = "td3"
    """Named configuration: a good default, or the thesis's Table 5-1 or 5-2."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE")] = None
    """Options from a .toml file or from the config.json of a run; flags replace them."""
    resume: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Go on with the run, or the runs of several seeds, in this folder; its length and the checkpoint options may
    change."""
    seed: int = 0
    """Seed of everything that is random."""
    seeds: tuple[str, ...] = ()
    """Train one run for each of these seeds, as in 0 1 2 or 0..4, each in a process of its own."""
    jobs: int | None = None
    """How many of them at a time; by default one per processor core."""
    out: Path | None = None
    """Folder of the run or runs; by default one below runs/ named after the task, the preset, the seed and the
    time."""
    overwrite: bool = False
    """Replace a run that the folder already holds."""
    plants: PlantOptions = PlantOptions()
    """Another plant."""
    config: TrainConfig = PRESETS["td3"]
    """The training configuration."""

    def run(self) -> None:
        """Trains and says where the policy is.

        Raises:
            SeedsFailedError: Some of several seeds failed; the others are trained.
        """
        run_file = self._run_file()
        env_id = self.env_id or run_file.env_id
        if env_id is None:
            raise InvalidInputError(
                f"give the task to train on, one of {', '.join(TASK_IDS)}, or --config FILE or --resume DIR"
            )
        if self.resume is not None:
            self._check_resume(run_file)
        env_options = merge_options(run_file.env_options, self.plants.env_options())
        seeds = parse_seeds(self.seeds)
        out = self.resume or self.out
        if out is None:
            label = self.preset if self.config_file is None else self.config_file.stem
            which = "seeds" if seeds else f"seed{self.seed}"
            out = Path("runs") / f"{env_id}-{label}-{which}-{time.strftime('%Y%m%d-%H%M%S')}"
        if seeds:
            self._run_seeds(env_id, out, seeds, env_options)
            return
        result = train(
            env_id, self.config, out, self.seed, env_options, self.overwrite, self.resume is not None
        )
        print(f"trained {result.steps} steps in {result.seconds:.0f} s ({result.stop_reason})")
        print(f"policy  {result.policy_path}")
        if result.stop_reason != "finished":
            print(f"go on   maniskill-tomato train --resume {out}")

    def _run_file(self) -> RunFile:
        if self.config_file is not None and self.resume is not None:
            raise InvalidInputError("give --config or --resume, not both: a run goes on as it began")
        if self.resume is not None:
            return read_run_config(self.resume)
        return RunFile() if self.config_file is None else read_run_file(self.config_file)

    def _check_resume(self, run_file: RunFile) -> None:
        """Refuses what would make the continued run another one."""
        changed = [
            name
            for name, given, begun in (
                ("the task", self.env_id, run_file.env_id),
                ("--preset", self.preset, run_file.preset or "td3"),
                ("--seed", self.seed, run_file.seed or 0),
                ("--seeds", self.seeds, tuple(map(str, run_file.seeds))),
                ("--out", self.out, None),
                ("--overwrite", self.overwrite, False),
                ("--plant...", self.plants, PlantOptions()),
            )
            if given not in (begun, None)
        ]
        begun_config, config = run_file.train_config("td3").to_dict(), self.config.to_dict()
        changed += [
            f"--{name.replace('_', '-')}"
            for name, value in config.items()
            if value != begun_config[name] and name not in MAY_CHANGE
        ]
        if changed:
            raise InvalidInputError(
                f"--resume goes on with {self.resume} as it began, so it cannot take {', '.join(changed)}; "
                f"only {', '.join(MAY_CHANGE)} may change"
            )

    def _run_seeds(self, env_id: str, out: Path, seeds: tuple[int, ...], env_options: dict[str, Any]) -> None:
        from maniskill_tomato.learning.envs import check_env_id
        from maniskill_tomato.learning.seeds import summary_table, train_seeds

        check_env_id(env_id)
        results = train_seeds(
            env_id,
            self.config,
            out,
            seeds,
            env_options,
            jobs=self.jobs,
            overwrite=self.overwrite,
            resume=self.resume is not None,
        )
        print(summary_table(results))
        if any(r.stop_reason != "finished" for r in results):
            print(f"go on   maniskill-tomato train --resume {out}")
        failed = [r for r in results if r.error is not None]
        if failed:
            listed = ", ".join(str(r.seed) for r in failed)
            raise SeedsFailedError(f"{len(failed)} of {len(results)} seeds failed: {listed}")


@dataclass(frozen=True, kw_only=True)
class Eval:
    """Evaluate a policy: metrics.json, plots, a film and report.html."""

    env_id: EnvId
    """Id of the task."""
    policy: str | None = None
    """File of the policy (.pt, or .onnx from `export`), or `random`; by default the one that ships with the
    package."""
    episodes: int = 100
    """How many episodes."""
    seed: int = 1000
    """Seed of the first episode; the others follow."""
    out: Path = Path("runs/eval")
    """Folder of the results."""
    baseline: bool = True
    """Also run random actions, to compare."""
    video: bool = True
    """Film the first episodes where this machine can render."""
    allow_other_task: bool = False
    """Accept a policy that was trained on another task."""
    plants: PlantOptions = PlantOptions()
    """Another plant."""

    def run(self) -> None:
        """Evaluates and says where the report is."""
        from maniskill_tomato.evaluation.evaluate import EvaluationConfig, evaluate
        from maniskill_tomato.evaluation.exported import open_policy
        from maniskill_tomato.evaluation.rollout import ActingPolicy
        from maniskill_tomato.learning.envs import check_env_id
        from maniskill_tomato.learning.policy import RandomPolicy

        check_env_id(self.env_id)
        path: Path | None = None
        policy: ActingPolicy = RandomPolicy(self.seed)
        if self.policy != "random":
            path = Path(self.policy) if self.policy else shipped_policy(self.env_id)
            policy = open_policy(path, env_id=None if self.allow_other_task else self.env_id)
        run_dir = path.parent if path is not None and (path.parent / "history.npz").is_file() else None
        config = EvaluationConfig(
            env_id=self.env_id,
            episodes=self.episodes,
            seed=self.seed,
            out=self.out,
            env_options=self.plants.env_options(),
            baseline=self.baseline,
            video=self.video,
            title="Where to look: evaluation",
            training_run=run_dir,
        )
        result = evaluate(config, policy, path)
        print(summary(result.metrics))
        if result.left_out:
            print(result.left_out)
        print(f"metrics {self.out / 'metrics.json'}")
        print(f"report  {result.report}")


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a policy as an ONNX file and a JSON description, which run without PyTorch and ManiSkill."""

    policy: Path | None = None
    """File of the policy, or a checkpoint of its run; by default those that ship with the package."""
    out: Path = Path("runs/export")
    """Folder of the results; an earlier export of the same name in it is replaced."""

    def run(self) -> None:
        """Exports and says where the files are."""
        from maniskill_tomato.learning.export import export_policy

        for path in [self.policy] if self.policy else [shipped_policy(env_id) for env_id in THESIS_IDS]:
            result = export_policy(path, self.out)
            print(f"model       {result.model}")
            print(f"description {result.description}")
            print(f"largest difference from PyTorch {result.largest_difference:.1e}")


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
        """Runs all three parts and names the results."""
        from maniskill_tomato.evaluation.evaluate import EvaluationConfig, evaluate
        from maniskill_tomato.learning.policy import load_policy

        env_id = "TomatoViewpointGuided-v1"
        print(f"1/2 training on {env_id}, at most {self.minutes:g} minutes")
        config = dataclasses.replace(PRESETS["td3"], max_minutes=self.minutes)
        trained = train(env_id, config, self.out / "training", self.seed, {}, overwrite=True)
        print(f"    {trained.steps} steps in {trained.seconds:.0f} s ({trained.stop_reason})")
        print(f"2/2 evaluating {self.episodes} episodes")
        evaluation = EvaluationConfig(
            env_id=env_id,
            episodes=self.episodes,
            seed=1000,
            out=self.out,
            video=self.video,
            title="Where to look: a policy that uncovers a hidden tomato",
            training_run=trained.run_dir,
        )
        result = evaluate(evaluation, load_policy(trained.policy_path), trained.policy_path)
        print(summary(result.metrics))
        if result.left_out:
            print(result.left_out)
        print(f"report  {result.report}")
        print(f"video   {result.video or 'none, see above' if self.video else 'not wanted'}")
        print(f"policy  {trained.policy_path}")


def train(
    env_id: str,
    config: TrainConfig,
    out: Path,
    seed: int,
    env_options: dict[str, Any],
    overwrite: bool = False,
    resume: bool = False,
) -> Any:
    """Trains in `out`; returns the `TrainResult`."""
    from maniskill_tomato.learning.run import train as train_run

    return train_run(env_id, config, out, seed, env_options, overwrite=overwrite, resume=resume)


def merge_options(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """The task options `base` with `changes` put over them, one by one within tables such as `plant`."""
    merged = dict(base)
    for name, value in changes.items():
        old = merged.get(name)
        if isinstance(old, str) and name == "plant":
            old = {"preset": old}
        merged[name] = {**old, **value} if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def shipped_policy(env_id: str) -> Path:
    """The trained policy that ships with the package.

    Raises:
        InvalidInputError: None ships for this task.
    """
    from maniskill_tomato.assets import asset_path

    try:
        return asset_path(f"policies/{env_id}.pt")
    except FileNotFoundError as error:
        raise InvalidInputError(
            f"no policy for {env_id} ships with this version; train one with `maniskill-tomato train {env_id}` and "
            "give its policy.pt with --policy"
        ) from error


def summary(metrics: dict[str, Any]) -> str:
    """One line with the figures that matter."""
    low, high = metrics["success_rate_interval_95"]
    return (
        f"success {metrics['success_rate']:.0%} of {metrics['episodes']} episodes "
        f"(95 % interval {low:.0%} to {high:.0%}), "
        f"{metrics['mean_steps']:.1f} steps, largest V_f {metrics['mean_max_visible_fraction']:.2f} on average"
    )


def parse(argv: Sequence[str]) -> Train | Eval | Benchmark | Demo | Export:
    """The command that the arguments describe.

    The options of `train` default to those of the run that it continues or of its `--config` file, and these to
    those of its `--preset`.

    Raises:
        InvalidInputError: The file or the run cannot be used.
    """
    train_default = _train_default(argv) if "train" in argv[:1] else Train()
    commands: Any = (
        Annotated[Train, tyro.conf.subcommand("train", default=train_default)]
        | Annotated[Eval, tyro.conf.subcommand("eval")]
        | Annotated[Benchmark, tyro.conf.subcommand("benchmark")]
        | Annotated[Demo, tyro.conf.subcommand("demo")]
        | Annotated[Export, tyro.conf.subcommand("export")]
    )
    command: Train | Eval | Benchmark | Demo | Export = tyro.cli(
        commands,
        prog="maniskill-tomato",
        description="Active perception for tomato harvesting: train, evaluate, compare, demonstrate, export.",
        args=list(argv),
        config=(tyro.conf.OmitArgPrefixes,),
    )
    return command


def _train_default(argv: Sequence[str]) -> Train:
    """What `train` does without further flags, from the files and the preset that the arguments name."""
    resumed, file = _asked(argv, "--resume"), _asked(argv, "--config")
    if resumed is not None:
        run_file = read_run_config(Path(resumed))
    elif file is not None:
        run_file = read_run_file(Path(file))
    else:
        run_file = RunFile()
    preset = run_file.preset or "td3"
    asked = _asked(argv, "--preset")
    for name in PRESETS:
        if asked == name:
            preset = name
    seed_asked = _asked(argv, "--seed") is not None
    return Train(
        env_id=run_file.env_id,
        preset=preset,
        seed=run_file.seed or 0,
        seeds=() if seed_asked and resumed is None else tuple(map(str, run_file.seeds)),
        config=run_file.train_config(preset),
    )


def _asked(argv: Sequence[str], flag: str) -> str | None:
    """The value of a flag, written as two words or with `=`, before the arguments are taken apart."""
    value: str | None = None
    for index, argument in enumerate(argv):
        if argument == flag and index + 1 < len(argv):
            value = argv[index + 1]
        elif argument.startswith(f"{flag}="):
            value = argument.removeprefix(f"{flag}=")
    return value


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    try:
        parse(sys.argv[1:] if argv is None else argv).run()
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
