"""`maniskill-tomato train`: one run, several seeds, or the rest of what was stopped."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_counts, check_env_id, check_file, task_word
from maniskill_tomato.cli.shared_options import TASK_HELP, PlantOptions, merge_options
from maniskill_tomato.errors import InvalidInputError, SeedsFailedError
from maniskill_tomato.learning.rl.config_file import RunFile, parse_seeds, read_run_config, read_run_file
from maniskill_tomato.learning.rl.presets import (
    MAY_CHANGE,
    PRESETS,
    PresetName,
    TrainConfig,
    default_preset,
    preset_options,
)
from maniskill_tomato.plants.plant_generators import check_recorded_plant
from maniskill_tomato.ray_jobs import jobs_on_ray
from maniskill_tomato.task_registry import TASK_IDS, check_recorded_task, find_task, lasting_name


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a policy; the other options start from the preset's, the file's or the continued run's values."""

    env_id: Annotated[
        str | None,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="ENV_ID", help=f"{TASK_HELP} The file or run may say it."),
    ] = None
    """Id of the task."""
    preset: PresetName = "td3"
    """Named configuration: a good default (td3, or general-td3 for the general tasks; with images pixel-td3 and
    general-pixel-td3), or the thesis's Table 5-1 or 5-2."""
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
    ray: bool = False
    """Do the work on a Ray cluster (extra `ray`): the one at RAY_ADDRESS, else one of this machine's cores."""
    out: Path | None = None
    """Folder of the run or runs; by default one below runs/ named after the task, the preset, the seed and the
    time."""
    overwrite: bool = False
    """Replace a run that the folder already holds."""
    plants: Annotated[PlantOptions, Flat] = PlantOptions()
    """Another plant."""
    config: Annotated[TrainConfig, Flat] = PRESETS["td3"]
    """The training configuration."""

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> "Train":
        """What holds without further options, by the files and the preset that the arguments name.

        Raises:
            InvalidInputError: A file or a run cannot be used.
        """
        return _default(argv)

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
        if self.resume is not None or self.config_file is not None:
            check_recorded_task(env_id, self.resume or self.config_file)
        check_env_id(env_id)
        env_id = lasting_name(env_id)
        check_counts(jobs=self.jobs)
        if self.config.initial_policy is not None:
            check_file("--initial-policy", Path(self.config.initial_policy))
        if self.config.reward_from is not None:
            check_file("--reward-from", Path(self.config.reward_from))
        if self.resume is not None:
            self._check_resume(run_file)
        env_options = run_file.env_options
        if self.resume is None:
            env_options = merge_options(env_options, self.plants.env_options())
        if self.resume is not None or self.config_file is not None:
            check_recorded_plant(
                env_options.get("plant"), self.resume or self.config_file, "name it with --plant {name}"
            )
        if run_file.package_version is None:  # The file of a run says all there is to say.
            env_options = {**preset_options(self.preset, env_id), **env_options}
        seeds = parse_seeds(self.seeds)
        if self.ray and not seeds:
            raise InvalidInputError("--ray trains several --seeds, each on a core of the cluster; give some")
        out = self.resume or self.out
        if out is None:
            label = self.preset if self.config_file is None else self.config_file.stem
            which = "seeds" if seeds else f"seed{self.seed}"
            out = (
                Path("runs") / f"{find_task(env_id).env_id}-{label}-{which}-{time.strftime('%Y%m%d-%H%M%S')}"
            )
        if seeds:
            self._run_seeds(env_id, out, seeds, env_options)
            return
        from maniskill_tomato.learning.rl.trainer import train

        result = train(
            env_id,
            self.config,
            out,
            self.seed,
            env_options,
            overwrite=self.overwrite,
            resume=self.resume is not None,
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
        begun_options = merge_options(run_file.env_options, {})
        asked_options = merge_options(begun_options, json.loads(json.dumps(self.plants.env_options())))
        changed = [
            name
            for name, given, begun in (
                ("the task", self.env_id, run_file.env_id),
                ("--preset", self.preset, run_file.preset or default_preset(run_file.env_id)),
                ("--seed", self.seed, run_file.seed or 0),
                ("--seeds", self.seeds, tuple(map(str, run_file.seeds))),
                ("--out", self.out, None),
                ("--overwrite", self.overwrite, False),
                ("--plant...", asked_options, begun_options),
            )
            if given not in (begun, None)
        ]
        begun_config, config = (
            run_file.train_config(default_preset(run_file.env_id)).to_dict(),
            self.config.to_dict(),
        )
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
        from maniskill_tomato.learning.rl.seeds import summary_table, train_seeds

        with jobs_on_ray(self.ray):
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


def _default(argv: Sequence[str]) -> Train:
    """What `train` does without further flags, from the files and the preset that the arguments name."""
    resumed, file, typed = _asked(argv, "--resume"), _asked(argv, "--config"), task_word(argv)
    if resumed is not None:
        run_file = read_run_config(Path(resumed))
    elif file is not None:
        run_file = read_run_file(Path(file))
    else:
        run_file = RunFile()
    env_id = run_file.env_id or typed
    preset = run_file.preset or default_preset(env_id, _asked(argv, "--obs-mode"))
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
