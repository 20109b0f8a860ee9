"""Settings to train with, read from TOML: the thesis's experiments, and presets with something changed."""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.configs import ExperimentName
from maniskill_tomato.learning.rl.presets import PRESETS, TrainConfig, get_preset
from maniskill_tomato.tables import read_table
from maniskill_tomato.tasks import THESIS_IDS, Scene
from maniskill_tomato.tasks.thesis.scenes import plant_pose

TOGETHER = "+"
WITHOUT = "td3-without-"


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Where a trained policy is judged."""

    name: str
    """Short name, part of file names."""
    title: str
    """What stands above its figures."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options for `gymnasium.make`; none for the plant and the pose of the training."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One of the thesis's two."""

    name: str
    env_id: str
    preset: str
    """The exact settings: Table 5-1 or 5-2."""
    windows: tuple[int, int]
    """Moving-average windows of its training curves, in episodes and steps."""
    evaluations: tuple[Evaluation, ...]
    """The first is on the plant and at the pose of the training; the others are the thesis's. Their options include
    those of the training."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options for `gymnasium.make` of the training."""
    total_steps: int | None = None
    """Steps of the thesis's own training, if it says."""
    exploration_ends: tuple[int, int] | None = None
    """Episode and step at which the exploration of the thesis's own training ended, if it did."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A preset, or a preset with something changed."""

    name: str
    title: str
    """What differs, for tables."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Fields of `TrainConfig` and their new values; none for a preset as it is."""
    tasks: tuple[str, ...] = THESIS_IDS
    """Where it applies."""
    preset: str | None = None
    """What `changes` are made to; None stands for the preset of the study."""
    part_of_td3: bool = False
    """Whether it is one of the steps from the thesis's exact settings to `td3`."""

    def config(self, preset: str) -> TrainConfig:
        """The training configuration of this variant in a study of `preset`.

        Raises:
            InvalidInputError: There is no such preset, or a change does not fit it.
        """
        base = get_preset(self.preset or preset)
        return TrainConfig.from_dict({**base.to_dict(), **self.changes})


def choose_variants(names: Sequence[str]) -> list[Variant]:
    """The variants of the learner's options with these names, all of them if there are none.

    Raises:
        InvalidInputError: There is no such variant; the message lists them.
    """
    known = {variant.name: variant for variant in learner_variants()}
    for name in names:
        if name not in known:
            raise InvalidInputError.choice("a variant", name, known)
    return [known[name] for name in names] if names else list(known.values())


@cache
def learner_variants() -> tuple[Variant, ...]:
    """One change of the learner's options each, the preset itself first."""
    return _variants(_read("learner_variants.toml"))


@cache
def experiments(scene: Scene = "thesis") -> dict[ExperimentName, Experiment]:
    """The thesis's two, in a scene."""
    found: dict[ExperimentName, Experiment] = {}
    for name, values in _read("thesis_variants.toml")["experiment"].items():
        yaw = plant_pose(values["env_id"], scene).yaw
        for one in values["evaluations"]:
            one["env_options"] = {"scene": scene, **one.get("env_options", {})}
            if (pose := one["env_options"].get("plant_pose")) is not None:
                pose[2] = round(yaw + pose[2], 3)
        values["env_options"] = {"scene": scene}
        found[name] = read_table(Experiment, {"name": name, **values}, f"experiment.{name}")
    return found


def variants_of(experiment: Experiment) -> dict[str, Variant]:
    """The exact settings, every change of them, and `td3`, by name."""
    found = _variants(_read("thesis_variants.toml"))
    return {v.name: v for v in found if experiment.env_id in v.tasks}


def find_variant(experiment: Experiment, name: str) -> Variant:
    """The variant called `name`.

    Beside those of `variants_of`, `A+B` is the exact settings with the changes A and B, and `td3-without-A+B` the
    preset `td3` with what A and B change put back to the exact settings.

    Raises:
        InvalidInputError: The experiment has none of this name, the message lists them; or two changes of one name
            contradict each other.
    """
    variants = variants_of(experiment)
    if name.startswith(WITHOUT):
        return _td3_without(experiment, name)
    if name in variants:
        return variants[name]
    if TOGETHER not in name:
        raise InvalidInputError.choice(f"variant of {experiment.name}", name, variants)
    parts = [find_variant(experiment, part) for part in name.split(TOGETHER)]
    changes: dict[str, Any] = {}
    for part in parts:
        if not part.changes or part.preset is not None or changes.keys() & part.changes.keys():
            raise InvalidInputError(
                f"{name} cannot be combined: {part.name} changes nothing, or what another part changes already"
            )
        changes |= part.changes
    return Variant(name=name, title="; ".join(part.title for part in parts), changes=changes)


def _td3_without(experiment: Experiment, name: str) -> Variant:
    """The preset `td3` with some of its parts put back."""
    parts = {v.name: v for v in variants_of(experiment).values() if v.part_of_td3}
    chosen: list[Variant] = []
    for part in name.removeprefix(WITHOUT).split(TOGETHER):
        if part not in parts:
            raise InvalidInputError.choice("part of td3", part, parts)
        chosen.append(parts[part])
    exact = get_preset(experiment.preset)
    return Variant(
        name=name,
        title=f"`td3` without: {'; '.join(part.title for part in chosen)}",
        changes={field: getattr(exact, field) for part in chosen for field in part.changes},
        preset="td3",
    )


def _read(name: str) -> dict[str, Any]:
    return tomllib.loads((files("maniskill_tomato.experiments") / name).read_text(encoding="utf-8"))


def _variants(content: dict[str, Any]) -> tuple[Variant, ...]:
    td3 = PRESETS["td3"]
    found = []
    for values in content["variant"]:
        of_td3 = {"changes": {name: getattr(td3, name) for name in values.pop("of_td3", ())}}
        found.append(read_table(Variant, {**of_td3, **values}, f"variant {values['name']!r}"))
    return tuple(found)
