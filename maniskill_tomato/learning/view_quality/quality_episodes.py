"""Data for the view-quality network: what was known after each look, and what every candidate view really shows."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.policies.moves import LEAST_MOVE, Goals
from maniskill_tomato.policies.next_best_view import NextBestView
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.policies.quality_features import quality_features
from maniskill_tomato.policies.quality_network import ViewQualityNetwork
from maniskill_tomato.policies.view_quality import ViewQuality, ViewQualityConfig
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.sensing.belief import Belief


@dataclass(frozen=True, eq=False, kw_only=True)
class QualityData:
    """N looks in M episodes or parts of them."""

    maps: Tensor
    """Shape (N, 28, 13, 9), float16."""
    scalars: Tensor
    """Shape (N, 9)."""
    episode: Tensor
    """Row of each look in the tables below: an episode's, or the part's of it after the target was located anew. Shape
    (N,), int64."""
    visible_fraction: Tensor
    """True V_f from every candidate. Shape (M, K), float16."""
    reachable: Tensor
    """Shape (M, K), bool."""
    came_to: Tensor
    """The candidate nearest to where the camera came by the move after each look; -1 where it was refused. Shape
    (N,), int64."""
    touched: Tensor
    """Whether the arm touched the plant on that move. Shape (N,), bool."""

    @classmethod
    def join(cls, parts: list["QualityData"]) -> "QualityData":
        """All of them, one after the other."""
        offsets = np.cumsum([0, *(len(p.reachable) for p in parts[:-1])])
        return cls(
            maps=torch.cat([p.maps for p in parts]),
            scalars=torch.cat([p.scalars for p in parts]),
            episode=torch.cat([p.episode + int(o) for p, o in zip(parts, offsets, strict=True)]),
            visible_fraction=torch.cat([p.visible_fraction for p in parts]),
            reachable=torch.cat([p.reachable for p in parts]),
            came_to=torch.cat([p.came_to for p in parts]),
            touched=torch.cat([p.touched for p in parts]),
        )


class _Wanderer(Planner):
    """The teacher's way through an episode: a planner of random settings that now and then goes somewhere else."""

    name = "wanderer"

    def __init__(self, rng: np.random.Generator, network: ViewQualityNetwork | None) -> None:
        self._rng = rng
        self._network = network

    def begin(self, belief: Belief, rows: Tensor) -> None:
        rng = self._rng
        self._astray = rng.uniform(0.0, 0.5)
        if self._network is None or rng.uniform() < 0.25:
            self._planner: Planner = NextBestView(10.0 ** rng.uniform(-2.0, -0.7))
        else:
            patience = 10.0 ** rng.uniform(0.5, 1.2)
            self._planner = ViewQuality(self._network, ViewQualityConfig(patience=patience))
        self._planner.begin(belief, rows)
        self._goals = Goals()
        self._goals.begin(belief, rows)
        self._on_goal = False

    def act(self, belief: Belief) -> Tensor:
        planned = self._planner.act(belief)
        if self._on_goal and not bool(self._goals.ended(belief)[0]):
            return self._goals.act(belief)
        self._on_goal = bool(self._rng.uniform() < self._astray)
        reachable = belief.reachable[0].nonzero()[:, 0]
        if not self._on_goal or not len(reachable):
            self._on_goal = False
            return planned
        k = reachable[int(self._rng.integers(len(reachable)))]
        candidates = belief.lattice.positions(belief.target_position)
        self._goals.set(candidates[:, k], torch.ones_like(belief.visible_fraction, dtype=torch.bool))
        return self._goals.act(belief)


def collect_episodes(
    env: gym.Env[Any, Any], seeds: range, network: ViewQualityNetwork | None = None
) -> QualityData:
    """Runs episodes and keeps every look with the truth about all candidates.

    Args:
        env: A general viewpoint task with one environment.
        seeds: Of the episodes.
        network: Leads three quarters of the episodes; None leaves all to the planner on the occupancy map.

    Raises:
        InvalidInputError: An episode cannot begin, such as where the arm reaches none of a plant's ripe fruits.
    """
    world: Any = env.unwrapped
    maps: list[Tensor] = []
    scalars: list[Tensor] = []
    episode: list[int] = []
    fractions: list[Tensor] = []
    reachable: list[Tensor] = []
    came_to: list[int] = []
    touched: list[bool] = []
    first = torch.zeros(1, dtype=torch.int64)
    for seed in seeds:
        env.reset(seed=seed)
        belief: Belief = world.belief
        policy = _Wanderer(np.random.default_rng(seed), network)
        policy.begin(belief, first)
        target = torch.full((3,), float("nan"))
        done = False
        while not done:
            belief = world.belief
            if not torch.equal(target, belief.target_position[0]):
                # The candidates stand round where the target is believed to be, which a camera may correct.
                target = belief.target_position[0].clone()
                poses = look_at_pose(belief.lattice.positions(target[None])[0], target)
                fractions.append(world.ground_truth.visible_fraction(poses).half())
                reachable.append(belief.reachable[0].clone())
            seen = quality_features(belief)
            maps.append(seen[0][0].half())
            scalars.append(seen[1][0])
            episode.append(len(fractions) - 1)
            candidates, before = belief.lattice.positions(target[None])[0], belief.camera_position[0]
            _, _, terminated, truncated, info = env.step(policy.act(belief))
            now = world.belief.camera_position[0]
            nearest = int((candidates - now).norm(dim=-1).argmin())
            came_to.append(nearest if float((now - before).norm()) >= LEAST_MOVE else -1)
            touched.append(bool(info["plant_contact"]))
            done = bool(terminated) or bool(truncated)
    return QualityData(
        maps=torch.stack(maps),
        scalars=torch.stack(scalars),
        episode=torch.tensor(episode),
        visible_fraction=torch.stack(fractions),
        reachable=torch.stack(reachable),
        came_to=torch.tensor(came_to),
        touched=torch.tensor(touched),
    )
