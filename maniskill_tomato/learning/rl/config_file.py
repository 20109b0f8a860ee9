"""Run descriptions in files: TOML written by hand, or the `config.json` that a run leaves."""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.presets import PRESETS, PresetName, TrainConfig, default_preset, get_preset

KEYS = ("env_id", "preset", "seed", "seeds", "env_options", "config", "package_version")


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """What a file says about a run; None where it says nothing."""

    env_id: str | None = None
    """Id of the task."""
    preset: PresetName | None = None
    """The named configuration that `options` change."""
    seed: int | None = None
    """Seed of a single run."""
    seeds: tuple[int, ...] = ()
    """Seeds of several runs."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options of the task for `gymnasium.make`."""
    options: dict[str, Any] = field(default_factory=dict)
    """Fields of `TrainConfig`."""

    def train_config(self, preset: PresetName) -> TrainConfig:
        """The options on top of a preset.

        Raises:
            InvalidInputError: An option is unknown or its value not allowed.
        """
        return TrainConfig.from_dict({**get_preset(preset).to_dict(), **self.options})


def read_run_file(path: Path) -> RunFile:
    """Reads a `.toml` or `.json` file.

    Its keys are `env_id`, `preset`, `seed` or `seeds`, the table `config` (fields of `TrainConfig`) and the table
    `env_options` (options of the task, such as `plant` and `plant_pose`).

    Raises:
        InvalidInputError: It is missing, of another form, or says something unknown; the message has the file's
            name.
    """
    values = _read(path)
    unknown = sorted(set(values) - set(KEYS))
    if unknown:
        raise InvalidInputError(
            f"{path} has unknown entries {', '.join(unknown)}; known are {', '.join(KEYS)}"
        )
    for key in ("env_options", "config"):
        if not isinstance(values.get(key, {}), dict):
            raise InvalidInputError(f"{path}: {key} must be a table, got {values[key]!r}")
    env_id, seed, seeds = values.get("env_id"), values.get("seed"), values.get("seeds", [])
    if env_id is not None and not isinstance(env_id, str):
        raise InvalidInputError(f"{path}: env_id must be text, got {env_id!r}")
    if seed is not None and not _is_seed(seed):
        raise InvalidInputError(f"{path}: seed must be an integer of 0 or more, got {seed!r}")
    if not isinstance(seeds, list) or not all(_is_seed(s) for s in seeds):
        raise InvalidInputError(f"{path}: seeds must be a list of integers of 0 or more, got {seeds!r}")
    run_file = RunFile(
        env_id=env_id,
        preset=_preset(path, values.get("preset")),
        seed=seed,
        seeds=tuple(seeds),
        env_options=values.get("env_options", {}),
        options=values.get("config", {}),
    )
    try:
        run_file.train_config(run_file.preset or default_preset(env_id))
    except (InvalidInputError, TypeError) as error:
        raise InvalidInputError(f"{path}: {error}") from error
    return run_file


def read_run_config(run_dir: Path) -> RunFile:
    """The `config.json` of a run, or the `seeds.json` of several.

    Raises:
        InvalidInputError: The folder holds neither.
    """
    for name in ("seeds.json", "config.json"):
        if (run_dir / name).is_file():
            return read_run_file(run_dir / name)
    raise InvalidInputError(f"{run_dir} holds no run to continue (no config.json)")


def parse_seeds(words: tuple[str, ...]) -> tuple[int, ...]:
    """Seeds from words such as `3` and `0..4`, which stands for 0, 1, 2, 3, 4.

    Raises:
        InvalidInputError: A word is of another form, or a seed comes twice.
    """
    seeds: list[int] = []
    for word in words:
        first, dots, last = word.partition("..")
        if not first.isdecimal() or (dots and not last.isdecimal()) or (dots and int(last) < int(first)):
            raise InvalidInputError(
                f"seeds must be integers of 0 or more, or ranges such as 0..4; got {word!r}"
            )
        seeds += range(int(first), int(last or first) + 1)
    if len(set(seeds)) != len(seeds):
        raise InvalidInputError(f"every seed may come once only; got {', '.join(map(str, seeds))}")
    return tuple(seeds)


def _is_seed(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _preset(path: Path, value: object) -> PresetName | None:
    for name in PRESETS:
        if value == name:
            return name
    if value is None:
        return None
    raise InvalidInputError(f"{path}: {InvalidInputError.choice('preset', value, PRESETS)}")


def _read(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise InvalidInputError(f"no configuration file at {path}")
    try:
        if path.suffix == ".toml":
            return tomllib.loads(path.read_text())
        if path.suffix == ".json":
            values = json.loads(path.read_text())
            if not isinstance(values, dict):
                raise InvalidInputError(f"{path} must hold a table, got {type(values).__name__}")
            return values
    except (tomllib.TOMLDecodeError, json.JSONDecodeError, UnicodeDecodeError, OSError) as error:
        raise InvalidInputError(f"{path} cannot be read: {error}") from error
    raise InvalidInputError(f"a configuration file must end in .toml or .json; got {path}")
