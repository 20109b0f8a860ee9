"""The tasks as LeRobot's evaluation wants a vector environment; LeRobot itself is not needed.

Observations are `agent_pos` and, if asked for, `pixels`; infos tell `is_success`; the environment tells its task in
words and renders. A repository of EnvHub needs one file, `env.py`:

    from maniskill_tomato.tasks.lerobot_env import make_env
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, get_args

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.perception_kinds import STATE_MODE
from maniskill_tomato.task_registry import GENERAL_IDS, find_task
from maniskill_tomato.tasks.making import check_choice, check_integer
from maniskill_tomato.tasks.vector_env import make_vector_env

ObservationKind = Literal["state", "pixels_agent_pos"]
"""The task's state vector alone, or a picture and what a robot knows beside it."""

CAMERA: Final = "wrist"

SEEN: Final = "depth+segmentation"
"""What pictures are painted from: it needs no renderer."""

FPS: Final = 4
"""Of films: looks a second."""

SHADED_FROM_MM: Final = 2000.0
"""What is so far away is darkest, in [mm]."""

DARKEST: Final = 0.3

COLOURS: Final[Mapping[Role, tuple[int, int, int]]] = {
    Role.BACKGROUND: (20, 24, 28),
    Role.ROBOT: (150, 150, 160),
    Role.STEM: (150, 110, 60),
    Role.LEAF: (70, 160, 70),
    Role.OTHER_FRUIT: (240, 160, 70),
    Role.TARGET: (230, 30, 30),
    Role.OBJECT: (110, 110, 200),
}
"""RGB of what is near."""

DESCRIPTIONS: Final = {
    False: "Look at the tomato until it is fully visible.",
    True: "Look at every ripe tomato of the row until it is fully visible.",
}
"""Of a task with one target, and of a row."""

_PALETTE: Final = np.array([COLOURS[role] for role in Role], dtype=np.float32)


class LeRobotVectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """N environments of a task with LeRobot's observations, infos and attributes.

    - `agent_pos` (N, D), float32: the task's state vector; beside pictures what `obs_mode="depth+segmentation"` has.
    - `pixels`: `{"wrist": ...}`, uint8, (N, H, W, 3): roles in flat colours, the darker the farther.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        obs_type: ObservationKind = "pixels_agent_pos",
        image_size: tuple[int, int] = (96, 72),
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        """Makes the environments.

        Args:
            task: The task; see `find_task`.
            num_envs: N.
            obs_type: What is observed.
            image_size: Width and height of pictures, also of rendered ones, in [px].
            autoreset_mode: `NextStep`, or `SameStep`, which LeRobot takes too. With the latter its evaluation counts
                the first step of the next episode to the one that has ended, because it looks one step too far.
            options: Of the task, as for `make_vector_env`.

        Raises:
            InvalidInputError: An option cannot be used.
        """
        base = find_task(task).base
        check_integer("n_envs", num_envs, 1)
        check_choice("obs_type", obs_type, get_args(ObservationKind))
        mode = str(getattr(autoreset_mode, "value", autoreset_mode))
        check_choice("autoreset_mode", mode, ("NextStep", "SameStep"))
        for name in ("arrays", "obs_mode", "eyes"):
            if name in options:
                raise InvalidInputError(f"{name} is chosen by obs_type; leave it out")
        layout = ImageLayout.parse(SEEN, image_size)
        assert layout is not None
        self._layout = layout
        self._has_pixels = obs_type == "pixels_agent_pos"
        self._env = make_vector_env(
            task,
            num_envs,
            autoreset_mode=mode,
            obs_mode=SEEN if self._has_pixels else STATE_MODE,
            image_size=image_size,
            **options,
        )
        self.task = task
        self.task_description = DESCRIPTIONS[base == GENERAL_IDS[1]]
        self.num_envs = num_envs
        self.render_mode = "rgb_array"
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": FPS,
            "autoreset_mode": AutoresetMode(mode),
        }
        self.spec = self._env.spec  # pyright: ignore[reportIncompatibleVariableOverride]
        inner = self._env.single_observation_space
        state = inner["state"] if isinstance(inner, gym.spaces.Dict) else inner
        spaces: dict[str, gym.Space[Any]] = {"agent_pos": state}
        if self._has_pixels:
            shape = (layout.height, layout.width, 3)
            spaces["pixels"] = gym.spaces.Dict({CAMERA: gym.spaces.Box(0, 255, shape, np.uint8)})
        self.single_observation_space = gym.spaces.Dict(spaces)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.single_action_space = self._env.single_action_space
        self.action_space = self._env.action_space
        self._begins = np.zeros(num_envs, dtype=np.bool_)

    @property
    def _max_episode_steps(self) -> int:
        return self._env.max_steps

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins episodes; see `tasks.vector_env.VectorEnv.reset`. LeRobot's own options are its own."""
        given = {name: value for name, value in (options or {}).items() if not name.startswith("lerobot_")}
        observation, info = self._env.reset(seed=seed, options=given)
        self._begins[info["_is_success"]] = False
        return self._converted(observation), info

    def step(self, actions: Any) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        """Makes a move in every environment; see `tasks.vector_env.VectorEnv.step`.

        A step that only begins an episode, which `NextStep` has, tells no success, whatever the first view shows:
        LeRobot's evaluation would count it to the episode that has ended.
        """
        observation, reward, terminated, truncated, info = self._env.step(actions)
        info["is_success"] &= ~self._begins
        if self.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP:
            self._begins = terminated | truncated
        if "final_obs" in info:
            final = info["final_obs"]
            for row in range(self.num_envs):
                if final[row] is not None:
                    final[row] = self._converted(final[row])
        return self._converted(observation), reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """What each wrist camera shows now, as `pixels`. N arrays of shape (H, W, 3)."""
        images = self._env.world.images(self._layout)
        return tuple(painted(images["segmentation"].cpu().numpy(), images["depth"].cpu().numpy()))

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What an attribute is, or a method gives, once for each environment, as of `SyncVectorEnv`."""
        if name == "render":
            return self.render()
        value = getattr(self, name) if hasattr(self, name) else getattr(self._env, name)
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """What an attribute is, once for each environment."""
        return self.call(name)

    def close_extras(self, **kwargs: Any) -> None:
        """Closes the world."""
        self._env.close()

    def _converted(self, observation: Any) -> dict[str, Any]:
        """Of all environments, or of one."""
        if not self._has_pixels:
            return {"agent_pos": observation}
        picture = painted(observation["segmentation"], observation["depth"])
        return {"agent_pos": observation["state"], "pixels": {CAMERA: picture}}


def painted(segmentation: NDArray[Any], depth: NDArray[Any]) -> NDArray[np.uint8]:
    """Roles in their colours, the darker the farther.

    Args:
        segmentation: Values of `plants.organs.Role`. Shape (..., 1).
        depth: In [mm], 0 where it was not measured, which counts as near. Shape (..., 1).

    Returns:
        RGB. Shape (..., 3).
    """
    shade = np.clip(1.0 - depth.astype(np.float32) / SHADED_FROM_MM, DARKEST, 1.0)
    colours: NDArray[np.uint8] = (_PALETTE[segmentation[..., 0]] * shade).astype(np.uint8)
    return colours


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None, **options: Any
) -> LeRobotVectorEnv:
    """What LeRobot calls in the `env.py` of a repository of EnvHub.

    Args:
        n_envs: How many environments.
        use_async_envs: Makes no difference: all environments are computed at once in this process.
        cfg: LeRobot's configuration of the environment, if it has one; of it `task`, `obs_type` and `image_size` are
            taken, if they are there.
        options: Those of `LeRobotVectorEnv`, instead.

    Raises:
        InvalidInputError: An option cannot be used.
    """
    chosen = {
        name: value
        for name in ("task", "obs_type", "image_size")
        if (value := getattr(cfg, name, None)) is not None
    }
    chosen |= options
    chosen.setdefault("task", GENERAL_IDS[0])
    return LeRobotVectorEnv(num_envs=n_envs, **chosen)
