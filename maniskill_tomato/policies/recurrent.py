"""A recurrent policy: what it has seen is kept by a network instead of a map."""

from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import PackedSequence

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.network_file import load_network, save_network
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.observation import ObservationLayout
from maniskill_tomato.sensing.perception_kinds import Part

FORMAT: Final = "recurrent-1"


class RecurrentActor(nn.Module):
    """A hidden ReLU layer, a GRU (Cho et al., 2014), and tanh."""

    def __init__(self, observation_dim: int, width: int = 256) -> None:
        super().__init__()
        self.sizes = {"observation_dim": observation_dim, "width": width}
        self.entry = nn.Linear(observation_dim, width)
        self.memory = nn.GRU(width, width, batch_first=True)
        self.exit = nn.Linear(width, 3)

    def forward(self, observations: PackedSequence) -> PackedSequence:
        """Moves for packed sequences of observations."""
        entered = observations._replace(data=torch.relu(self.entry(observations.data)))
        remembered, _ = self.memory(entered)
        moves: PackedSequence = remembered._replace(data=torch.tanh(self.exit(remembered.data)))
        return moves

    def step(self, observations: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """One move and the next state, from observations (B, D) and a state (1, B, width)."""
        remembered, state = self.memory(torch.relu(self.entry(observations))[:, None], state)
        return torch.tanh(self.exit(remembered[:, 0])), state


class RecurrentPolicy(Planner):
    """Moves as a recurrent actor says, from parts of the observation."""

    name = "recurrent"

    def __init__(
        self, actor: RecurrentActor, parts: tuple[Part, ...], facts: dict[str, Any] | None = None
    ) -> None:
        """Keeps the actor.

        Args:
            actor: Decides.
            parts: What it sees of the task's default observation, in that order.
            facts: Numbers and strings about its training.

        Raises:
            InvalidInputError: The parts have another length than its input.
        """
        self.columns = columns_of(parts)
        if len(self.columns) != actor.sizes["observation_dim"]:
            raise InvalidInputError(
                f"the parts {', '.join(parts)} have {len(self.columns)} numbers, the actor takes "
                f"{actor.sizes['observation_dim']}"
            )
        self.actor = actor.eval().requires_grad_(False)
        self.parts = parts
        self.facts = facts or {}
        self._state = torch.zeros(1, 0, actor.sizes["width"])

    def describe(self) -> dict[str, Any]:
        """Its kind and its training."""
        return {**super().describe(), **self.facts}

    def begin(self, belief: Belief, rows: Tensor) -> None:
        count = len(belief.camera_position)
        if self._state.shape[1] != count:
            self._state = belief.observation.new_zeros(1, count, self.actor.sizes["width"])
        self._state[:, rows] = 0.0

    def act(self, belief: Belief) -> Tensor:
        """The actor's moves."""
        with torch.no_grad():
            moves, self._state = self.actor.step(belief.observation[:, self.columns], self._state)
        return moves


def columns_of(parts: tuple[Part, ...]) -> Tensor:
    """Where these parts stand in the default observation. Shape (D,), int64."""
    slices = ObservationLayout().slices
    missing = [part for part in parts if part not in slices]
    if missing:
        raise InvalidInputError(f"the default observation has no part {', '.join(missing)}")
    return torch.cat([torch.arange(slices[part].start, slices[part].stop) for part in parts])


def save_recurrent(path: Path, policy: RecurrentPolicy) -> None:
    """Writes the actor, what it sees, and the facts."""
    actor = policy.actor
    save_network(path, FORMAT, actor.sizes, actor.state_dict(), parts=list(policy.parts), facts=policy.facts)


def load_recurrent(path: Path, device: str | torch.device = "cpu") -> RecurrentPolicy:
    """Reads what `save_recurrent` wrote.

    Raises:
        CheckpointError: The file is missing, damaged, or of something else.
    """

    def build(data: dict[str, Any]) -> tuple[RecurrentPolicy, RecurrentActor]:
        actor = RecurrentActor(**data["sizes"])
        return RecurrentPolicy(actor, tuple(data["parts"]), dict(data["facts"])), actor

    return load_network(
        path, FORMAT, device, build, "recurrent policy; `maniskill-tomato train-imitation` makes one"
    )
