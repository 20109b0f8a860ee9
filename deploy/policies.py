"""Policies for the loop: opened from files or by name without the simulator, and asked with care."""

from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.assets import asset_path
from maniskill_tomato.errors import PolicyError, TomatoError
from maniskill_tomato.files import read_tensors
from maniskill_tomato.policies.learned import LearnedPolicy
from maniskill_tomato.policies.onnx_policy import OnnxPolicy
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.policies.registry import PLANNERS, PRIVILEGED, make_planner
from maniskill_tomato.policies.view_quality import is_view_quality, load_view_quality
from maniskill_tomato.sensing.belief import Belief

TASK: Final = "TomatoViewpoint-v1"
"""The task whose observations and actions the loop has."""

FALLBACK: Final = "nbv"
"""The planner where no policy ships."""

BOUND_SLACK: Final = 1e-4
"""An action's entries may exceed 1 by this much: rounding."""


class _OnnxActor:
    def __init__(self, policy: OnnxPolicy) -> None:
        self._policy = policy

    def act(self, observations: Tensor) -> Tensor:
        return torch.as_tensor(self._policy.act(observations.numpy()))


def default_policy() -> str:
    """The policy that ships with the package, or the name of the planner that stands in for it."""
    try:
        return str(asset_path(f"policies/{TASK}.pt"))
    except FileNotFoundError:
        return FALLBACK


def open_policy(name_or_path: str, seed: int = 0) -> Planner:
    """A policy that moves the camera about its target.

    Args:
        name_or_path: A planner's name, a view-quality policy (.pt), or an exported policy (.onnx) of this task.
        seed: Of a planner's random numbers.

    Raises:
        PolicyError: It is missing, damaged, for another task, or needs the simulator.
    """
    if name_or_path in PLANNERS:
        if name_or_path in PRIVILEGED:
            raise PolicyError(
                f"the planner {name_or_path} knows what no camera could tell; it runs in simulation only"
            )
        return make_planner(name_or_path, seed=seed)
    path = Path(name_or_path)
    if not path.is_file():
        allowed = ", ".join(name for name in PLANNERS if name not in PRIVILEGED)
        raise PolicyError(
            f"no policy at {name_or_path!r}; give a .pt or .onnx file, or one of the planners {allowed}"
        )
    if path.suffix.lower() == ".onnx":
        return _onnx(path)
    try:
        data = read_tensors(path)
        if is_view_quality(data):
            return load_view_quality(path)
    except TomatoError as error:
        raise PolicyError(str(error)) from error
    task = data.get("env_id", "another task") if isinstance(data, dict) else "another task"
    raise PolicyError(
        f"{path} is no view-quality policy (it was trained on {task}); for a policy of {TASK} that was trained with "
        "`maniskill-tomato train`, run `maniskill-tomato export` and give the .onnx file"
    )


def _onnx(path: Path) -> Planner:
    policy = OnnxPolicy.load(path)
    trained_on = policy.description.env_id
    if trained_on != TASK:
        raise PolicyError(
            f"{path} was trained on {trained_on}; the loop has the observations and moves of {TASK} only"
        )
    return LearnedPolicy(_OnnxActor(policy))


def decide(policy: Planner, belief: Belief) -> NDArray[np.float64]:
    """The policy's next move, checked.

    Returns:
        Right, up, forward in [-1, 1]. Shape (3,).

    Raises:
        PolicyError: It is not three finite numbers within the bounds.
    """
    action = np.asarray(policy.act(belief).detach().double())
    if action.shape != (1, 3):
        raise PolicyError(
            f"the policy answered with shape {action.shape}, not (1, 3); is it for another task?"
        )
    if not np.isfinite(action).all():
        raise PolicyError(
            f"the policy answered {action[0].tolist()}, which is not finite; the arm does not move"
        )
    if np.abs(action).max() > 1.0 + BOUND_SLACK:
        raise PolicyError(f"the policy answered {action[0].tolist()}, outside [-1, 1]; the arm does not move")
    move: NDArray[np.float64] = action[0].clip(-1.0, 1.0)
    return move
