"""What a policy answers, checked before anything moves by it."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import PolicyError
from maniskill_tomato.policies.opening import shipped_policy
from maniskill_tomato.policies.protocol import Policy
from maniskill_tomato.sensing.belief import Belief

TASK: Final = "TomatoViewpoint-v1"
"""The task whose observations and actions the loop has."""

BOUND_SLACK: Final = 1e-4
"""An action's entries may exceed 1 by this much: rounding."""


def default_policy() -> str:
    """The policy that ships with the package."""
    return str(shipped_policy(TASK))


def decide(policy: Policy, belief: Belief) -> NDArray[np.float64]:
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
