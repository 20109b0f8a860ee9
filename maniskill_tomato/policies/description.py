"""What an exported policy says about itself: layout, units, bounds, normaliser, task, origin."""

import json
import math
from dataclasses import asdict, dataclass
from typing import Any, Final

import maniskill_tomato
from maniskill_tomato.errors import PolicyError
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.policies.layout import layout_of, unknown_task
from maniskill_tomato.sensing.image_layout import ImageLayout, Sight
from maniskill_tomato.text_files import parse_json

FORMAT = 2
"""Version of the layout that `PolicyDescription.to_json` writes for policies that see images; 1 for all others, which
earlier versions read too."""

INPUT_NAME = "observation"
OUTPUT_NAME = "action"


@dataclass(frozen=True, kw_only=True)
class Component:
    """One value of the observation or of the action."""

    name: str
    unit: str
    """Such as m or rad."""
    low: float | None
    """Smallest value; None if the task sets none."""
    high: float | None
    """Largest value; None if the task sets none."""


@dataclass(frozen=True, kw_only=True)
class ActionComponent(Component):
    """One value of the action; the graph already applies scale and bounds."""

    scale: float
    """The action that an actor output of 1 stands for, in `unit`."""


@dataclass(frozen=True, kw_only=True)
class PolicyDescription:
    """The JSON file beside an exported policy."""

    package_version: str
    """The version of this package that trained the policy."""
    env_id: str
    """The task that it was trained on."""
    success_threshold: float | None
    """The target counts as fully visible when V_f is above this; None if the exporting version does not know the
    task."""
    default_plant: dict[str, Any] | None
    """The task's own plant and where it stands, or None; `trained_with` says whether another was used."""
    observation: tuple[Component, ...]
    """The input, in order; in the frame of `PolicyLayout`."""
    normalizer_centre: tuple[float, ...]
    """What the normaliser, which is part of the graph, maps to 0."""
    normalizer_half_range: tuple[float, ...]
    """What it maps to 1, as a distance from the centre."""
    normalizer_kind: str
    """Where both come from: `none` (the identity), `fixed` ranges, or the `running` mean and standard deviation of
    the training's observations; `unknown` in files that do not say."""
    action: tuple[ActionComponent, ...]
    """The output, in order; `PolicyLayout.action_meaning` says what it does."""
    training: dict[str, Any]
    """Algorithm, seed, steps and episodes of its training, and the SHA-256 of its configuration."""
    onnx_sha256: str
    """SHA-256 of the ONNX file that belongs to this description."""
    trained_with: dict[str, Any] | None = None
    """Options of the task in the training, such as `plant`, `plant_pose`; empty if it was as it is, None if not
    known."""
    sight: Sight | None = None
    """The images that stand beside the observation; None if there are none."""

    def to_json(self) -> str:
        """The file's text."""
        layout = layout_of(self.env_id, self.sight)
        content: dict[str, Any] = {
            "format": 1 if self.sight is None else FORMAT,
            "package_version": self.package_version,
            "task": {
                "id": self.env_id,
                "success_threshold": self.success_threshold,
                "default_plant": self.default_plant,
                "trained_with": self.trained_with,
            },
            "observation": {
                "input": INPUT_NAME,
                "dtype": "float32",
                "shape": ["batch", len(self.observation)],
                "frame": layout.frame,
                "components": [asdict(c) for c in self.observation],
            },
            "normalizer": {
                "formula": "(observation - centre) / half_range",
                "part_of_the_graph": True,
                "kind": self.normalizer_kind,
                "centre": list(self.normalizer_centre),
                "half_range": list(self.normalizer_half_range),
            },
            "action": {
                "output": OUTPUT_NAME,
                "dtype": "float32",
                "shape": ["batch", len(self.action)],
                "meaning": layout.action_meaning,
                "scale_and_bounds_part_of_the_graph": True,
                "components": [asdict(c) for c in self.action],
            },
            "training": self.training,
            "onnx": {"sha256": self.onnx_sha256},
        }
        if self.sight is not None:
            content["images"] = _images_json(self.sight)
        return json.dumps(content, indent=2, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str) -> "PolicyDescription":
        """The description that `to_json` wrote.

        Raises:
            PolicyError: The text is damaged, not a description, of a newer format, or of another observation
                or action layout than this version's.
        """
        try:
            content = parse_json(text)
        except ValueError as error:
            raise PolicyError(f"it is not readable JSON ({error})") from error
        if not isinstance(content, dict) or not isinstance(content.get("format"), int):
            raise PolicyError("it is not a policy description, which would say its format")
        if content["format"] > FORMAT:
            raise PolicyError(
                f"it has format {content['format']}, written by version {content.get('package_version')}; this "
                f"version, {maniskill_tomato.__version__}, reads up to {FORMAT}: upgrade maniskill-tomato"
            )
        try:
            plant = content["task"]["default_plant"]
            trained_with = content["task"].get("trained_with")  # Older descriptions lack it.
            description = cls(
                package_version=_text(content["package_version"]),
                env_id=_text(content["task"]["id"]),
                success_threshold=_optional_number(content["task"]["success_threshold"]),
                default_plant=None if plant is None else dict(plant),
                observation=tuple(Component(**_component(c)) for c in content["observation"]["components"]),
                normalizer_centre=tuple(_number(v) for v in content["normalizer"]["centre"]),
                normalizer_half_range=tuple(_number(v) for v in content["normalizer"]["half_range"]),
                normalizer_kind=_text(content["normalizer"].get("kind", "unknown")),
                action=tuple(
                    ActionComponent(scale=_number(c["scale"]), **_component(c))
                    for c in content["action"]["components"]
                ),
                training=dict(content["training"]),
                onnx_sha256=_text(content["onnx"]["sha256"]),
                trained_with=None if trained_with is None else dict(trained_with),
                sight=_sight(content["images"]) if "images" in content else None,
            )
        except KeyError as error:
            raise PolicyError(f"it lacks the entry {error}") from error
        except (TypeError, ValueError, AttributeError) as error:
            raise PolicyError(f"an entry has the wrong type ({error})") from error
        description.check_layout()
        return description

    def check_layout(self) -> None:
        """Accepts the observation and the action of this version's tasks.

        Raises:
            PolicyError: Names, units or their order differ, or the normaliser has another length.
        """
        layout = layout_of(self.env_id, self.sight)
        for what, components, names, units in (
            ("observation", self.observation, layout.observation_names, layout.observation_units),
            ("action", self.action, layout.action_names, layout.action_units),
        ):
            given = [f"{c.name} [{c.unit}]" for c in components]
            wanted = [f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)]
            if given != wanted:
                raise PolicyError(
                    f"its {what} is {shortened(given)}; this version's is {shortened(wanted)}: "
                    "export the policy with this version"
                    f"{unknown_task(self.env_id)}"
                )
        if not len(self.normalizer_centre) == len(self.normalizer_half_range) == len(self.observation):
            raise PolicyError(f"its normaliser must have {len(self.observation)} centres and half ranges")


IMAGE_MEANINGS: Final = {
    "rgb": ("uint8", "sRGB colours"),
    "depth": ("int16", "along the optical axis, in mm; 0 where it was not measured"),
    "segmentation": (
        "uint8",
        "roles by number: " + ", ".join(f"{role.value} {role.name.lower()}" for role in Role),
    ),
}
"""Type and meaning of each image."""


def _images_json(sight: Sight) -> dict[str, Any]:
    return {
        "frames": sight.frames,
        "state_parts": list(sight.state_parts),
        "inputs": [
            {
                "input": kind,
                "dtype": IMAGE_MEANINGS[kind][0],
                "shape": ["batch", *shape],
                "meaning": IMAGE_MEANINGS[kind][1],
            }
            for kind, shape in sight.shapes.items()
        ],
    }


def _sight(entry: dict[str, Any]) -> Sight:
    inputs = entry["inputs"]
    _, height, width, _ = inputs[0]["shape"]
    images = ImageLayout(kinds=tuple(one["input"] for one in inputs), width=width, height=height)
    sight = Sight(images=images, frames=entry["frames"], state_parts=tuple(entry["state_parts"]))
    if _images_json(sight)["inputs"] != inputs:
        raise ValueError(f"images {inputs!r} are not of one layout")
    return sight


def shortened(names: list[str]) -> str:
    """A list for a message; of a long one the beginning."""
    return ", ".join(names) if len(names) <= 9 else f"{', '.join(names[:3])}, ... ({len(names)} values)"


def _component(entry: dict[str, Any]) -> dict[str, Any]:
    """The arguments of a `Component`, checked."""
    low, high = (_optional_number(entry[key]) for key in ("low", "high"))
    return {"name": _text(entry["name"]), "unit": _text(entry["unit"]), "low": low, "high": high}


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"{value!r} is not a finite number")
    return float(value)


def _optional_number(value: Any) -> float | None:
    return None if value is None else _number(value)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not text")
    return value
