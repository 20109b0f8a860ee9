"""How PPO learns; cheap to import."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from maniskill_tomato.learning.rl.presets import get_preset
from maniskill_tomato.task_registry import GENERAL_IDS, base_of

TD3 = get_preset("td3")


@dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """How PPO learns; what it shares with the `td3` preset has that preset's value."""

    total_timesteps: int = 15_000
    """Environment steps; a multiple of n_steps, or a few more are taken."""
    reward: Literal["task", "potential"] = TD3.reward
    """Learn from the task's reward, or from success with V_f as a potential."""
    step_cost: float = TD3.step_cost
    """What each step costs with the potential reward."""
    gamma: float = TD3.gamma
    """Discount factor."""
    gae_lambda: float = 0.95
    """Decay of the advantage estimate."""
    n_steps: int = 500
    """Steps of a rollout."""
    batch_size: int = 100
    """Transitions per minibatch."""
    n_epochs: int = 10
    """Passes over a rollout."""
    learning_rate: float = 3e-4
    """Adam step size."""
    clip_range: float = 0.2
    """Bound on the change of the probability ratio."""
    log_std_init: float = -1.2
    """Logarithm of the first standard deviation, in units of the action scale: 0.3, as the td3 preset's noise."""
    hidden: tuple[int, ...] = TD3.actor_hidden
    """Width of the hidden layers of actor and critic."""
    action_scale: tuple[float, ...] = TD3.action_scale
    """The action that an output of 1 stands for, in [m] and [rad]."""

    def to_dict(self) -> dict[str, Any]:
        """The algorithm and the fields, ready for JSON."""
        fields = dataclasses.asdict(self)
        return {"algorithm": "PPO", **{k: list(v) if isinstance(v, tuple) else v for k, v in fields.items()}}


GENERAL_TD3 = get_preset("general-td3")

GENERAL = PpoConfig(
    total_timesteps=60_000,
    reward=GENERAL_TD3.reward,
    gamma=GENERAL_TD3.gamma,
    n_steps=1000,
    batch_size=250,
    log_std_init=-0.7,
    hidden=GENERAL_TD3.actor_hidden,
    action_scale=GENERAL_TD3.action_scale,
)
"""For the general tasks: longer rollouts over many plants, and a first standard deviation of 0.5."""


def default_ppo(env_id: str | None) -> PpoConfig:
    """The configuration for a task."""
    return GENERAL if base_of(env_id) in GENERAL_IDS else PpoConfig()
