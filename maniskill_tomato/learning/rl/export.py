"""A trained policy as an ONNX file and a description, for machines without PyTorch and ManiSkill.

The actor is a chain of a few dense layers, after a few convolutions if it sees images. Its graph is therefore written
node by node with the `onnx` package rather than traced by `torch.onnx`: that would add onnxscript and an intermediate
representation to the dependencies, and its output changes with their versions. Here the same policy gives the same
bytes. An actor that this module does not know completely is caught before anything is written, because every export is
compared with PyTorch.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
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
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.policies.actor import ObservationNormalizer
from maniskill_tomato.policies.description import (
    INPUT_NAME,
    OUTPUT_NAME,
    ActionComponent,
    Component,
    PolicyDescription,
    shortened,
)
from maniskill_tomato.policies.image_encoder import DEPTH_SCALE_MM, FARTHEST, ImageEncoder
from maniskill_tomato.policies.layout import layout_of, unknown_task
from maniskill_tomato.policies.onnx_policy import OnnxPolicy, description_path
from maniskill_tomato.policies.trained_actor import load_actor, load_checkpoint, sight_of
from maniskill_tomato.sensing.image_layout import Sight
from maniskill_tomato.sensing.image_observation import STATE
from maniskill_tomato.task_registry import THESIS_IDS, base_of
from maniskill_tomato.tasks.making import make_options

OPSET = 17
"""Version of the operators; an old one on purpose, so that old runtimes read the file too."""

IR_VERSION = 8
"""Version of the file format, the one of that time."""

FLOAT32_UNIT_ROUNDOFF = 2.0**-24
"""Largest relative error of one rounding to float32."""

ROUNDING_SIGMAS = 10.0
"""Standard deviations of independent roundings that an encoder's features may differ by."""


@dataclass(frozen=True, kw_only=True)
class DenseActor:
    """A policy in the parts that its graph is written from; this package's own and those of other learners."""

    act: Callable[[Any], torch.Tensor]
    """What the export is compared with: actions of shape (B, A) for observations of shape (B, D), or with images."""
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
    encoder: ImageEncoder | None = None
    """What turns images into features, which join the normalised observations; None without images."""
    sight: Sight | None = None
    """The images that it observes; None if it observes none."""


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


def make_model(actor: DenseActor) -> bytes:
    """The ONNX file of a policy: observations in [m] and [rad] in, and images; actions in [m] and [rad] out."""
    graph = _Graph()
    x = graph.add("Sub", INPUT_NAME, centre=actor.normalizer.centre)
    x = graph.add("Div", x, half_range=actor.normalizer.half_range)
    inputs = [_tensor(INPUT_NAME, len(actor.normalizer.centre))]
    if actor.encoder is not None and actor.sight is not None:
        for kind, shape in actor.sight.shapes.items():
            inputs.append(helper.make_tensor_value_info(kind, _TYPES[kind], ["batch", *shape]))
        x = graph.join([x, _add_encoder(graph, actor.encoder, actor.sight)], axis=1)
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
            inputs,
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


_TYPES = {"rgb": TensorProto.UINT8, "depth": TensorProto.INT16, "segmentation": TensorProto.UINT8}
"""ONNX types of the images."""


def _add_encoder(graph: "_Graph", encoder: ImageEncoder, sight: Sight) -> str:
    """Appends the encoder's nodes, which do what `ImageEncoder.forward` does; returns the name of the features."""
    planes = []
    for kind in sight.images.kinds:
        x = graph.node("Transpose", [kind], perm=[0, 3, 1, 2])
        if kind == "segmentation":
            x = graph.node("Cast", [x], to=TensorProto.INT64)
            count = graph.constant(f"{kind}.roles", np.array([len(Role)], np.int64))
            ends = graph.constant(f"{kind}.off_on", np.array([0.0, 1.0], np.float32))
            x = graph.node("OneHot", [x, count, ends], axis=2)
            rows, columns, frames = sight.shapes[kind]
            shape = np.array([0, frames * len(Role), rows, columns], np.int64)
            x = graph.node("Reshape", [x, graph.constant(f"{kind}.shape", shape)])
        else:
            x = graph.node("Cast", [x], to=TensorProto.FLOAT)
            if kind == "rgb":
                x = graph.add("Div", x, rgb_half=torch.tensor(127.5))
            else:
                x = graph.add("Div", x, depth_scale=torch.tensor(DEPTH_SCALE_MM))
                x = graph.add("Min", x, depth_farthest=torch.tensor(FARTHEST))
            x = graph.node("Sub", [x, graph.constant(f"{kind}_one", torch.ones(()))])
        planes.append(x)
    x = graph.join(planes, axis=1)
    for index, layer in enumerate(layer for layer in encoder.convolutions if isinstance(layer, nn.Conv2d)):
        weights = {f"convolution_{index}.weight": layer.weight, f"convolution_{index}.bias": layer.bias}
        names = [graph.constant(name, values) for name, values in weights.items()]
        x = graph.node("Conv", [x, *names], strides=list(layer.stride))
        x = graph.node("Relu", [x])
    x = graph.node("Flatten", [x], axis=1)
    x = graph.add_dense(x, "trunk", encoder.trunk)
    norm = [
        graph.constant("norm.weight", encoder.norm.weight),
        graph.constant("norm.bias", encoder.norm.bias),
    ]
    x = graph.node("LayerNormalization", [x, *norm], axis=-1, epsilon=encoder.norm.eps)
    return graph.node("Tanh", [x])


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


def rounding_tolerance(
    actor: DenseActor, observations: NDArray[np.float32], images: Mapping[str, NDArray[Any]] | None = None
) -> NDArray[np.float64]:
    """How far two float32 evaluations of an actor may differ: PyTorch's and ONNX Runtime's on any processor.

    Processors sum a layer's products in different orders, and an actor with large weights multiplies the rounding
    of its first layers. A fixed tolerance therefore either refuses correct exports of such actors on some machine or
    accepts wrong weights of all others. Here the error is carried through the layers in float64: a sum of n products
    rounds by about sqrt(n) units of the sum of their sizes (Higham and Mary, 2019), a layer multiplies the error of
    its input by the sizes of its weights, and an activation changes it as it changes the ends of the interval.

    Args:
        actor: The policy.
        observations: World frame, in [m] and [rad]. Shape (B, D).
        images: Those that it sees beside them, by kind, each of shape (B, H, W, C).

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
    if actor.encoder is not None:
        features, feature_error = _encoder_errors(actor.encoder, images or {})
        x, error = torch.cat((x, features), dim=-1), torch.cat((error, feature_error), dim=-1)
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


def _encoder_errors(
    encoder: ImageEncoder, images: Mapping[str, NDArray[Any]]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Features of images in float64, and how far two float32 evaluations of them may differ. Each (B, features).

    Through many layers the bound by sizes grows without end, so independent roundings are added as variances here, and
    `ROUNDING_SIGMAS` standard deviations are allowed.
    """
    unit, conv = FLOAT32_UNIT_ROUNDOFF, torch.nn.functional.conv2d
    with torch.no_grad():
        x = encoder.scaled({kind: torch.from_numpy(image) for kind, image in images.items()}).double()
        variance = (2.0 * unit * x).square()
        for layer in encoder.convolutions:
            if not isinstance(layer, nn.Conv2d):
                continue
            assert layer.bias is not None
            weight, bias, stride = layer.weight.double(), layer.bias.double(), layer.stride
            products = weight[0].numel()
            spread = variance + products * (unit * x).square()
            variance = conv(spread, weight.square(), (unit * bias).square(), stride)
            x = conv(x, weight, bias, stride).relu()
        x, variance = x.flatten(1), variance.flatten(1)
        weight, bias = encoder.trunk.weight.double(), encoder.trunk.bias.double()
        variance = (variance + weight.shape[1] * (unit * x).square()) @ weight.square().T
        x = x @ weight.T + bias
        # The derivative of z = (x - mean) / scale is (dx - mean(dx) - z mean(z dx)) / scale.
        scale = (x.var(dim=-1, unbiased=False, keepdim=True) + encoder.norm.eps).sqrt()
        z = (x - x.mean(dim=-1, keepdim=True)) / scale
        error = ROUNDING_SIGMAS * variance.sqrt()
        error = (
            error + error.mean(-1, keepdim=True) + z.abs() * (z.abs() * error).mean(-1, keepdim=True)
        ) / scale
        error = error + 8.0 * unit * (z.abs() + x.abs().amax(dim=-1, keepdim=True) / scale)
        gain = encoder.norm.weight.double()
        x, error = z * gain + encoder.norm.bias.double(), error * gain.abs() + 2.0 * unit * z.abs()
        ends = torch.maximum(torch.tanh(x + error) - torch.tanh(x), torch.tanh(x) - torch.tanh(x - error))
        return torch.tanh(x), ends + 4.0 * unit


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

    def node(self, operator: str, inputs: Sequence[str], **attributes: Any) -> str:
        """Appends a node of any inputs; returns the name of its output."""
        output = f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output], name=output, **attributes))
        return output

    def join(self, parts: Sequence[str], axis: int) -> str:
        """Appends what puts several outputs one behind the other; the name of the whole."""
        return parts[0] if len(parts) == 1 else self.node("Concat", parts, axis=axis)

    def constant(self, name: str, values: Any) -> str:
        """Adds a constant; returns its name."""
        array = values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else values
        self.constants.append(numpy_helper.from_array(array, name))
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
