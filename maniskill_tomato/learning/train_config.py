"""The options of a training run, each with its meaning and its limits."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from maniskill_tomato.errors import InvalidInputError

ExplorationName = Literal["epsilon-greedy", "decaying-gaussian", "look-at-goals"]

MAY_CHANGE = (
    "total_episodes",
    "total_timesteps",
    "max_minutes",
    "checkpoint_every",
    "checkpoint_seconds",
    "checkpoints_kept",
)
"""Options that may differ when a run is continued: its length, and how often it is saved."""

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
