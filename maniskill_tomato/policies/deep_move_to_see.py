"""Deep 3D Move To See: a network that regresses the direction of 3D Move To See from a single view.

Zapotezny-Anderson and Lehnert, "Towards Active Robotic Vision in Agriculture: A Deep Learning Approach to Visual
Servoing in Occluded and Unstructured Protected Cropping Environments", arXiv 1908.01885: a ResNet-18 is fine-tuned by
the squared error on the gradient that the camera array of 3D Move To See measured in simulation, so that one camera
does on the robot what nine did before.

Deviations:

- It sees the 16x16 target-centred rays of `ViewRays`, what the robot's camera gives to every policy here, not an RGB
  image of 224x224; a small convolutional network replaces ResNet-18.
- It regresses the move, the gradient times step size cut to a full move, because gradients span decades and the
  squared error would see only the largest.
"""

from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn

from maniskill_tomato.policies.moves import shortened
from maniskill_tomato.policies.network_file import load_network, save_network
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.raycast.view_rays import RAYS_PER_SIDE, RayLabel, ViewRays
from maniskill_tomato.sensing.belief import Belief

CHANNELS = 4
"""Target seen, something else seen, free, and how far in front of the target it is."""
DEPTH_SCALE = 0.3
"""Distance in front of the target that counts as one, in [m]."""

FORMAT: Final = "deep-3dmts-1"


class MoveNetwork(nn.Module):
    """Rays of one view to a move."""

    def __init__(self) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            nn.Conv2d(CHANNELS, 16, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(16, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        self.head = nn.Sequential(nn.Linear(32 * 16 + 1, 64), nn.ReLU(), nn.Linear(64, 3))

    def forward(self, pictures: Tensor, distance: Tensor) -> Tensor:
        """Moves of shape (B, 3), not cut to the length of a full one."""
        features = torch.cat([self.convolutions(pictures), distance[:, None]], dim=1)
        moves: Tensor = self.head(features)
        return moves


def view_picture(rays: ViewRays, distance: Tensor) -> Tensor:
    """The rays as a picture of four channels.

    Args:
        rays: One view per environment.
        distance: Camera to target, in [m]. Shape (B,).

    Returns:
        Shape (B, 4, 16, 16).
    """
    label = rays.label
    is_other = label == int(RayLabel.OTHER)
    in_front = ((distance[:, None] - rays.distance) / DEPTH_SCALE).clamp(-1.0, 1.0)
    channels = [
        (label == int(RayLabel.TARGET)).float(),
        is_other.float(),
        (label == int(RayLabel.FREE)).float(),
        torch.where(is_other, in_front, torch.zeros_like(in_front)),
    ]
    return torch.stack(channels, dim=1).view(-1, CHANNELS, RAYS_PER_SIDE, RAYS_PER_SIDE)


class DeepMoveToSee(Planner):
    """Moves as the network says."""

    name = "deep_3dmts"

    def __init__(self, network: MoveNetwork) -> None:
        self.network = network.eval().requires_grad_(False)

    def act(self, belief: Belief) -> Tensor:
        """The network's move, cut to a full one."""
        with torch.no_grad():
            move: Tensor = self.network(*network_input(belief))
        return shortened(move)


def network_input(belief: Belief) -> tuple[Tensor, Tensor]:
    """Picture and distance of the present views. Shapes (B, 4, 16, 16) and (B,)."""
    distance = (belief.target_position - belief.camera_position).norm(dim=-1)
    return view_picture(belief.rays, distance), distance


def save_deep_move_to_see(path: Path, policy: DeepMoveToSee) -> None:
    """Writes the network."""
    save_network(path, FORMAT, {}, policy.network.state_dict())


def load_deep_move_to_see(path: Path, device: str | torch.device = "cpu") -> DeepMoveToSee:
    """Reads what `save_deep_move_to_see` wrote.

    Raises:
        CheckpointError: The file is missing, damaged, or of something else.
    """

    def build(data: dict[str, Any]) -> tuple[DeepMoveToSee, MoveNetwork]:
        network = MoveNetwork()
        return DeepMoveToSee(network), network

    return load_network(
        path, FORMAT, device, build, "network of deep_3dmts; `maniskill-tomato train-deep-3dmts` makes one"
    )
