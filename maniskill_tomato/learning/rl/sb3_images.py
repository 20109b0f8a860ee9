"""The package's image encoder for Stable-Baselines3, whose own one sees 8-bit colours only; needs the extra `sb3`."""

import gymnasium as gym
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError, MissingPackageError
from maniskill_tomato.policies.image_encoder import ImageEncoder
from maniskill_tomato.sensing.image_layout import CHANNELS, ImageLayout
from maniskill_tomato.sensing.image_observation import STATE
from maniskill_tomato.sensing.perception_kinds import ImageKind

try:
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
except ImportError as error:
    raise MissingPackageError.extra("stable-baselines3", "sb3") from error


class ImageFeatures(BaseFeaturesExtractor):  # type: ignore[misc]
    """State and features of the images, for the `MultiInputPolicy` of any of its algorithms.

    Give `policy_kwargs={"features_extractor_class": ImageFeatures, "normalize_images": False}`: the encoder scales
    images itself.
    """

    def __init__(self, observation_space: gym.Space[dict[str, object]], features: int = 64) -> None:
        """Builds the encoder.

        Args:
            observation_space: Of `gymnasium_env.make_gymnasium_env` with images.
            features: Numbers that the encoder makes of the images.

        Raises:
            InvalidInputError: It is another space.
        """
        spaces = observation_space.spaces if isinstance(observation_space, gym.spaces.Dict) else {}
        kinds: tuple[ImageKind, ...] = tuple(kind for kind in CHANNELS if kind in spaces)
        if STATE not in spaces or not kinds:
            raise InvalidInputError(
                f"ImageFeatures needs a dictionary of state and images, such as make_gymnasium_env(..., "
                f"obs_mode='depth+segmentation') gives; got {observation_space}"
            )
        shapes = {kind: _rows_first(spaces[kind].shape or ()) for kind in kinds}
        rows, columns, channels = shapes[kinds[0]]
        size = (spaces[STATE].shape or (0,))[0]
        super().__init__(observation_space, size + features)
        layout = ImageLayout(kinds=kinds, width=columns, height=rows)
        self.encoder = ImageEncoder(layout, channels // CHANNELS[kinds[0]], features)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Shape (B, D + features)."""
        images = {}
        for kind in self.encoder.layout.kinds:
            image = observations[kind]
            # Stable-Baselines3 puts the channels of 8-bit colours first.
            images[kind] = image.permute(0, 2, 3, 1) if image.shape[1:] != self._shape(kind) else image
        return torch.cat((observations[STATE], self.encoder(images)), dim=-1)

    def _shape(self, kind: ImageKind) -> tuple[int, ...]:
        layout = self.encoder.layout
        return (layout.height, layout.width, CHANNELS[kind] * self.encoder.frames)


def _rows_first(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Rows, columns, channels of an image whose channels may come first."""
    return (shape[1], shape[2], shape[0]) if shape[0] < min(shape[1:]) else shape
