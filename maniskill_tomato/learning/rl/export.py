"""A trained policy as an ONNX file and a description, for machines without PyTorch and ManiSkill.

The actor is a chain of a few dense layers, after a few convolutions if it sees images. Its graph is therefore written
node by node with the `onnx` package rather than traced by `torch.onnx`: that would add onnxscript and an intermediate
representation to the dependencies, and its output changes with their versions. Here the same policy gives the same
bytes. An actor that this module does not know completely is caught before anything is written, because every export is
compared with PyTorch.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError, PolicyError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.learning.rl.dense_actor import DenseActor
from maniskill_tomato.learning.rl.onnx_graph import make_model
from maniskill_tomato.learning.rl.rounding import rounding_tolerance
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.policies.description import (
    ActionComponent,
    Component,
    PolicyDescription,
    shortened,
)
from maniskill_tomato.policies.layout import layout_of, unknown_task
from maniskill_tomato.policies.onnx_policy import OnnxPolicy, description_path
from maniskill_tomato.policies.trained_actor import load_actor, load_checkpoint, sight_of
from maniskill_tomato.sensing.image_observation import STATE
from maniskill_tomato.task_registry import THESIS_IDS, base_of
from maniskill_tomato.tasks.making import make_options


@dataclass(frozen=True, kw_only=True)
class ExportResult:
    """What an export wrote."""

    model: Path
    """The ONNX file."""
    description: Path
    """The JSON file beside it."""
    largest_difference: float
    """From PyTorch, over the observations of `parity_observations`, in [m] and [rad]."""


def export_policy(path: Path | str, out: Path) -> ExportResult:
    """Writes NAME.onnx and NAME.json for the policy or checkpoint file NAME.pt.

    Args:
        path: The file; any checkpoint of a run will do.
        out: Folder of the results; an earlier export of the same name is replaced.

    Raises:
        InvalidInputError: `out` cannot be made.
        CheckpointError: The policy cannot be read, or the results cannot be written.
        PolicyError: The policy has another layout than this version's tasks, or ONNX Runtime answers
            otherwise than PyTorch.
    """
    path = Path(path)
    policy = load_actor(path)
    _check_layout(path)
    config = TrainConfig.from_dict(policy.config)
    actor = DenseActor(
        act=policy.act,
        normalizer=policy.normalizer,
        normalizer_kind=config.normalize_observations,
        layers=[*policy.actor.hidden, policy.actor.output],
        activation="Relu",
        output="Tanh",
        action_scale=policy.action_scale,
        action_low=policy.action_low,
        action_high=policy.action_high,
        env_id=policy.env_id,
        env_options=policy.env_options,
        package_version=policy.package_version,
        algorithm=policy.algorithm,
        counters=policy.counters,
        config=config.to_dict(),
        encoder=policy.encoder,
        sight=policy.sight,
    )
    return export_actor(actor, out / f"{path.stem}.onnx", name=str(path))


def export_actor(actor: DenseActor, target: Path, name: str = "this policy") -> ExportResult:
    """Writes the ONNX file `target` and its description beside it.

    Args:
        actor: The policy.
        target: Name of the file, with the ending .onnx; an earlier one is replaced.
        name: What messages call the policy.

    Raises:
        InvalidInputError: The folder cannot be made.
        CheckpointError: The results cannot be written.
        PolicyError: ONNX Runtime answers otherwise than the policy.
    """
    model = make_model(actor)
    description = describe_policy(actor, model)
    observations = parity_observations(actor)
    images = parity_images(actor, len(observations))
    state = torch.from_numpy(observations)
    seen = {kind: torch.from_numpy(image) for kind, image in images.items()}
    reference = actor.act({STATE: state, **seen} if seen else state).numpy()
    difference = np.abs(
        OnnxPolicy.from_bytes(model, description, target).act(observations, images) - reference
    )
    if not (difference <= rounding_tolerance(actor, observations, images)).all():
        raise PolicyError(
            f"{name} cannot be exported: ONNX Runtime and PyTorch differ by {difference.max():.1e}, more than float32 "
            "rounds; nothing was written"
        )
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"{target.parent} cannot be a folder ({error.strerror}); choose another --out"
        ) from error
    write_atomically(target, model)
    write_atomically(description_path(target), description.to_json().encode())
    return ExportResult(
        model=target, description=description_path(target), largest_difference=float(difference.max())
    )


def describe_policy(actor: DenseActor, model: bytes) -> PolicyDescription:
    """The description of a policy and its ONNX file."""
    scene = (actor.env_options or {}).get("scene", "hidden")
    task = make_options(actor.env_id, scene=scene).task if base_of(actor.env_id) in THESIS_IDS else None
    config = json.dumps(actor.config, sort_keys=True)
    layout = layout_of(actor.env_id, actor.sight)
    for what, given, wanted in (
        ("observes", len(actor.normalizer.centre), len(layout.observation_names)),
        ("does", len(actor.action_scale), len(layout.action_names)),
    ):
        if given != wanted:
            raise PolicyError(
                f"a policy of {actor.env_id} that {what} {given} values cannot be exported; descriptions are of "
                f"{wanted}, those of the task as it is"
            )
    bounds = (_shortest(actor.action_low), _shortest(actor.action_high), _shortest(actor.action_scale))
    return PolicyDescription(
        package_version=actor.package_version,
        env_id=actor.env_id,
        success_threshold=task.full_visibility if task else None,
        default_plant={**asdict(task.plant), "pose": asdict(task.plant_pose)} if task else None,
        trained_with=actor.env_options,
        observation=tuple(
            Component(name=name, unit=unit, low=None, high=None)
            for name, unit in zip(layout.observation_names, layout.observation_units, strict=True)
        ),
        normalizer_centre=_shortest(actor.normalizer.centre),
        normalizer_half_range=_shortest(actor.normalizer.half_range),
        normalizer_kind=actor.normalizer_kind,
        action=tuple(
            ActionComponent(name=name, unit=unit, low=low, high=high, scale=scale)
            for name, unit, low, high, scale in zip(
                layout.action_names, layout.action_units, *bounds, strict=True
            )
        ),
        training={
            "algorithm": actor.algorithm,
            **{key: actor.counters.get(key) for key in ("seed", "steps", "episodes", "updates")},
            "config_sha256": hashlib.sha256(config.encode()).hexdigest(),
        },
        onnx_sha256=hashlib.sha256(model).hexdigest(),
        sight=actor.sight,
    )


def parity_observations(actor: DenseActor, count: int = 1000, seed: int = 0) -> NDArray[np.float32]:
    """Observation on which an export is compared with PyTorch.

    Returns:
        Zeros, the normaliser's centre, every value alone at and far beyond both ends of its range, all values
        there together, and `count` random ones around the range. Shape (B, D).
    """
    centre = actor.normalizer.centre.cpu().numpy()
    half_range = actor.normalizer.half_range.cpu().numpy()
    signs = np.concatenate((np.eye(len(centre)), np.ones((1, len(centre)))))
    edges = np.concatenate([factor * signs for factor in (-10.0, -1.0, 1.0, 10.0)])
    random = np.random.default_rng(seed).normal(scale=1.5, size=(count, len(centre)))
    around = centre + half_range * np.concatenate((edges, random))
    return np.concatenate((np.zeros((1, len(centre))), centre[None], around)).astype(np.float32)


def parity_images(actor: DenseActor, count: int, seed: int = 0) -> dict[str, NDArray[Any]]:
    """Images on which an export is compared with PyTorch: all black, all at the upper end, and random ones.

    Args:
        actor: The policy.
        count: How many, B.
        seed: Of the random ones.

    Returns:
        By kind, each of shape (B, H, W, C); none for a policy that sees none.
    """
    if actor.sight is None:
        return {}
    rng = np.random.default_rng(seed)
    images: dict[str, NDArray[Any]] = {}
    for kind, box in actor.sight.images.spaces(actor.sight.frames).items():
        most = 3000 if kind == "depth" else int(box.high.max())
        image = rng.integers(0, most + 1, (count, *box.shape)).astype(box.dtype)
        image[0], image[1] = 0, box.high
        images[kind] = image
    return images


def _check_layout(path: Path) -> None:
    """Refuses a policy that observes or does something else than the descriptions say."""
    data = load_checkpoint(path)
    layout = layout_of(data["env_id"], sight_of(data["config"]))
    for what, names in (("observation", layout.observation_names), ("action", layout.action_names)):
        if list(data[what]["names"]) != list(names):
            raise PolicyError(
                f"{path} cannot be exported: its {what} is {shortened(list(data[what]['names']))}; this version's is "
                f"{shortened(list(names))}{unknown_task(data['env_id'])}"
            )


def _shortest(values: torch.Tensor) -> tuple[float, ...]:
    """Float32 values as the shortest decimals that give them back: 0.35, not 0.3499999940395355."""
    return tuple(float(str(value)) for value in values.cpu().numpy().astype(np.float32))
