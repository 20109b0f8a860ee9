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
from collections.abc import Callable
from dataclasses import dataclass
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


@dataclass(frozen=True, eq=False)
class MoveToSeeData:
    """Views and the moves that 3D Move To See made from them."""

    pictures: Tensor
    """As `view_picture` gives them. Shape (N, 4, 16, 16)."""
    distance: Tensor
    """Camera to target, in [m]. Shape (N,)."""
    moves: Tensor
    """(right, up, forward) as shares of a full move. Shape (N, 3)."""


@dataclass(frozen=True, kw_only=True)
class RegressionConfig:
    """How the network is trained."""

    epochs: int = 15
    """Passes over the data; theirs: 50."""
    batch_size: int = 64
    """As theirs."""
    learning_rate: float = 1e-3
    """Of Adam; theirs fine-tune by SGD with momentum at 1e-5."""
    validation_share: float = 0.1
    """Share of the data, its last part, by whose loss the epoch is chosen."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("epochs", "batch_size"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0.0 < self.validation_share < 1.0:
            raise InvalidInputError(f"validation_share must lie in (0, 1), got {self.validation_share}")
        if not self.learning_rate > 0.0:
            raise InvalidInputError(f"learning_rate must be positive, got {self.learning_rate}")


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


def train_move_network(
    data: MoveToSeeData,
    config: RegressionConfig | None = None,
    report: Callable[[int, float, float], None] = lambda epoch, loss, validation: None,
) -> MoveNetwork:
    """Fits the network to the moves by their squared error, and keeps the epoch with the lowest validation loss.

    Args:
        data: From `scripts/train_deep_move_to_see.py`, in the order of the episodes.
        config: How to train.
        report: Told the epoch, its mean loss and the validation loss.

    Raises:
        InvalidInputError: There are too few views.
    """
    config = config or RegressionConfig()
    count = len(data.moves)
    held_back = int(count * config.validation_share)
    if held_back < 1 or count - held_back < config.batch_size:
        raise InvalidInputError(f"{count} views are too few for batches of {config.batch_size}")
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = MoveNetwork()
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    last = count - held_back
    best, weights = float("inf"), network.state_dict()
    for epoch in range(config.epochs):
        losses = []
        for rows in torch.split(torch.randperm(last, generator=generator), config.batch_size):
            loss = _loss(network, data, rows)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            losses.append(float(loss.detach()))
        with torch.no_grad():
            validation = float(_loss(network, data, torch.arange(last, count)))
        if validation < best:
            best = validation
            weights = {name: value.clone() for name, value in network.state_dict().items()}
        report(epoch, sum(losses) / len(losses), validation)
    network.load_state_dict(weights)
    return network.eval().requires_grad_(False)


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
            f"{path} is no network of Deep 3D Move To See: {error}; train one with scripts/train_deep_move_to_see.py"
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
                "no network of deep_3dmts ships with this version; train one with scripts/train_deep_move_to_see.py "
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


def _loss(network: MoveNetwork, data: MoveToSeeData, rows: Tensor) -> Tensor:
    moves = network(data.pictures[rows], data.distance[rows])
    return nn.functional.mse_loss(moves, data.moves[rows])
