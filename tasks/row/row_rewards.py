"""The reward of the general tasks as a pure function of tensors."""

from torch import Tensor


def view_gain_reward(
    visible_fraction: Tensor,
    previous_fraction: Tensor,
    success: Tensor,
    contact: Tensor,
    *,
    step_cost: float,
    success_reward: float,
    contact_penalty: float,
) -> Tensor:
    """R = V_f - V_f' - c + b [success] - k [contact], with V_f' the fraction before the move.

    The first two terms are a potential's difference (Ng, Harada and Russell 1999, with an undiscounted potential): over
    an episode they add up to the last V_f less the first, whichever way the camera took. A camera that stays where it
    sees the target in part loses c with every move, whereas Eq. 5-9 pays it 0.1 for each.

    Args:
        visible_fraction: V_f after the move. Shape (B,).
        previous_fraction: V_f before it. Shape (B,).
        success: Whether the target is fully visible after it. Shape (B,), bool.
        contact: Whether the arm touched a plant on the way. Shape (B,), bool.
        step_cost: c.
        success_reward: b.
        contact_penalty: k.

    Returns:
        Shape (B,).
    """
    gain = visible_fraction - previous_fraction
    reward: Tensor = gain - step_cost + success_reward * success.float() - contact_penalty * contact.float()
    return reward
