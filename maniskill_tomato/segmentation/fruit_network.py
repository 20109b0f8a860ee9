"""The light network: one pass says where fruits are centred, how large they are and which pixels are theirs.

Detection follows TTFNet (Liu et al., 2020, Training-Time-Friendly Network for Real-Time Object Detection): a heat
map of centres and, at each place, the distances to the sides of the box. Masks follow the centre votes of
Panoptic-DeepLab (Cheng et al., 2020): a map of fruit pixels and, at each, the way to the centre of its fruit. Both
are dense targets, which a small network learns on a CPU. What is added: the box of the whole fruit.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from maniskill_tomato.segmentation.detector_configs import FruitNetworkConfig
from maniskill_tomato.segmentation.efficientnet_lite import FEATURE_WIDTHS, EfficientNetLite0

STRIDE = 2
"""Pixels of the image between neighbouring places of the output."""

BOX_SCALE = 16.0
"""Distances to the sides of a box are learned in this many [px]."""

SIZE_MULTIPLE = 32
"""Height and width of the input must be multiples of this, in [px]."""


class FruitMaps(NamedTuple):
    """The network's output at every place; places are `STRIDE` pixels apart, h = H / STRIDE, w = W / STRIDE."""

    centre: Tensor
    """Logit that a fruit is centred here. Shape (B, 1, h, w)."""
    box: Tensor
    """Distances to the left, top, right and bottom of the visible box, at least 0, in [px]. Shape (B, 4, h, w)."""
    whole: Tensor
    """The same for the whole fruit, which may be negative. Shape (B, 4, h, w)."""
    category: Tensor
    """Logits of the kinds of fruit. Shape (B, C, h, w)."""
    fruit: Tensor
    """Logit that this is a fruit's visible pixel. Shape (B, 1, h, w)."""
    vote: Tensor
    """Offset right and down to the centre of the visible box of its fruit, in [px]. Shape (B, 2, h, w)."""


def _conv(inputs: int, outputs: int) -> nn.Sequential:
    """Convolution, batch normalisation, rectifier."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def _unshuffled(image: Tensor) -> Tensor:
    """Colours from 0 to 255, (B, 3, H, W), as (B, 12, H / 2, W / 2): what a place of stride 2 holds."""
    x = functional.pixel_unshuffle((image - 110.0) / 64.0, 2)
    return x.contiguous(memory_format=torch.channels_last)


class FruitNetwork(nn.Module):
    """Image to `FruitMaps`."""

    def __init__(self, config: FruitNetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config or FruitNetworkConfig()
        neck = self.config.neck_width
        self.backbone = EfficientNetLite0()
        self.laterals = nn.ModuleList(nn.Conv2d(width, neck, 1) for width in FEATURE_WIDTHS)
        self.smooths = nn.ModuleList(_conv(neck, neck) for _ in FEATURE_WIDTHS[:-1])
        self.context = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Conv2d(FEATURE_WIDTHS[-1], neck, 1))
        fine = self.config.fine_width
        self.fine = _conv(12, fine)
        self.coarse = nn.Conv2d(neck, fine, 1)
        self.head = nn.Sequential(_conv(fine, fine), _conv(fine, fine))
        self.sizes = (1, 4, 4, self.config.categories, 1, 2)
        self.output = nn.Conv2d(fine, sum(self.sizes), 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        nn.init.normal_(self.output.weight, std=0.01)
        bias = self.output.bias
        assert bias is not None
        with torch.no_grad():
            bias.zero_()
            bias[0] = -4.0  # Centres are rare: a start at their frequency keeps the first steps calm.
            bias[1:5] = 1.0
            bias[5:9] = 1.0
            bias[9 + self.config.categories] = -2.0

    def forward(self, image: Tensor) -> FruitMaps:
        """The maps for images.

        Args:
            image: Red, green, blue from 0 to 255, as floats. Height and width are multiples of `SIZE_MULTIPLE`.
                Shape (B, 3, H, W).
        """
        features = self.backbone(image)
        y = self.laterals[-1](features[-1]) + self.context(features[-1])
        for i in (2, 1, 0):
            y = functional.interpolate(y, scale_factor=2.0, mode="nearest")
            y = self.smooths[i](y + self.laterals[i](features[i]))
        y = functional.interpolate(self.coarse(y), scale_factor=2.0, mode="nearest")
        output = self.output(self.head(y + self.fine(_unshuffled(image)))).float()
        centre, box, whole, category, fruit, vote = output.split(self.sizes, dim=1)
        return FruitMaps(
            centre,
            functional.relu(box) * BOX_SCALE,
            whole * BOX_SCALE,
            category,
            fruit,
            vote * BOX_SCALE,
        )


def place_centres(height: int, width: int, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Where the places of an output of `height` x `width` lie in the image, x and y in [px]. Each of shape (h, w)."""
    y = (torch.arange(height, device=device, dtype=torch.float32) + 0.5) * STRIDE
    x = (torch.arange(width, device=device, dtype=torch.float32) + 0.5) * STRIDE
    return x.expand(height, width), y[:, None].expand(height, width)
