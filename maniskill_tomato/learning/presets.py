"""Training configurations: the thesis's two (Tables 5-1 and 5-2) and a good default."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policy.layout import ACTION_NAMES as ACTION_NAMES
from maniskill_tomato.policy.layout import OBSERVATION_NAMES as OBSERVATION_NAMES

OBSERVATION_CENTRE = (0.2, 0.0, 0.8, 0.0, math.pi / 2, 0.0, 0.7, 0.0, 0.8)
"""What normalisation maps to 0: the middle of the arm's working range in front of the plant, looking along x.
[m], [rad]."""

OBSERVATION_HALF_RANGE = (0.5, 0.5, 0.5, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5)
"""What normalisation maps to 1: half the working range. The same for the end-effector and the target, so that
their difference keeps its meaning. [m], [rad]."""

EPSILON_GREEDY_LOW = (-0.07, -0.2, -0.1, -0.17, -0.17, -0.17)
"""Lower ends of Eq. 5-6 in the order of `ACTION_NAMES`; the thesis lists pitch before roll. [m], [rad]."""

EPSILON_GREEDY_HIGH = (0.1, 0.1, 0.1, 0.43, 0.17, 0.26)
"""Upper ends of Eq. 5-6 in the order of `ACTION_NAMES`. [m], [rad]."""

PresetName = Literal["td3", "thesis-guided", "thesis-sparse"]
ExplorationName = Literal["epsilon-greedy", "decaying-gaussian", "look-at-goals"]

MAY_CHANGE = (
    "total_episodes",
    "total_timesteps",
    "max_minutes",
    "checkpoint_every",
    "checkpoint_seconds",
    "checkpoints_kept",
    "wandb_project",
)
"""Options that may differ when a run is continued: its length, how often it is saved, where it also logs."""

_AT_LEAST_ONE = (
    "batch_size",
    "buffer_size",
    "policy_frequency",
    "exploration_steps",
    "num_envs",
    "checkpoint_every",
    "checkpoints_kept",
    "torch_threads",
)
_NOT_NEGATIVE = (
    "learning_starts",
    "updates_per_step",
    "step_cost",
    "target_noise",
    "target_noise_clip",
    "pre_tanh_penalty",
    "exploration_noise",
    "exploration_noise_end",
)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything that decides how a run learns; CleanRL's names where it has one."""

    # Length of the run; it ends at whichever comes first.
    total_episodes: int | None = None
    """Stop after this many episodes; the thesis's M."""
    total_timesteps: int | None = None
    """Stop after this many environment steps, counted over all environments."""
    max_minutes: float | None = None
    """Stop after this much training time, in [min]."""

    # Learning.
    reward: Literal["task", "potential"] = "task"
    """Learn from the task's reward, or from success with V_f as a potential
    (`learning.rewards.potential_reward`)."""
    step_cost: float = 0.02
    """What each step costs with the potential reward."""
    gamma: float = 0.99
    """Discount factor."""
    tau: float = 0.001
    """Share by which the target networks follow at each of their updates."""
    batch_size: int = 32
    """Transitions per update."""
    buffer_size: int = 1000
    """Transitions that the replay buffer holds."""
    learning_starts: int = 32
    """Environment steps before the first update; never before the buffer holds a batch."""
    updates_per_step: float = 1.0
    """Updates per environment step (Algorithm 2: one)."""
    actor_learning_rate: float = 1e-4
    """Adam step size of the actor."""
    critic_learning_rate: float = 1e-3
    """Adam step size of the critics."""
    twin_critics: bool = False
    """Use the smaller of two critics' targets (TD3)."""
    policy_frequency: int = 1
    """Critic updates per update of the actor and the targets (TD3: 2)."""
    target_noise: float = 0.0
    """Standard deviation of the noise on target actions, in units of the action scale (TD3: 0.2)."""
    target_noise_clip: float = 0.5
    """Bound of that noise, in units of the action scale."""
    pre_tanh_penalty: float = 0.0
    """Weight of the mean squared actor output before tanh, against saturation."""

    # Networks.
    actor_hidden: tuple[int, ...] = (100, 100)
    """Width of the actor's hidden layers."""
    critic_hidden: tuple[int, ...] = (100, 100)
    """Width of the critics' hidden layers."""
    critic_action_layer: int = 1
    """Hidden layer of the critics that the action enters; 1 is the second, as in the thesis."""
    actor_output_init: Literal["glorot", "small"] = "glorot"
    """Initialiser of the actor's last layer: the thesis's, or one whose first actions are nearly zero."""
    normalize_observations: bool = False
    """Scale observations by the fixed ranges OBSERVATION_CENTRE and OBSERVATION_HALF_RANGE."""
    action_scale: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    """The action that an actor output of 1 stands for, in [m] and [rad] (thesis: 1)."""

    # Exploration.
    exploration: ExplorationName = "epsilon-greedy"
    """How actions are explored."""
    exploration_steps: int = 1200
    """Steps that the schedule spans; the thesis's EXP."""
    exploration_noise: float = 0.1
    """Standard deviation of the noise at the start, in units of the action scale."""
    exploration_noise_end: float = 0.0
    """Standard deviation at the end of the schedule (look-at goals only), in units of the action scale."""
    exploration_goal_share: float = 0.0
    """Share of episodes led through look-at goals at the end of the schedule (look-at goals only)."""

    # Running.
    num_envs: int = 1
    """Parallel environments; ManiSkill allows more than one on a GPU only."""
    checkpoint_every: int = 5000
    """Environment steps between checkpoints."""
    checkpoint_seconds: float | None = 60.0
    """Longest time between checkpoints, in [s]; what a crash can cost. None leaves it to `checkpoint_every`."""
    checkpoints_kept: int = 3
    """Newest checkpoints that stay on the disk."""
    torch_threads: int = 1
    """CPU threads of PyTorch; these networks are too small to gain from more."""
    wandb_project: str | None = None
    """Log to this project of Weights & Biases too, which needs the package wandb."""

    def __post_init__(self) -> None:
        for name in ("total_episodes", "total_timesteps", "max_minutes", "checkpoint_seconds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InvalidInputError(f"{name} must be above 0, got {value}")
        if self.total_episodes is None and self.total_timesteps is None and self.max_minutes is None:
            raise InvalidInputError("set at least one of total_episodes, total_timesteps and max_minutes")
        for name in ("gamma", "exploration_goal_share"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise InvalidInputError(f"{name} must be in [0, 1), got {getattr(self, name)}")
        for name in ("tau", "actor_learning_rate", "critic_learning_rate"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InvalidInputError(f"{name} must be in (0, 1], got {getattr(self, name)}")
        for name in _AT_LEAST_ONE:
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be 1 or more, got {getattr(self, name)}")
        for name in _NOT_NEGATIVE:
            if not getattr(self, name) >= 0:
                raise InvalidInputError(f"{name} must be 0 or more, got {getattr(self, name)}")
        if self.buffer_size < max(self.batch_size, self.num_envs):
            raise InvalidInputError(
                f"buffer_size must be at least batch_size ({self.batch_size}) and "
                f"num_envs ({self.num_envs}), got {self.buffer_size}"
            )
        for name in ("actor_hidden", "critic_hidden"):
            widths = getattr(self, name)
            if not widths or min(widths) < 1:
                raise InvalidInputError(f"{name} must list one or more widths above 0, got {widths}")
        if not 0 <= self.critic_action_layer < len(self.critic_hidden):
            raise InvalidInputError(
                f"critic_action_layer must be in 0 ... {len(self.critic_hidden) - 1}, "
                f"got {self.critic_action_layer}"
            )
        if not self.action_scale or not all(0.0 < scale <= 1.0 for scale in self.action_scale):
            raise InvalidInputError(f"action_scale must hold values in (0, 1], got {self.action_scale}")

    def to_dict(self) -> dict[str, Any]:
        """The fields as numbers, strings and lists, ready for JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(self).items()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "TrainConfig":
        """The configuration that `to_dict` described.

        Raises:
            InvalidInputError: A field is unknown (the message lists them) or its value not allowed.
        """
        known = {field.name for field in dataclasses.fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise InvalidInputError(
                f"unknown training options: {', '.join(unknown)}; known are {', '.join(sorted(known))}"
            )
        arguments: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**arguments)


PRESETS: dict[PresetName, TrainConfig] = {
    "td3": TrainConfig(
        total_timesteps=15_000,
        reward="potential",
        step_cost=0.05,
        gamma=0.9,
        tau=0.01,
        batch_size=256,
        buffer_size=100_000,
        learning_starts=1500,
        updates_per_step=0.5,
        actor_learning_rate=1e-3,
        critic_learning_rate=1e-3,
        twin_critics=True,
        policy_frequency=2,
        target_noise=0.2,
        pre_tanh_penalty=1e-3,
        actor_hidden=(128, 128),
        critic_hidden=(128, 128),
        critic_action_layer=0,
        actor_output_init="small",
        normalize_observations=True,
        action_scale=(0.35, 0.35, 0.35, 0.6, 0.6, 0.6),
        exploration="look-at-goals",
        exploration_steps=10_000,
        exploration_noise=0.3,
        exploration_noise_end=0.1,
        exploration_goal_share=0.1,
    ),
    "thesis-guided": TrainConfig(
        total_episodes=240, buffer_size=1000, exploration="epsilon-greedy", exploration_steps=1200
    ),
    "thesis-sparse": TrainConfig(
        total_episodes=500,
        buffer_size=1500,
        exploration="decaying-gaussian",
        exploration_steps=1800,
        exploration_noise=0.1,
    ),
}
"""The named configurations. The thesis's are Tables 5-1 and 5-2 on top of the defaults of `TrainConfig`."""


def get_preset(name: str) -> TrainConfig:
    """The configuration called `name`.

    Raises:
        InvalidInputError: There is no such preset; the message lists them.
    """
    for known, config in PRESETS.items():
        if known == name:
            return config
    raise InvalidInputError.choice("preset", name, PRESETS)
