"""What a student saw, and what the teacher would have done there."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.policies.lattice_oracle import LatticeOracle
from maniskill_tomato.policies.protocol import Policy
from maniskill_tomato.sensing.belief import Belief


@dataclass(frozen=True, eq=False, kw_only=True)
class ImitationData:
    """N moves of M episodes, in the order in which they were made."""

    observations: Tensor
    """Shape (N, D), float16."""
    actions: Tensor
    """The teacher's moves. Shape (N, 3)."""
    lengths: Tensor
    """Moves of each episode. Shape (M,), int64."""

    @classmethod
    def join(cls, parts: list["ImitationData"]) -> "ImitationData":
        """All of them, one after the other."""
        return cls(
            observations=torch.cat([p.observations for p in parts]),
            actions=torch.cat([p.actions for p in parts]),
            lengths=torch.cat([p.lengths for p in parts]),
        )


def collect_demonstrations(
    env: gym.Env[Any, Any], seeds: range, student: Policy | None, student_share: float
) -> ImitationData:
    """Runs episodes led by the student or the teacher, and asks the teacher everywhere (DAgger, Ross et al., 2011).

    Args:
        env: A general viewpoint task with one environment.
        seeds: Of the episodes.
        student: Leads some of the episodes; None leaves all to the teacher (behaviour cloning).
        student_share: Probability that the student leads an episode.
    """
    world: Any = env.unwrapped
    teacher = LatticeOracle(world.ground_truth)
    first = torch.zeros(1, dtype=torch.int64)
    observations: list[Tensor] = []
    actions: list[Tensor] = []
    lengths: list[int] = []
    for seed in seeds:
        env.reset(seed=seed)
        led = student is not None and np.random.default_rng(seed).uniform() < student_share
        teacher.begin(world.belief, first)
        if student is not None:
            student.begin(world.belief, first)
        moves, done = 0, False
        while not done:
            belief: Belief = world.belief
            wanted = teacher.act(belief)
            observations.append(belief.observation[0].half())
            actions.append(wanted[0])
            move = student.act(belief) if led and student is not None else wanted
            _, _, terminated, truncated, _ = env.step(move)
            done = bool(terminated) or bool(truncated)
            moves += 1
        lengths.append(moves)
    return ImitationData(
        observations=torch.stack(observations), actions=torch.stack(actions), lengths=torch.tensor(lengths)
    )
