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

import io
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.raycast.view_rays import RAYS_PER_SIDE, RayLabel, ViewRays
from maniskill_tomato.sensing.belief import Belief

CHANNELS = 4
"""Target seen, something else seen, free, and how far in front of the target it is."""
DEPTH_SCALE = 0.3
"""Distance in front of the target that counts as one, in [m]."""

FORMAT = 1


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


def save_move_network(network: MoveNetwork, path: Path) -> None:
    """Writes the weights in one step."""
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, "weights": network.state_dict()}, buffer)
    write_atomically(path, buffer.getvalue())


def load_move_network(path: Path, device: str | torch.device = "cpu") -> MoveNetwork:
    """Reads the weights.

    Raises:
        CheckpointError: The file is missing, damaged or something else.
    """
    try:
        content = cast(dict[str, Any], torch.load(path, map_location=device, weights_only=True))
        if content["format"] != FORMAT:
            raise CheckpointError(f"{path} has format {content['format']}, this version reads {FORMAT}")
        network = MoveNetwork().to(device)
        network.load_state_dict(content["weights"])
    except CheckpointError:
        raise
    except Exception as error:
        raise CheckpointError(
            f"{path} is no network of Deep 3D Move To See: {error}; train one with `maniskill-tomato train-deep-3dmts`"
        ) from error
    return network.eval().requires_grad_(False)


class DeepMoveToSee(Planner):
    """Moves as the network says."""

    name = "deep_3dmts"

    def __init__(self, network: MoveNetwork) -> None:
        self._network = network

    @classmethod
    def shipped(cls, device: str | torch.device = "cpu") -> "DeepMoveToSee":
        """With the network that ships with the package.

        Raises:
            InvalidInputError: None ships with this version.
        """
        from maniskill_tomato.assets import asset_path

        try:
            path = asset_path("policies/deep_3dmts.pt")
        except FileNotFoundError as error:
            raise InvalidInputError(
                "no network of deep_3dmts ships with this version; train one with `maniskill-tomato train-deep-3dmts` "
                "and give its file as deep_3dmts=FILE"
            ) from error
        return cls(load_move_network(path, device))

    def act(self, belief: Belief) -> Tensor:
        """The network's move, cut to a full one."""
        with torch.no_grad():
            move: Tensor = self._network(*network_input(belief))
        shortened: Tensor = move / move.norm(dim=-1, keepdim=True).clamp_min(1.0)
        return shortened


def network_input(belief: Belief) -> tuple[Tensor, Tensor]:
    """Picture and distance of the present views. Shapes (B, 4, 16, 16) and (B,)."""
    distance = (belief.target_position - belief.camera_position).norm(dim=-1)
    return view_picture(belief.rays, distance), distance
