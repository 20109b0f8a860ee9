"""The options of a training run, each with its meaning and its limits."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, get_args

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.perception_kinds import STATE_MODE, Part
from maniskill_tomato.tables import read_table

ExplorationName = Literal["epsilon-greedy", "decaying-gaussian", "look-at-goals", "correlated"]

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
    "frame_stack",
    "image_features",
)
_NOT_NEGATIVE = (
    "actor_starts",
    "hindsight_targets",
    "aux_distance_weight",
    "aux_visibility_weight",
    "learning_starts",
    "updates_per_step",
    "step_cost",
    "target_noise",
    "target_noise_clip",
    "pre_tanh_penalty",
    "exploration_noise",
    "exploration_noise_end",
    "image_shift",
    "replay_memory_gb",
)

_REMOVED = {
    "n_step": 1,
    "privileged_critic": False,
    "leaf_density_start": None,
    "leaf_density_steps": 5000,
    "success_threshold_start": None,
    "success_threshold_steps": 5000,
}
"""Options of earlier versions, each with the default with which a run equals one without the option."""

_CHOICES = {
    "critic": ("scalar", "categorical"),
    "normalize_observations": ("none", "fixed", "running"),
}


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything that decides how a run learns; CleanRL's names where it has one."""

    # Length of the run; it ends at whichever comes first.
    total_episodes: int | None = None
    """Stop after this many episodes; the thesis's M."""
    total_timesteps: int | None = None
    """Stop after this many environment steps, counted over all environments; they all make the last one."""
    max_minutes: float | None = None
    """Stop after this much training time, in [min]."""

    # Learning.
    reward: Literal["task", "potential"] = "task"
    """Learn from the task's reward, or from success with V_f as a potential
    (`learning.rl.rewards.potential_reward`)."""
    reward_from: str | None = None
    """File of demonstrations (.h5) to learn the reward from, in place of `reward`
    (`learning.rl.demonstrated_reward`)."""
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
    critic: Literal["scalar", "categorical"] = "scalar"
    """What the critics learn: the value, or its distribution over fixed atoms (C51, FastTD3)."""
    value_atoms: int = 101
    """Atoms of the categorical critics."""
    value_range: tuple[float, float] = (-10.0, 10.0)
    """Smallest and largest value that the categorical critics can tell."""
    policy_frequency: int = 1
    """Critic updates per update of the actor and the targets (TD3: 2)."""
    target_noise: float = 0.0
    """Standard deviation of the noise on target actions, in units of the action scale (TD3: 0.2)."""
    target_noise_clip: float = 0.5
    """Bound of that noise, in units of the action scale."""
    actor_starts: int = 0
    """Critic updates before the first update of the actor; a given actor waits for critics that know it."""
    initial_policy: str | None = None
    """File of a policy whose actor and normaliser the run begins with, for instance an imitated one."""
    pre_tanh_penalty: float = 0.0
    """Weight of the mean squared actor output before tanh, against saturation."""
    aux_distance_weight: float = 0.0
    """Weight of predicting the distance to the target, in [m], from the actor's last hidden layer."""
    aux_visibility_weight: float = 0.0
    """Weight of predicting V_f after the action from the critics' last hidden layers."""

    # Hindsight.
    hindsight_targets: int = 0
    """Other ripe tomatoes for which every step is stored once more, as if they had been the target."""

    # Networks.
    actor_hidden: tuple[int, ...] = (100, 100)
    """Width of the actor's hidden layers."""
    critic_hidden: tuple[int, ...] = (100, 100)
    """Width of the critics' hidden layers."""
    critic_action_layer: int = 1
    """Hidden layer of the critics that the action enters; 1 is the second, as in the thesis."""
    actor_output_init: Literal["glorot", "small"] = "glorot"
    """Initialiser of the actor's last layer: the thesis's, or one whose first actions are nearly zero."""
    normalize_observations: Literal["none", "fixed", "running"] = "none"
    """Scale observations by the fixed ranges OBSERVATION_CENTRE and OBSERVATION_HALF_RANGE, or by the mean and
    standard deviation of those of the run so far."""
    action_scale: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    """The action that an actor output of 1 stands for, in [m] and [rad] (thesis: 1)."""

    # Images.
    obs_mode: str = "state"
    """What is observed: `state`, or images beside it: `rgbd`, or `rgb`, `depth`, `segmentation` joined by `+`."""
    image_size: tuple[int, int] = (64, 48)
    """Width and height of the images, in [px]."""
    frame_stack: int = 1
    """Views that an observation holds, the present one and those before it."""
    state_parts: tuple[Part, ...] = ("pose", "target", "time")
    """Beside images: parts of the general tasks' observation; `map` and `near_map` are its memory. The thesis's tasks
    have their nine numbers."""
    image_features: int = 64
    """Numbers that the encoder makes of the images."""
    image_shift: int = 2
    """Random shift of the images in updates, in [px] (DrQ-v2: 4 of 84)."""
    asymmetric_critic: bool = False
    """Critics see the whole state vector of the task instead of the images (Pinto et al., 2018)."""
    replay_memory_gb: float = 4.0
    """Most memory of the replay buffer, in [GB]."""
    replay_on_disk: bool = False
    """Keep the replay buffer in files of the run's folder, which checkpoints then do not hold."""

    # Exploration.
    exploration: ExplorationName = "epsilon-greedy"
    """How actions are explored."""
    exploration_steps: int = 1200
    """Steps that the schedule spans; the thesis's EXP."""
    exploration_noise: float = 0.1
    """Standard deviation of the noise at the start, in units of the action scale."""
    exploration_noise_end: float = 0.0
    """Standard deviation at the end of the schedule (look-at goals, correlated), in units of the action scale."""
    exploration_goal_share: float = 0.0
    """Share of episodes led through look-at goals at the end of the schedule (look-at goals only)."""
    exploration_correlation: float = 0.8
    """Correlation of the noise of one step with that of the step before (correlated only)."""
    exploration_noise_per_env: bool = False
    """Every environment draws its own noise level with each episode, uniformly between exploration_noise_end and
    exploration_noise, instead of the schedule's (FastTD3)."""

    # Running.
    num_envs: int = 1
    """Parallel environments; ManiSkill allows more than one on a GPU only."""
    checkpoint_every: int = 5000
    """Environment steps between checkpoints."""
    checkpoint_seconds: float | None = 60.0
    """Longest time between checkpoints, in [s]; what a crash can cost. `none` leaves it to `checkpoint_every`."""
    checkpoints_kept: int = 3
    """Newest checkpoints that stay on the disk."""
    torch_threads: int = 1
    """CPU threads of PyTorch; these networks are too small to gain from more."""
    wandb_project: str | None = None
    """Log to this project of Weights & Biases too, which needs the package wandb."""

    def too_short(self) -> bool:
        """Whether `total_timesteps` end before the first update."""
        if self.total_timesteps is None:
            return False
        # Hindsight stores a transition again for each of its targets.
        stored = self.total_timesteps * (1 + self.hindsight_targets)
        return self.total_timesteps < self.learning_starts or stored < self.batch_size

    def __post_init__(self) -> None:
        for name in ("total_episodes", "total_timesteps", "max_minutes", "checkpoint_seconds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InvalidInputError(f"{name} must be above 0, got {value}")
        if self.total_episodes is None and self.total_timesteps is None and self.max_minutes is None:
            raise InvalidInputError("set at least one of total_episodes, total_timesteps and max_minutes")
        for name in ("gamma", "exploration_goal_share", "exploration_correlation"):
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
        at_once = self.num_envs * max(self.hindsight_targets, 1)
        if self.buffer_size < max(self.batch_size, at_once):
            raise InvalidInputError(
                f"buffer_size must be at least batch_size ({self.batch_size}) and num_envs x hindsight_targets "
                f"({at_once}), got {self.buffer_size}"
            )
        self._check_images()
        self._check_reward_from()
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
        if (
            self.value_atoms < 2
            or len(self.value_range) != 2
            or not self.value_range[0] < self.value_range[1]
        ):
            raise InvalidInputError(
                "categorical critics need 2 or more value_atoms over a rising value_range, got "
                f"{self.value_atoms} over {self.value_range}"
            )
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                raise InvalidInputError.choice(name, getattr(self, name), allowed)
        if self.exploration_noise_per_env and self.exploration == "epsilon-greedy":
            raise InvalidInputError(
                "exploration_noise_per_env needs an exploration with noise: decaying-gaussian, look-at-goals or "
                "correlated; epsilon-greedy has none"
            )

    def _check_images(self) -> None:
        if self.obs_mode == STATE_MODE:
            for name, off in (("frame_stack", 1), ("asymmetric_critic", False)):
                if getattr(self, name) != off:
                    raise InvalidInputError(
                        f"{name} goes with images; choose obs_mode, such as 'depth+segmentation'"
                    )
            return
        if len(self.image_size) != 2:
            raise InvalidInputError(f"image_size must be a width and a height, got {self.image_size}")
        for part in self.state_parts:
            if part not in get_args(Part):
                raise InvalidInputError.choice("a part of the observation", part, get_args(Part))
        ImageLayout.parse(self.obs_mode, self.image_size)
        if self.hindsight_targets:
            raise InvalidInputError(
                "hindsight_targets relabels state vectors, and an image shows one target; set it to 0, or use "
                "obs_mode 'state'"
            )

    def _check_reward_from(self) -> None:
        if self.reward_from is None:
            return
        if self.obs_mode != STATE_MODE:
            raise InvalidInputError(
                f"reward_from judges state vectors; set obs_mode to 'state', got {self.obs_mode!r}"
            )
        for name in ("hindsight_targets", "aux_visibility_weight"):
            if getattr(self, name):
                raise InvalidInputError(
                    f"{name} must be 0 beside reward_from, which does without what the task says about views; "
                    f"got {getattr(self, name)}"
                )

    def to_dict(self) -> dict[str, Any]:
        """The fields as numbers, strings and lists, ready for JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(self).items()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "TrainConfig":
        """The configuration that `to_dict` described.

        Options are read as `modernise` leaves them.

        Raises:
            InvalidInputError: A field is unknown (the message lists them), or its value is of another kind or not
                allowed.
        """
        return read_table(cls, modernise(values), "config")


def modernise(values: dict[str, Any]) -> dict[str, Any]:
    """Options as this version writes them.

    `normalize_observations` was once a switch, on for `fixed`. Options that were removed are left out.

    Raises:
        InvalidInputError: A removed option has another value than the one that switched it off.
    """
    used = [name for name, off in _REMOVED.items() if values.get(name, off) != off]
    if used:
        raise InvalidInputError(
            f"training options that were removed: {', '.join(used)}; leave them out, or use the version that wrote them"
        )
    values = {name: value for name, value in values.items() if name not in _REMOVED}
    normalize = values.get("normalize_observations")
    if isinstance(normalize, bool):
        return {**values, "normalize_observations": "fixed" if normalize else "none"}
    return values
