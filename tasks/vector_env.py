"""The tasks as Gymnasium vector environments: a world stepped with automatic resets, as learners want it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError, did_you_mean
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.perception_kinds import STATE_MODE
from maniskill_tomato.task_registry import find_task
from maniskill_tomato.tasks.arm_moves import ACTION_SIZES, CONTROL_MODES
from maniskill_tomato.tasks.gymnasium_form import masked_info, numpy_of, rows_apart
from maniskill_tomato.tasks.making import (
    check_choice,
    check_integer,
    check_other_tasks,
    make_world,
    option_names,
)
from maniskill_tomato.tasks.observed_world import LearnerEyes, ObservedWorld
from maniskill_tomato.tasks.world import World

Arrays = Literal["numpy", "torch"]
"""What a vector environment takes and gives.

Gymnasium's vector interface, its wrappers and the learners written for it are NumPy's, so `numpy` is what
`gymnasium.make_vec` makes. `torch` leaves the world's tensors on their device, for learners on a GPU and for this
package's own: nothing is copied to the host.
"""


class VectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """N environments of one task in this process, without a simulator.

    Resets are Gymnasium's: see `AutoresetMode`. With `NEXT_STEP` the step that ends an episode returns its last
    observation, and the step after ignores the action, begins the next episode and gives reward 0. With `SAME_STEP` it
    returns the next episode's first observation, and `info["final_obs"]` and `info["final_info"]` are what the step
    itself gave where `info["_final_obs"]` says so. With `DISABLED` the caller resets, by `options={"reset_mask": ...}`.

    Of NumPy arrays every entry of an info has its mask, `final_obs` is an array of objects, and with `DISABLED` a step
    of an environment that is done is refused. Of tensors, infos have no masks but those of `final_obs` and
    `final_info`; these hold all environments, in the shape of a step's; and an environment that is done plays on, since
    to look costs a synchronisation with the device.

    What it does not have itself it takes from its world, so that `unwrapped` tells what ManiSkill's shell tells.
    """

    def __init__(
        self,
        world: World,
        max_steps: int,
        *,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        arrays: Arrays = "numpy",
        env_id: str | None = None,
        eyes: LearnerEyes | None = None,
    ) -> None:
        """Takes a world.

        Args:
            world: Which.
            max_steps: Steps after which an episode is cut off.
            autoreset_mode: When environments that are done are reset.
            arrays: What observations, rewards, flags and infos are.
            env_id: The task's, for `spec`.
            eyes: What images stand in the observation, which then is a dictionary; None for state vectors.
        """
        self.world = world
        self.num_envs = world.num_envs
        self.max_steps = max_steps
        self.autoreset_mode = autoreset_mode
        self.arrays = arrays
        self.metadata = {"render_modes": [], "autoreset_mode": autoreset_mode}
        self.spec = (  # pyright: ignore[reportIncompatibleVariableOverride]
            None if env_id is None else gym.spec(find_task(env_id).env_id)
        )
        self._observed = ObservedWorld(world, eyes)
        self.single_observation_space = self._observed.space
        self.single_action_space: gym.Space[Any] = gym.spaces.Box(
            -1.0, 1.0, (ACTION_SIZES[world.moves.control],), np.float32
        )
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._elapsed = torch.zeros(self.num_envs, dtype=torch.int32, device=world.device)
        self._done = torch.zeros(self.num_envs, dtype=torch.bool, device=world.device)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or "world" not in self.__dict__:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self._told_by, name)

    @property
    def _told_by(self) -> Any:
        return self.world

    @property
    def spec(self) -> EnvSpec | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The task's specification, from which `gymnasium.make_vec` makes such an environment again."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        # The wrappers of a specification are those of a single environment.
        self._spec = None if spec is None else replace(spec, additional_wrappers=())

    # ---------------------------------------------------------------- episode

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begins episodes.

        Args:
            seed: One for each environment, None where its generator goes on; of one number s the i-th environment gets
                s + i. All generators go on if it is missing.
            options: Those of the task. `reset_mask` says where, an array of bool of shape (N,). `env_idx` does so by
                indices, and then a list of seeds has one for each of these. Everywhere if both are missing.

        Returns:
            The observations of all environments, and the info of those that were reset.

        Raises:
            InvalidInputError: An option or the seeds cannot be used.
        """
        options = dict(options or {})
        by_row = options.get("env_idx") is not None
        rows = self._rows(options)
        seeds = self._seeds(seed, rows, by_row)
        super().reset(seed=int(seed) if isinstance(seed, int | np.integer) else None)
        self._begin(seeds, rows, options)
        self._elapsed[rows], self._done[rows] = 0, False
        observation, info = self._observed.observe(rows), self._info()
        if self.arrays == "torch":
            return observation, info
        begun = np.zeros(self.num_envs, dtype=np.bool_)
        begun[rows.cpu().numpy()] = True
        return numpy_of(observation), masked_info(info, begun)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Makes a move in every environment.

        Args:
            actions: Shape (N, A).

        Returns:
            Observations, of shape (N, D) where they are vectors; rewards, terminations and truncations of shape (N,);
            the info.

        Raises:
            InvalidInputError: The actions cannot be used, or an environment is to be reset first; nothing was changed.
        """
        ended = self._ended()
        reward, terminated, info = self._play(actions if ended is None else _ignored(actions, ended))
        begun = None
        if ended is not None:
            begun = ended.nonzero()[:, 0]
            info = self._begin_next(begun)
            reward, terminated = reward.masked_fill(ended, 0.0), terminated & ~ended
        truncated = self._elapsed >= self.max_steps
        self._done = done = terminated | truncated
        observation = self._observed.observe(begun, moved=True)
        final: dict[str, Any] = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and bool(done.any()):
            final = {"final_obs": observation, "final_info": info, "_final_obs": done, "_final_info": done}
            begun = done.nonzero()[:, 0]
            info = self._begin_next(begun)
            observation = self._observed.observe(begun)
        return self._told(observation, reward, terminated, truncated, info, final)

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the processes that grow plants ahead; a world holds no simulation."""
        self.world.close()

    def _ended(self) -> Tensor | None:
        """The environments that only begin anew in this step. Shape (N,), bool; None if there are none."""
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and bool(self._done.any()):
            return self._done
        if (
            self.autoreset_mode == AutoresetMode.DISABLED
            and self.arrays == "numpy"
            and bool(self._done.any())
        ):
            done = ", ".join(map(str, self._done.nonzero()[:, 0].tolist()))
            raise InvalidInputError(
                f"the episodes of environments {done} are over; reset them before the next step by "
                'reset(options={"reset_mask": terminations | truncations})'
            )
        return None

    def _told(
        self,
        observation: Any,
        reward: Tensor,
        terminated: Tensor,
        truncated: Tensor,
        info: dict[str, Any],
        final: dict[str, Any],
    ) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """What a step returns, as the arrays that are wanted."""
        if self.arrays == "torch":
            return observation, reward, terminated, truncated, info | final
        arrays = masked_info(info, np.ones(self.num_envs, dtype=np.bool_))
        if final:
            done = numpy_of(final["_final_obs"])
            arrays |= {
                "final_obs": rows_apart(numpy_of(final["final_obs"]), done),
                "final_info": masked_info(final["final_info"], done),
                "_final_obs": done.copy(),
                "_final_info": done.copy(),
            }
        told = (observation, reward, terminated, truncated)
        return (*map(numpy_of, told), arrays)

    def _rows(self, options: dict[str, Any]) -> Tensor:
        """The environments that a reset is for, which are taken out of its options. Shape (b,)."""
        mask, env_idx = options.pop("reset_mask", None), options.pop("env_idx", None)
        if mask is None:
            return self.world.env_rows(env_idx)
        if env_idx is not None:
            raise InvalidInputError("a reset takes reset_mask or env_idx, not both")
        marks = torch.as_tensor(mask) if isinstance(mask, np.ndarray | Tensor) else torch.zeros(0)
        if marks.dtype != torch.bool or marks.shape != (self.num_envs,) or not bool(marks.any()):
            raise InvalidInputError(
                f"reset_mask must be an array of bool of shape ({self.num_envs},), True where an episode is to begin "
                f"and at least once; got {mask!r}"
            )
        return marks.to(self.world.device).nonzero()[:, 0]

    def _seeds(
        self, seed: int | Sequence[int | None] | None, rows: Tensor, by_row: bool
    ) -> list[int | None] | None:
        """The seed of each of these environments; None where no generator is seeded."""
        if seed is None:
            return None
        indices = rows.tolist()
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in indices]
        count = len(indices) if by_row else self.num_envs
        if len(seed) != count:
            raise InvalidInputError(
                f"seed must be one number or {count}, one for each environment; got {len(seed)}"
            )
        seeds = [None if s is None else int(s) for s in seed]
        return seeds if by_row else [seeds[i] for i in indices]

    # ------------------------------------------------------------------ world

    def _begin(self, seeds: Sequence[int | None] | None, rows: Tensor, options: Mapping[str, Any]) -> None:
        """Begins episodes in some environments. Shape (b,)."""
        if seeds is not None:
            given = zip(rows.tolist(), seeds, strict=True)
            self.world.seed({i: seed for i, seed in given if seed is not None})
        self.world.reset(None, rows, options)

    def _begin_next(self, rows: Tensor) -> dict[str, Any]:
        """Begins the next episodes of some environments; the info of all. Shape (b,)."""
        self._begin(None, rows, {})
        self._elapsed[rows] = 0
        return self._info()

    def _play(self, actions: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Makes and counts a move everywhere; rewards and terminations of shape (N,), and the info."""
        self.world.step(actions)
        self._elapsed += 1
        info = self._info()
        return self.world.reward(info), info["success"] | info["fail"], info

    def _info(self) -> dict[str, Any]:
        return {"elapsed_steps": self._elapsed.clone(), **self.world.info()}

    # ------------------------------------------------------------------ state

    def get_run_state(self) -> dict[str, Any]:
        """Everything that decides how the environments go on."""
        return {"world": self.world.save(), **self._progress()}

    def set_run_state(self, state: Mapping[str, Any]) -> None:
        """Takes back what `get_run_state` of environments made with the same options gave."""
        self.world.restore(state["world"])
        self._set_progress(state)

    def _progress(self) -> dict[str, Any]:
        return {
            "elapsed": self._elapsed.cpu().clone(),
            "done": self._done.cpu().clone(),
            "frames": self._observed.frames.state_dict(),
        }

    def _set_progress(self, state: Mapping[str, Any]) -> None:
        self._elapsed = state["elapsed"].to(self._elapsed).clone()
        self._done = state["done"].to(self._done).clone()
        self._observed.frames.load_state_dict(state["frames"], self.world.device)

    # ------------------------------------------------- of every environment alike

    @property
    def _max_episode_steps(self) -> int:
        return self.max_steps

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What an attribute is, or a method gives, once for each environment, as of `SyncVectorEnv`."""
        value = getattr(self, name)
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """What an attribute is, once for each environment."""
        return self.call(name)


def _ignored(actions: Any, ended: Tensor) -> Any:
    """Actions with zeros where they are ignored. Shape (N, A)."""
    if not isinstance(actions, np.ndarray | Tensor) or len(actions) != len(ended):
        return actions
    kept = torch.as_tensor(actions, device=ended.device).clone()
    kept[ended] = 0.0
    return kept


def make_vector_env(
    env_id: str,
    num_envs: int = 1,
    device: str | torch.device = "cpu",
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    arrays: Arrays = "numpy",
    control_mode: str | None = None,
    obs_mode: str = STATE_MODE,
    image_size: tuple[int, int] = (64, 48),
    eyes: LearnerEyes | None = None,
    max_episode_steps: int | None = None,
    growers: int = 0,
    **options: Any,
) -> VectorEnv:
    """N environments of a task without a simulator; what `gymnasium.make_vec` makes.

    Args:
        env_id: The task; see `find_task`.
        num_envs: N.
        device: `cpu` or `cuda`.
        autoreset_mode: When environments that are done are reset; the default is that of Gymnasium's own vector
            environments.
        arrays: `numpy`, or `torch` for tensors on the device; see `Arrays`.
        control_mode: `pd_viewpoint` or `pd_look_at`; the task's own if None.
        obs_mode: `state`, or images beside it that need no renderer, such as `depth+segmentation`; see
            `sensing.image_layout.ImageLayout.parse`.
        image_size: Their width and height, in [px].
        eyes: The same with more to choose, instead of `obs_mode`.
        max_episode_steps: Steps after which an episode is cut off; the task's own if None.
        growers: Worker processes that grow the plants of coming resets; with 0 a reset waits for its new plants.
            Episodes are the same either way.
        options: Of the task: `making.ThesisOptions`, `SearchOptions` or `RowOptions`.

    Raises:
        InvalidInputError: An option cannot be used.
    """
    task = find_task(env_id)
    _check_vector_options(env_id, options)
    check_choice("arrays", arrays, get_args(Arrays))
    check_choice("device", torch.device(device).type, ("cpu", "cuda"))
    if control_mode is not None and control_mode not in CONTROL_MODES:
        raise InvalidInputError(
            f"control_mode must be {' or '.join(repr(m) for m in CONTROL_MODES)} without a simulator, got "
            f"{control_mode!r}{did_you_mean(control_mode, CONTROL_MODES)}; ManiSkill's others go with gymnasium.make"
        )
    check_integer("num_envs", num_envs, 1)
    steps = task.max_episode_steps if max_episode_steps is None else max_episode_steps
    check_integer("max_episode_steps", steps, 1)
    mode = str(getattr(autoreset_mode, "value", autoreset_mode))
    check_choice("autoreset_mode", mode, [m.value for m in AutoresetMode])
    if torch.device(device).type == "cuda" and not torch.cuda.is_available():
        raise InvalidInputError(
            "device='cuda' needs an NVIDIA GPU with its driver; leave it out to use the processor"
        )
    images = ImageLayout.parse(obs_mode, image_size)
    if images is not None:
        if eyes is not None:
            raise InvalidInputError("give obs_mode= or eyes=, not both")
        if images.needs_colours:
            raise InvalidInputError(
                f"obs_mode={obs_mode!r} needs a renderer for its colours; use gymnasium.make, or "
                "'depth+segmentation', which needs none"
            )
        eyes = LearnerEyes(images=images)
    world = make_world(
        env_id,
        num_envs,
        device,
        control=CONTROL_MODES[control_mode] if control_mode else None,
        growers=growers,
        **options,
    )
    return VectorEnv(
        world, steps, autoreset_mode=AutoresetMode(mode), arrays=arrays, env_id=env_id, eyes=eyes
    )


def _check_vector_options(env_id: str, options: Mapping[str, Any]) -> None:
    check_other_tasks(env_id, options)
    known = option_names(env_id) | set(make_vector_env.__kwdefaults__ or ()) | {"device"}
    for name in options:
        if name not in known:
            raise InvalidInputError(
                f"{env_id} without a simulator has no option {name!r}{did_you_mean(name, known)}; it takes "
                f"{', '.join(sorted(known))}. What only a simulator has, such as colours and physics, goes with "
                "gymnasium.make"
            )
