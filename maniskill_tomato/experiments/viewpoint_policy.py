"""Viewpoint policies in the evaluation: opened from files or by name, and asked as those of observations are."""

from pathlib import Path
from typing import Any

import gymnasium as gym
from torch import Tensor

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.experiments.exported import open_policy
from maniskill_tomato.experiments.rollout import ActingPolicy
from maniskill_tomato.files import read_tensors
from maniskill_tomato.policies.learned import LearnedPolicy
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.policies.recurrent import is_recurrent, load_recurrent
from maniskill_tomato.policies.registry import make_planner
from maniskill_tomato.policies.view_quality import is_view_quality, load_view_quality
from maniskill_tomato.tasks import GENERAL_IDS


def open_viewpoint_policy(path: Path, env_id: str | None = None) -> Planner:
    """Reads a policy for the general tasks: a view-quality or a recurrent one, or one of observations (.pt or .onnx).

    Args:
        path: The file.
        env_id: The task that it must fit; None accepts any. View-quality and recurrent policies fit all
            general tasks.

    Raises:
        CheckpointError: It is missing, damaged or made for another task.
        PolicyError: The same of an exported one.
    """
    content = None if path.suffix.lower() == ".onnx" else read_tensors(path)
    loader = (
        load_view_quality if is_view_quality(content) else load_recurrent if is_recurrent(content) else None
    )
    if loader is None:
        return LearnedPolicy(open_policy(path, env_id))
    if env_id is not None and env_id not in GENERAL_IDS:
        raise CheckpointError(f"{path} is a policy for {', '.join(GENERAL_IDS)}, not for {env_id}")
    return loader(path)


class BeliefPolicy:
    """Looks at the belief of its environment where it is asked with observations."""

    def __init__(self, policy: Planner, env: gym.Env[Any, Any]) -> None:
        """Ties a policy to an environment.

        Args:
            policy: Decides.
            env: A general viewpoint task.
        """
        self._policy = policy
        self._world: Any = env.unwrapped

    def act(self, observations: Tensor) -> Tensor:
        """The policy's moves, whatever the observations are. Shape (B, 3)."""
        belief = self._world.belief
        fresh = (belief.memory.visits == 1).nonzero()[:, 0]
        if len(fresh):
            self._policy.begin(belief, fresh)
        return self._policy.act(belief)


def acting_policy(policy: ActingPolicy | Planner | str, env: gym.Env[Any, Any]) -> ActingPolicy:
    """What `run_episodes` can ask in `env`; a string names a planner."""
    if isinstance(policy, str):
        policy = make_planner(
            policy,
            ground_truth=getattr(env.unwrapped, "ground_truth", None),
            device=getattr(env.unwrapped, "device", "cpu"),
        )
    return BeliefPolicy(policy, env) if isinstance(policy, Planner) else policy
