"""A task as an active perception environment of `ap_gym`: move the camera, and say how much of the target it sees.

`ap_gym` adds a prediction to every action and takes its loss from the reward. Here the prediction is the visible
fraction V_f of the view that the last observation shows. The observation has depth, labels and the pose, and not V_f.

Examples:
    pip install ap_gym aiohttp
    python examples/ap_gym_env.py
"""

from typing import Any

import ap_gym  # pyright: ignore[reportMissingImports]
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.learning.rl.gymnasium_env import make_gymnasium_env

Array = NDArray[np.float32]


class VisibleFraction(ap_gym.ActiveRegressionEnv[dict[str, Any], Array]):  # type: ignore[misc]
    """`TomatoViewpoint-v1` whose actions also predict V_f, in [0, 1]; the base reward is the task's."""

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, **options: Any) -> None:
        """Makes the task.

        Args:
            options: Of `make_gymnasium_env`, such as `image_size`.
        """
        self._env = make_gymnasium_env("TomatoViewpoint-v1", **{"obs_mode": "depth+segmentation", **options})
        self.observation_space = self._env.observation_space
        super().__init__(1, self._env.action_space, prediction_low=0.0, prediction_high=1.0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode."""
        super().reset(seed=seed)
        observation, info = self._env.reset(seed=seed, options=options)
        self._visible_fraction = float(info["visible_fraction"])
        return observation, {**info, "prediction": {"target": self._target()}}

    def _step(
        self, action: Array, prediction: Array
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any], Array]:
        target = self._target()
        observation, reward, terminated, truncated, info = self._env.step(action)
        self._visible_fraction = float(info["visible_fraction"])
        return observation, float(reward), terminated, truncated, info, target

    def _target(self) -> Array:
        return np.array([self._visible_fraction], dtype=np.float32)

    def close(self) -> None:
        """Frees the task."""
        self._env.close()


def main() -> None:
    """Plays an episode with random moves and a blind guess of V_f."""
    env = VisibleFraction()
    env.reset(seed=0)
    env.action_space.seed(0)
    done = False
    while not done:
        move = env.action_space["action"].sample()
        _, reward, terminated, truncated, info = env.step(
            {"action": move, "prediction": np.full(1, 0.5, np.float32)}
        )
        told = info["prediction"]
        print(
            f"V_f {float(told['target'][0]):.2f}, loss {float(told['loss']):.2f}, reward {float(reward):.2f}"
        )
        done = terminated or truncated
    env.close()


if __name__ == "__main__":
    main()
