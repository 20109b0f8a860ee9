"""The tasks of maniskill-tomato as environments of LeRobot: `lerobot-eval --env.type=maniskill_tomato`."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from maniskill_tomato.tasks.lerobot_env import CAMERA, FPS, make_env

__all__ = ["TomatoEnv"]


@EnvConfig.register_subclass("maniskill_tomato")
@dataclass
class TomatoEnv(EnvConfig):
    """One of the tasks, without a simulator."""

    task: str | None = "TomatoViewpoint-v1"
    fps: int = FPS
    obs_type: str = "pixels_agent_pos"
    """Or `state`: the task's state vector alone."""
    width: int = 96
    """Of pictures, in [px]."""
    height: int = 72
    """Likewise."""
    episodes: str | None = None
    """Of TomatoViewpoint-v1: a fixed list of episodes, such as `held_out`."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Finds out what is observed and done, from an environment of the task."""
        env = self._make(1)
        spaces, action = env.single_observation_space.spaces, env.single_action_space
        env.close()
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=action.shape),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=spaces["agent_pos"].shape),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
        if "pixels" in spaces:
            picture = spaces["pixels"][CAMERA]
            key = f"{OBS_IMAGES}.{CAMERA}"
            self.features[key] = PolicyFeature(type=FeatureType.VISUAL, shape=picture.shape)
            self.features_map[key] = key

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Options of the environment."""
        options: dict[str, Any] = {"obs_type": self.obs_type, "image_size": (self.width, self.height)}
        return options | ({} if self.episodes is None else {"episodes": self.episodes})

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """N environments, which are computed at once in this process whatever `use_async_envs` says."""
        return {self.type: {0: self._make(n_envs)}}

    def _make(self, n_envs: int) -> Any:
        return make_env(n_envs, task=self.task, **self.gym_kwargs)
