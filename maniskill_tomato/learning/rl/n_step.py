"""Returns over n steps (Watkins, 1989; D4PG, Barth-Maron et al., 2018), exact where an episode ends sooner."""

from typing import Any

import torch
from torch import Tensor

from maniskill_tomato.learning.rl.replay import Batch


class NStepReturns:
    """Holds the last n transitions of each row back until their returns are complete.

    A transition at step t leaves with r_t + gamma r_t+1 + ... + gamma^(k-1) r_t+k-1, the observation after step
    t + k - 1, its termination, and gamma^k. k is n, or less where the episode ends within the window: after a
    termination nothing is left to come, and after a time limit the value of the episode's last observation counts
    with gamma^k. Every transition leaves once.
    """

    def __init__(
        self,
        steps: int,
        gamma: float,
        rows: int,
        observation_dim: int,
        action_dim: int,
        device: torch.device | str = "cpu",
    ) -> None:
        """Starts with nothing held back.

        Args:
            steps: The n, 1 or more.
            gamma: Discount factor.
            rows: Sequences side by side, for instance parallel environments.
            observation_dim: Number of observed values.
            action_dim: Number of actions.
            device: Where the transitions are.
        """
        self._gamma = gamma
        self._newest = 0
        self._held: dict[str, Tensor] = {
            "observations": torch.zeros(steps, rows, observation_dim, device=device),
            "actions": torch.zeros(steps, rows, action_dim, device=device),
            "returns": torch.zeros(steps, rows, device=device),
            "discounts": torch.zeros(steps, rows, device=device),
            "visible_fractions": torch.zeros(steps, rows, device=device),
            "ages": torch.zeros(steps, rows, dtype=torch.long, device=device),
            "waiting": torch.zeros(steps, rows, dtype=torch.bool, device=device),
        }
        self._order = torch.arange(1, steps + 1, device=device)

    def add(
        self,
        batch: Batch,
        visible_fractions: Tensor,
        episode_ends: Tensor,
        exists: Tensor | None = None,
    ) -> Batch:
        """Takes the next transition of every row; returns those that are complete, the oldest first.

        Args:
            batch: Transitions over one step. Shapes (rows, ...).
            visible_fractions: V_f after them. Shape (rows,).
            episode_ends: Whether the row's episode ended with it, for good or by its time limit. Shape (rows,),
                bool.
            exists: Rows without a transition are False; None if all have one. Shape (rows,), bool.
        """
        held, slot = self._held, self._newest
        held["observations"][slot] = batch.observations
        held["actions"][slot] = batch.actions
        held["visible_fractions"][slot] = visible_fractions
        held["returns"][slot] = 0.0
        held["discounts"][slot] = 1.0
        held["ages"][slot] = 0
        held["waiting"][slot] = True if exists is None else exists
        held["returns"] += held["discounts"] * batch.rewards
        held["discounts"] *= self._gamma
        held["ages"] += 1
        steps = len(self._order)
        complete = held["waiting"] & (episode_ends | (held["ages"] >= steps))
        oldest_first = (slot + self._order) % steps
        slots, rows = complete[oldest_first].nonzero(as_tuple=True)
        slots = oldest_first[slots]
        held["waiting"] &= ~complete
        self._newest = (slot + 1) % steps
        return Batch(
            held["observations"][slots, rows],
            held["actions"][slots, rows],
            held["returns"][slots, rows],
            batch.next_observations[rows],
            batch.terminations[rows],
            held["discounts"][slots, rows],
            held["visible_fractions"][slots, rows],
        )

    def state_dict(self) -> dict[str, Any]:
        """What is held back, for `load_state_dict`."""
        return {"newest": self._newest, **{name: held.cpu().clone() for name, held in self._held.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes back what `state_dict` gave."""
        self._newest = int(state["newest"])
        for name, held in self._held.items():
            held.copy_(state[name])
