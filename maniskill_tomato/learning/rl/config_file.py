"""Run descriptions in files: TOML written by hand, or the `config.json` that a run leaves."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.presets import PresetName, TrainConfig, default_preset, get_preset
from maniskill_tomato.tables import read_table
from maniskill_tomato.text_files import read_json, read_toml


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """What a file says about a run; None where it says nothing."""

    env_id: str | None = None
    """Id of the task."""
    preset: PresetName | None = None
    """The named configuration that `config` changes."""
    seed: int | None = None
    """Seed of a single run."""
    seeds: tuple[int, ...] = ()
    """Seeds of several runs."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options of the task for `gymnasium.make`."""
    config: dict[str, Any] = field(default_factory=dict)
    """Fields of `TrainConfig`."""
    package_version: str | None = None
    """What wrote the file, if a run did."""

    def __post_init__(self) -> None:
        if min((0 if self.seed is None else self.seed, *self.seeds)) < 0:
            raise InvalidInputError(
                f"seeds must be 0 or more, got {self.seed if self.seeds == () else self.seeds}"
            )
        self.train_config(self.preset or default_preset(self.env_id))

    def train_config(self, preset: PresetName) -> TrainConfig:
        """The options on top of a preset.

        Raises:
            InvalidInputError: An option is unknown or its value not allowed.
        """
        return TrainConfig.from_dict({**get_preset(preset).to_dict(), **self.config})


def read_run_file(path: Path) -> RunFile:
    """Reads a `.toml` or `.json` file, whose entries are the fields of `RunFile`.

    Raises:
        InvalidInputError: It is missing, of another form, or says something unknown; the message has the file's
            name.
    """
    return read_table(RunFile, _read(path), path)


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


def _read(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise InvalidInputError(f"no configuration file at {path}")
    try:
        if path.suffix == ".toml":
            return read_toml(path)
        if path.suffix == ".json":
            values = read_json(path)
            if not isinstance(values, dict):
                raise InvalidInputError(f"{path} must hold a table, got {type(values).__name__}")
            return values
    except FileNotFoundError:
        raise InvalidInputError(f"no configuration file at {path}") from None
    raise InvalidInputError(f"a configuration file must end in .toml or .json; got {path}")
