"""Which environments ManiSkill's setters write to."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from mani_skill.envs.scene import ManiSkillScene
from torch import Tensor


@contextmanager
def only(scene: ManiSkillScene, env_idx: Tensor | None) -> Iterator[None]:
    """Within it, setters of actors and articulations write to these environments alone.

    Args:
        scene: The scene.
        env_idx: Indices of environments, None for all. Shape (b,).
    """
    before = scene._reset_mask
    mask = torch.ones_like(before)
    if env_idx is not None:
        mask = torch.zeros_like(before)
        mask[env_idx] = True
    scene._reset_mask = mask
    try:
        yield
    finally:
        scene._reset_mask = before
