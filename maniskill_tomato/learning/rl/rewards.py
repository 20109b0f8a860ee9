"""The reward that goes into the replay buffer: the task's own, or one made of what the task tells."""

from collections.abc import Mapping

from torch import Tensor

from maniskill_tomato.learning.rl.presets import TrainConfig


def training_reward(
    config: TrainConfig,
    rewards: Tensor,
    terminations: Tensor,
    previous_visible_fraction: Tensor,
    info: Mapping[str, Tensor],
) -> Tensor:
    """The reward that goes into the replay buffer: the task's, or `potential_reward` where it is configured.

    Args:
        config: Which of them.
        rewards: The task's. Shape (B,).
        terminations: Whether the episode ended for good. Shape (B,), bool.
        previous_visible_fraction: V_f before the action. Shape (B,).
        info: `visible_fraction`, `success` and `reward_penalty` after it, each of shape (B,).

    Returns:
        Shape (B,).
    """
    if config.reward == "task":
        return rewards
    return potential_reward(
        info["visible_fraction"],
        previous_visible_fraction,
        info["success"],
        terminations,
        info["reward_penalty"],
        gamma=config.gamma,
        step_cost=config.step_cost,
    )


def potential_reward(
    visible_fraction: Tensor,
    previous_visible_fraction: Tensor,
    success: Tensor,
    terminated: Tensor,
    penalty: Tensor,
    *,
    gamma: float,
    step_cost: float,
) -> Tensor:
    """1 for success, the pose penalties, a cost per step, and V_f as a potential.

    The thesis's rewards pay for every step on which the target is well visible, so a policy that hovers just
    below the threshold earns more than one that finishes: 1.09 a step for ever against 1.5 once on the guided
    task. Here the shaping term gamma Phi(s') - Phi(s) with Phi = V_f (0 after the end) adds up to -Phi(s_1)
    whatever the policy does, so the best policy is the one that sees the target fully, soonest (Ng et al.,
    1999).

    Args:
        visible_fraction: V_f after the action. Shape (B,).
        previous_visible_fraction: V_f before it. Shape (B,).
        success: Whether the target is fully visible. Shape (B,), bool.
        terminated: Whether the episode ended for good. Shape (B,), bool.
        penalty: P_p of the task (Eq. 5-4, 5-10), zero or negative. Shape (B,).
        gamma: Discount factor.
        step_cost: What each step costs, 0 or more.

    Returns:
        Shape (B,).
    """
    potential = gamma * visible_fraction * (~terminated).float() - previous_visible_fraction
    return success.float() + potential + penalty - step_cost
