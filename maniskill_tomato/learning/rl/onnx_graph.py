"""The ONNX file of a policy, written node by node."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

import maniskill_tomato
from maniskill_tomato.learning.rl.dense_actor import DenseActor
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.policies.description import INPUT_NAME, OUTPUT_NAME
from maniskill_tomato.policies.image_encoder import DEPTH_SCALE_MM, FARTHEST, ImageEncoder
from maniskill_tomato.sensing.image_layout import Sight

OPSET = 17
"""Version of the operators; an old one on purpose, so that old runtimes read the file too."""

IR_VERSION = 8
"""Version of the file format, the one of that time."""


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
