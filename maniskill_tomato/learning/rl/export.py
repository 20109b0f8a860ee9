"""A trained policy as an ONNX file and a description, for machines without PyTorch and ManiSkill.

The actor is a chain of a few dense layers, so its graph is written node by node with the `onnx` package rather than
traced by `torch.onnx`: that would add onnxscript and an intermediate representation to the dependencies, and its
output changes with their versions. Here the same policy gives the same bytes. An actor that this module does not
know completely is caught before anything is written, because every export is compared with PyTorch.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError, PolicyError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.policies.actor import ObservationNormalizer
from maniskill_tomato.policies.description import (
    INPUT_NAME,
    OUTPUT_NAME,
    ActionComponent,
    Component,
    PolicyDescription,
    shortened,
)
from maniskill_tomato.policies.layout import layout_of
from maniskill_tomato.policies.onnx_policy import OnnxPolicy, description_path
from maniskill_tomato.policies.trained_actor import load_actor, load_checkpoint
from maniskill_tomato.tasks import THESIS_IDS
from maniskill_tomato.tasks.thesis.thesis_config import ViewpointTaskConfig, guided_task, sparse_task

OPSET = 17
"""Version of the operators; an old one on purpose, so that old runtimes read the file too."""

IR_VERSION = 8
"""Version of the file format, the one of that time."""

FLOAT32_UNIT_ROUNDOFF = 2.0**-24
"""Largest relative error of one rounding to float32."""

_TASKS: dict[str, Callable[[], ViewpointTaskConfig]] = dict(
    zip(THESIS_IDS, (guided_task, sparse_task), strict=True)
)


@dataclass(frozen=True, kw_only=True)
class DenseActor:
    """A policy in the parts that its graph is written from; this package's own and those of other learners."""

    act: Callable[[torch.Tensor], torch.Tensor]
    """What the export is compared with: actions of shape (B, A) for observations of shape (B, D)."""
    normalizer: ObservationNormalizer
    normalizer_kind: str
    """Where the normaliser comes from, see `PolicyDescription`."""
    layers: Sequence[nn.Module]
    """Linear layers, the first at the observations."""
    activation: Literal["Relu", "Tanh"]
    """What follows each of them but the last."""
    output: Literal["Tanh", "Clip"]
    """What brings the output of the last into [-1, 1]."""
    action_scale: torch.Tensor
    """The action that an output of 1 stands for, in the task's units. Shape (A,)."""
    action_low: torch.Tensor
    """The task's bounds. Shape (A,)."""
    action_high: torch.Tensor
    """Shape (A,)."""
    env_id: str
    """The task that it was trained on."""
    env_options: dict[str, Any] | None
    """The options of the task in the training; empty if there were none, None if that is not known."""
    package_version: str
    """The version of this package in the training."""
    algorithm: str
    counters: dict[str, Any]
    """Steps, episodes and seed of the training; what is missing becomes null."""
    config: dict[str, Any]
    """Every training option, as JSON can hold them."""


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
    reference = actor.act(torch.from_numpy(observations)).numpy()
    difference = np.abs(OnnxPolicy.from_bytes(model, description, target).act(observations) - reference)
    if not (difference <= rounding_tolerance(actor, observations)).all():
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


def make_model(actor: DenseActor) -> bytes:
    """The ONNX file of a policy: observations in [m] and [rad] in, actions in [m] and [rad] out."""
    graph = _Graph()
    x = graph.add("Sub", INPUT_NAME, centre=actor.normalizer.centre)
    x = graph.add("Div", x, half_range=actor.normalizer.half_range)
    for index, layer in enumerate(actor.layers[:-1]):
        x = graph.add_dense(x, f"hidden_{index}", layer)
        x = graph.add(actor.activation, x)
    x = graph.add_dense(x, "output", actor.layers[-1])
    if actor.output == "Tanh":
        x = graph.add("Tanh", x)
    else:
        x = graph.add("Min", x, one=torch.ones(()))
        x = graph.add("Max", x, minus_one=-torch.ones(()))
    x = graph.add("Mul", x, scale=actor.action_scale)
    x = graph.add("Min", x, high=actor.action_high)
    graph.add("Max", x, output=OUTPUT_NAME, low=actor.action_low)
    proto = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "viewpoint_policy",
            [_tensor(INPUT_NAME, len(actor.normalizer.centre))],
            [_tensor(OUTPUT_NAME, len(actor.action_scale))],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="maniskill-tomato",
        producer_version=maniskill_tomato.__version__,
        doc_string=f"Viewpoint policy of {actor.env_id}; its layout and units are in the JSON file beside it.",
    )
    onnx.checker.check_model(proto, full_check=True)
    content: bytes = proto.SerializeToString(deterministic=True)
    return content


def describe_policy(actor: DenseActor, model: bytes) -> PolicyDescription:
    """The description of a policy and its ONNX file."""
    make_task = _TASKS.get(actor.env_id)
    task = make_task() if make_task else None
    config = json.dumps(actor.config, sort_keys=True)
    layout = layout_of(actor.env_id)
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
    )


def parity_observations(actor: DenseActor, count: int = 1000, seed: int = 0) -> NDArray[np.float32]:
    """Observations on which an export is compared with PyTorch.

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


def rounding_tolerance(actor: DenseActor, observations: NDArray[np.float32]) -> NDArray[np.float64]:
    """How far two float32 evaluations of an actor may differ: PyTorch's and ONNX Runtime's on any processor.

    Processors sum a layer's products in different orders, and an actor with large weights multiplies the rounding
    of its first layers. A fixed tolerance therefore either refuses correct exports of such actors on some machine or
    accepts wrong weights of all others. Here the error is carried through the layers in float64: a sum of n products
    rounds by about sqrt(n) units of the sum of their sizes (Higham and Mary, 2019), a layer multiplies the error of
    its input by the sizes of its weights, and an activation changes it as it changes the ends of the interval.

    Args:
        actor: The policy.
        observations: World frame, in [m] and [rad]. Shape (B, D).

    Returns:
        In the task's units. Shape (B, A).
    """
    functions: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "Relu": torch.relu,
        "Tanh": torch.tanh,
        "Clip": lambda z: z.clamp(-1.0, 1.0),
    }
    activations = [actor.activation] * (len(actor.layers) - 1) + [actor.output]
    unit = FLOAT32_UNIT_ROUNDOFF
    x = (
        torch.from_numpy(observations).double() - actor.normalizer.centre.cpu().double()
    ) / actor.normalizer.half_range.cpu().double()
    error = 2.0 * unit * x.abs()
    layers: Sequence[Any] = actor.layers  # To mypy a module's weight may be a module.
    for layer, activation in zip(layers, activations, strict=True):
        weight, bias = (p.detach().cpu().double() for p in (layer.weight, layer.bias))
        terms = x.abs() @ weight.abs().T + bias.abs()
        error = error @ weight.abs().T + unit * (weight.shape[1] + 1) ** 0.5 * terms
        z, function = x @ weight.T + bias, functions[activation]
        x = function(z)
        # The last term is for the activation itself, which libraries approximate to a few units.
        error = torch.maximum(function(z + error) - x, x - function(z - error)) + 4.0 * unit * x.abs()
    scale = actor.action_scale.cpu().double().abs()
    tolerance: NDArray[np.float64] = (2.0 * (error + unit * x.abs()) * scale).numpy()
    return tolerance


def _check_layout(path: Path) -> None:
    """Refuses a policy that observes or does something else than the descriptions say."""
    data = load_checkpoint(path)
    layout = layout_of(data["env_id"])
    for what, names in (("observation", layout.observation_names), ("action", layout.action_names)):
        if list(data[what]["names"]) != list(names):
            raise PolicyError(
                f"{path} cannot be exported: its {what} is {shortened(list(data[what]['names']))}; this version's is "
                f"{shortened(list(names))}"
            )


class _Graph:
    """Nodes in a row, each with one output, and their constants."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def add(self, operator: str, x: str, output: str | None = None, **constants: Any) -> str:
        """Appends a node that takes `x` and the constants; returns the name of its output."""
        output = output or f"{operator.lower()}_{len(self.nodes)}"
        self._append(operator, x, output, constants)
        return output

    def add_dense(self, x: str, name: str, layer: Any) -> str:
        """Appends x W^T + b; returns the name of its output."""
        weights = {f"{name}.weight": layer.weight, f"{name}.bias": layer.bias}
        self._append("Gemm", x, name, weights, transB=1)
        return name

    def _append(
        self, operator: str, x: str, output: str, constants: dict[str, Any], **attributes: Any
    ) -> None:
        for name, tensor in constants.items():
            values = tensor.detach().cpu().numpy().astype(np.float32)
            self.constants.append(numpy_helper.from_array(values, name))
        self.nodes.append(helper.make_node(operator, [x, *constants], [output], name=output, **attributes))


def _tensor(name: str, width: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", width])


def _shortest(values: torch.Tensor) -> tuple[float, ...]:
    """Float32 values as the shortest decimals that give them back: 0.35, not 0.3499999940395355."""
    return tuple(float(str(value)) for value in values.cpu().numpy().astype(np.float32))
