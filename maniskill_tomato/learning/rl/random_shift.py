"""Random shifts of images, the augmentation of DrQ (Kostrikov et al., 2020; Yarats et al., 2021)."""

from collections.abc import Mapping

import torch
from torch import Tensor


def shifted(
    images: Mapping[str, Tensor], most: int, generator: torch.Generator | None = None
) -> dict[str, Tensor]:
    """Images moved by whole pixels; what comes in at an edge repeats the edge's pixels.

    All images of a view are moved alike.

    Args:
        images: By kind, each of shape (B, H, W, C).
        most: The most that they are moved in each direction, in [px]; 0 leaves them as they are.
        generator: Of the random numbers.
    """
    if most == 0 or not images:
        return dict(images)
    any_image = next(iter(images.values()))
    batch, height, width = any_image.shape[:3]
    device = any_image.device
    moves = torch.randint(-most, most + 1, (2, batch, 1), generator=generator, device=device)
    rows = (torch.arange(height, device=device) + moves[0]).clamp_(0, height - 1)
    columns = (torch.arange(width, device=device) + moves[1]).clamp_(0, width - 1)
    index = torch.arange(batch, device=device)[:, None, None], rows[:, :, None], columns[:, None, :]
    return {kind: image[index] for kind, image in images.items()}
