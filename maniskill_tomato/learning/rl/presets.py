"""Training configurations: the thesis's two (Tables 5-1 and 5-2) and good defaults."""

import dataclasses
import math
from typing import Any, Literal

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.train_config import MAY_CHANGE as MAY_CHANGE
from maniskill_tomato.learning.rl.train_config import TrainConfig as TrainConfig
from maniskill_tomato.learning.rl.train_config import modernise as modernise
from maniskill_tomato.sensing.perception_kinds import STATE_MODE
from maniskill_tomato.task_registry import GENERAL_IDS, THESIS_IDS, base_of

OBSERVATION_CENTRE = (0.2, 0.0, 0.8, 0.0, math.pi / 2, 0.0, 0.7, 0.0, 0.8)
"""What normalisation maps to 0: the middle of the arm's working range in front of the plant, looking along x.
[m], [rad]."""

OBSERVATION_HALF_RANGE = (0.5, 0.5, 0.5, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5)
"""What normalisation maps to 1: half the working range. The same for the end-effector and the target, so that
their difference keeps its meaning. [m], [rad]."""

PresetName = Literal[
    "td3",
    "fast-td3",
    "thesis-guided",
    "thesis-sparse",
    "pixel-td3",
    "pixel-ddpg",
    "general-td3",
    "general-ddpg",
    "general-fast-td3",
    "general-pixel-td3",
    "general-pixel-ddpg",
]

_TD3 = TrainConfig(
    total_timesteps=15_000,
    reward="potential",
    step_cost=0.05,
    gamma=0.9,
    tau=0.01,
    batch_size=256,
    buffer_size=100_000,
    learning_starts=1500,
    updates_per_step=0.25,
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
    normalize_observations="fixed",
    action_scale=(0.35, 0.35, 0.35, 0.6, 0.6, 0.6),
    exploration="look-at-goals",
    exploration_steps=10_000,
    exploration_noise=0.3,
    exploration_noise_end=0.1,
    exploration_goal_share=0.1,
    num_envs=32,
)

_FAST_TD3 = dataclasses.replace(
    _TD3,
    total_timesteps=3_000_000,
    tau=0.1,
    batch_size=8192,
    buffer_size=1_000_000,
    learning_starts=10_240,
    updates_per_step=2 / 1024,
    actor_learning_rate=3e-4,
    critic_learning_rate=3e-4,
    critic="categorical",
    value_range=(-4.0, 2.0),
    actor_hidden=(512, 256, 128),
    critic_hidden=(1024, 512, 256),
    normalize_observations="running",
    exploration_steps=1_000_000,
    exploration_noise=0.4,
    exploration_noise_end=0.001,
    exploration_noise_per_env=True,
    num_envs=1024,
    checkpoint_every=500_000,
    checkpoint_seconds=None,
)

_GENERAL_TD3 = TrainConfig(
    total_timesteps=40_000,
    gamma=0.95,
    tau=0.005,
    batch_size=256,
    buffer_size=100_000,
    learning_starts=2000,
    updates_per_step=0.125,
    actor_learning_rate=5e-4,
    critic_learning_rate=5e-4,
    twin_critics=True,
    policy_frequency=2,
    target_noise=0.2,
    pre_tanh_penalty=1e-3,
    actor_hidden=(256, 256),
    critic_hidden=(256, 256),
    critic_action_layer=0,
    actor_output_init="small",
    action_scale=(1.0, 1.0, 1.0),
    exploration="correlated",
    exploration_steps=20_000,
    exploration_noise=1.0,
    exploration_noise_end=0.15,
    num_envs=16,
)

_GENERAL_DDPG = dataclasses.replace(
    _GENERAL_TD3,
    total_timesteps=60_000,
    updates_per_step=0.5,
    num_envs=1,
    gamma=0.99,
    tau=0.001,
    batch_size=64,
    actor_learning_rate=1e-4,
    critic_learning_rate=1e-3,
    twin_critics=False,
    policy_frequency=1,
    target_noise=0.0,
    pre_tanh_penalty=0.0,
)

_GENERAL_FAST_TD3 = dataclasses.replace(
    _FAST_TD3,
    reward="task",
    gamma=0.95,
    value_range=(-1.0, 2.5),
    action_scale=(1.0, 1.0, 1.0),
    exploration="correlated",
)

_PIXELS: dict[str, Any] = {
    "obs_mode": "depth+segmentation",
    "total_timesteps": 15_000,
    "exploration_steps": 10_000,
    "updates_per_step": 0.5,
    "batch_size": 128,
    "buffer_size": 30_000,
    "num_envs": 8,
    "asymmetric_critic": True,
    "checkpoint_every": 10_000,
    "checkpoint_seconds": None,
    "checkpoints_kept": 1,
}
"""What images change: a batch costs more, and a checkpoint holds half a gigabyte."""

_SINGLE_CRITIC: dict[str, Any] = {"twin_critics": False, "policy_frequency": 1, "target_noise": 0.0}
"""DDPG."""

_PIXEL_TD3 = dataclasses.replace(_TD3, **_PIXELS)
_GENERAL_PIXEL_TD3 = dataclasses.replace(_GENERAL_TD3, **_PIXELS)

PRESETS: dict[PresetName, TrainConfig] = {
    "td3": _TD3,
    "fast-td3": _FAST_TD3,
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
    "pixel-td3": _PIXEL_TD3,
    "pixel-ddpg": dataclasses.replace(_PIXEL_TD3, **_SINGLE_CRITIC),
    "general-pixel-td3": _GENERAL_PIXEL_TD3,
    "general-pixel-ddpg": dataclasses.replace(_GENERAL_PIXEL_TD3, **_SINGLE_CRITIC),
    "general-td3": _GENERAL_TD3,
    "general-ddpg": _GENERAL_DDPG,
    "general-fast-td3": _GENERAL_FAST_TD3,
}
"""The named configurations. The thesis's are Tables 5-1 and 5-2 on top of the defaults of `TrainConfig`; those for the
general tasks have three actions and take the observation, which is scaled already, as it is. `general-ddpg` has the
learning rates, tau, gamma and batch size of Lillicrap et al. (2016). Those called pixel observe images: `pixel-td3` and
`pixel-ddpg` on the thesis's tasks, the others on the general ones."""


def preset_options(preset: PresetName, env_id: str) -> dict[str, Any]:
    """The options of a task that a preset is for: the thesis's settings belong to the thesis's scene."""
    thesis = preset in ("thesis-guided", "thesis-sparse") and base_of(env_id) in THESIS_IDS
    return {"scene": "thesis"} if thesis else {}


def default_preset(env_id: str | None, obs_mode: str | None = None) -> PresetName:
    """The preset that a task is trained with unless another one is asked for.

    Args:
        env_id: The task.
        obs_mode: What is asked to be observed, if anything.
    """
    general = base_of(env_id) in GENERAL_IDS
    if obs_mode is not None and obs_mode != STATE_MODE:
        return "general-pixel-td3" if general else "pixel-td3"
    return "general-td3" if general else "td3"


def get_preset(name: str) -> TrainConfig:
    """The configuration called `name`.

    Raises:
        InvalidInputError: There is no such preset; the message lists them.
    """
    for known, config in PRESETS.items():
        if known == name:
            return config
    raise InvalidInputError.choice("preset", name, PRESETS)
