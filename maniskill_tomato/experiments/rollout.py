"""Episodes of a policy, each with its own seed, recorded step by step."""

import sys
from collections.abc import Container
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.protocol import Policy, StatePolicy

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Episode:
    """One evaluated episode of T steps, from the start view 0 to the last view T."""

    seed: int
    """The seed of its reset."""
    success: bool
    """Whether the target became fully visible."""
    viewpoints: Float64
    """End-effector x, y, z [m], roll, pitch, yaw [rad], world frame, at every view. Shape (T + 1, 6)."""
    target: Float64
    """Position of the target in the world frame, in [m]. Shape (3,)."""
    visible_fraction: Float64
    """V_f at every view. Shape (T + 1,)."""
    rewards: Float64
    """R of every step. Shape (T,)."""
    reachability: NDArray[np.int64]
    """0 reached, 1 neighbour pose, 2 unreachable, for every step. Shape (T,)."""
    in_forbidden_zone: NDArray[np.bool_]
    """Whether each step ended in the forbidden zone. Shape (T,)."""
    plant_contact: NDArray[np.bool_] | None = None
    """Whether each step touched a plant; None where the task does not say. Shape (T,)."""
    targets_seen: tuple[int, int] | None = None
    """How many tomatoes were seen, and of how many; None where the task has one target."""
    moves: int | None = None
    """Moves as the task counts them, those of a row's transits among them; None where it counts none."""

    @property
    def steps(self) -> int:
        """Number of steps T."""
        return len(self.rewards)

    @property
    def max_visible_fraction(self) -> float:
        """Largest V_f after any step; the start view does not count."""
        return float(self.visible_fraction[1:].max())

    @property
    def path_length(self) -> float:
        """Sum of the straight distances between the end-effector positions of successive views, in [m]."""
        return float(np.linalg.norm(np.diff(self.viewpoints[:, :3], axis=0), axis=1).sum())


def run_episodes(
    env: gym.Env[Any, Any],
    policy: Policy | StatePolicy,
    episodes: int,
    seed: int,
    show_progress: bool = False,
) -> list[Episode]:
    """Runs `episodes` episodes without exploration; episode i starts from the seed `seed + i`.

    Args:
        env: A ManiSkill environment with state observations that does not reset itself.
        policy: Chooses the actions.
        episodes: How many to run, 1 or more.
        seed: Seed of the first one, 0 or more.
        show_progress: Whether to draw a progress bar.

    Returns:
        The episodes in the order of their seeds.

    Raises:
        InvalidInputError: `episodes` or `seed` is out of range.
        PolicyError: The policy cannot act in this task.
    """
    acting = as_state_policy(policy, env)
    if episodes < 1:
        raise InvalidInputError(f"episodes must be 1 or more, got {episodes}")
    if not 0 <= seed <= 2**31 - 1 - episodes:
        raise InvalidInputError(f"seed must be from 0 to {2**31 - 1 - episodes}, got {seed}")
    num_envs = int(getattr(env.unwrapped, "num_envs", 1))
    done: list[Episode] = []
    interval = 0.5 if sys.stderr.isatty() else 10.0
    with tqdm(
        total=episodes, desc="evaluating", unit="episode", disable=not show_progress, mininterval=interval
    ) as bar:
        while len(done) < episodes:
            first = seed + len(done)
            batch = _run_batch(env, acting, [first + i for i in range(num_envs)])
            new = batch[: episodes - len(done)]
            done += new
            bar.set_postfix_str(f"success {sum(e.success for e in done) / len(done):.0%}", refresh=False)
            bar.update(len(new))
    return done


def _run_batch(env: gym.Env[Any, Any], policy: StatePolicy, seeds: list[int]) -> list[Episode]:
    """One episode in each parallel environment; those that end early wait for the others."""
    observations, info = env.reset(seed=seeds[0] if len(seeds) == 1 else seeds)  # type: ignore[arg-type]
    running = torch.ones(len(seeds), dtype=torch.bool, device=observations.device)
    success = torch.zeros_like(running)
    views = [_view(env, observations, info)]
    steps: list[Tensor] = []
    while bool(running.any()):
        observations, reward, terminated, truncated, info = env.step(policy.act(observations))
        success |= info["success"] & running
        views.append(_view(env, observations, info))
        nowhere = torch.zeros_like(running)
        outcome = (
            torch.as_tensor(reward),
            info["reachability"],
            info.get("in_forbidden_zone", nowhere),
            running,
            info.get("plant_contact", nowhere),
            info.get("seen_count", nowhere),
            info.get("target_count", nowhere),
            info.get("moves", nowhere),
        )
        steps.append(torch.stack([value.float() for value in outcome], dim=-1))
        running = running & ~(terminated | truncated)
    seen = torch.stack(views).double().cpu().numpy()
    happened = torch.stack(steps).double().cpu().numpy()
    return [_episode(seeds[i], bool(success[i]), seen[:, i], happened[:, i], info) for i in range(len(seeds))]


def _view(env: gym.Env[Any, Any], observations: Tensor, info: dict[str, Tensor]) -> Tensor:
    """Viewpoint, target and V_f of the present view. Shape (B, 10)."""
    belief = getattr(env.unwrapped, "belief", None)
    poses = (
        observations[:, :9]
        if belief is None
        else torch.cat((belief.viewpoint, belief.target_position), dim=-1)
    )
    return torch.cat((poses, info["visible_fraction"][:, None]), dim=-1)


def _episode(seed: int, success: bool, seen: Float64, happened: Float64, told: Container[str]) -> Episode:
    """The part of one environment's record until its episode ended; `told` says what the task tells."""
    steps = int(happened[:, 3].sum())
    found, wanted = (int(v) for v in happened[steps - 1, 5:7])
    return Episode(
        seed=seed,
        success=success,
        viewpoints=seen[: steps + 1, :6],
        target=seen[0, 6:9],
        visible_fraction=seen[: steps + 1, 9],
        rewards=happened[:steps, 0],
        reachability=happened[:steps, 1].astype(np.int64),
        in_forbidden_zone=happened[:steps, 2].astype(np.bool_),
        plant_contact=happened[:steps, 4].astype(np.bool_) if "plant_contact" in told else None,
        targets_seen=(found, wanted) if "seen_count" in told else None,
        moves=int(happened[steps - 1, 7]) if "moves" in told else None,
    )
