"""From the images of an observation to features: the eye that actor and critics share."""

from collections.abc import Mapping
from typing import Final

import torch
from torch import Tensor, nn

from maniskill_tomato.plants.organs import Role
from maniskill_tomato.sensing.image_layout import CHANNELS, ImageLayout
from maniskill_tomato.sensing.perception_kinds import ImageKind

DEPTH_SCALE_MM: Final = 1000.0
"""Depths are told in this unit, at most `FARTHEST` of it."""
FARTHEST: Final = 2.0

CONVOLUTIONS: Final = ((32, 4, 4), (32, 3, 2), (32, 3, 1))
"""Channels, side and stride of each. DrQ-v2 (Yarats et al., 2021) has four layers of 32 channels whose first has
stride 2; with patches of 4 x 4 pixels first, a batch takes a fifth of the time on a processor core."""


class ImageEncoder(nn.Module):
    """Convolutions, then one linear layer with layer normalisation and tanh, as the trunk of DrQ-v2."""

    def __init__(self, layout: ImageLayout, frames: int = 1, features: int = 64) -> None:
        """Builds the layers.

        Args:
            layout: Of the images.
            frames: Views in each image, channel behind channel.
            features: Numbers that come out.
        """
        super().__init__()
        self.layout = layout
        self.frames = frames
        channels = sum(_planes(kind) for kind in layout.kinds) * frames
        layers: list[nn.Module] = []
        for width, side, stride in CONVOLUTIONS:
            layers += [nn.Conv2d(channels, width, side, stride), nn.ReLU()]
            channels = width
        self.convolutions = nn.Sequential(*layers)
        for layer in self.convolutions:
            if isinstance(layer, nn.Conv2d):
                nn.init.orthogonal_(layer.weight, nn.init.calculate_gain("relu"))
                nn.init.zeros_(layer.bias) if layer.bias is not None else None
        with torch.no_grad():
            blank = torch.zeros(1, self.planes, layout.height, layout.width)
            length = self.convolutions(blank).numel()
        self.trunk = nn.Linear(length, features)
        nn.init.orthogonal_(self.trunk.weight)
        nn.init.zeros_(self.trunk.bias)
        self.norm = nn.LayerNorm(features)

    @property
    def features(self) -> int:
        """Numbers that come out."""
        return self.trunk.out_features

    @property
    def planes(self) -> int:
        """Channels that the first convolution sees."""
        return sum(_planes(kind) for kind in self.layout.kinds) * self.frames

    def forward(self, images: Mapping[str, Tensor]) -> Tensor:
        """Features of images by kind, as `ImageLayout` has them, each of shape (B, H, W, C).

        Returns:
            Within (-1, 1). Shape (B, features).
        """
        x: Tensor = self.convolutions(self.scaled(images))
        x = self.norm(self.trunk(x.flatten(1)))
        return torch.tanh(x)

    def scaled(self, images: Mapping[str, Tensor]) -> Tensor:
        """All images as planes of about -1 to 1: colours, depth in metres, one plane a role. Shape (B, C, H, W)."""
        planes = []
        for kind in self.layout.kinds:
            image = images[kind].permute(0, 3, 1, 2)
            if kind == "rgb":
                planes.append(image.float() / 127.5 - 1.0)
            elif kind == "depth":
                planes.append((image.float() / DEPTH_SCALE_MM).clamp(max=FARTHEST) - 1.0)
            else:
                roles = torch.arange(len(Role), dtype=torch.uint8, device=image.device)
                one_hot = image[:, :, None] == roles[:, None, None]
                planes.append(one_hot.flatten(1, 2).float())
        return torch.cat(planes, dim=1)


def _planes(kind: ImageKind) -> int:
    """Planes of one view of a kind of image."""
    return len(Role) if kind == "segmentation" else CHANNELS[kind]
