"""The checks of what ManiSkill's shell takes beside the task's options: every refusal names the allowed values."""

import re
from collections.abc import Iterable
from typing import Literal, get_args

import torch
from mani_skill.envs.utils.observations import ALL_VISUAL_TEXTURES

from maniskill_tomato.errors import InvalidInputError, did_you_mean
from maniskill_tomato.rendering.vulkan_probe import NO_RENDERING_HINT
from maniskill_tomato.tasks.making import check_choice

Motion = Literal["kinematic", "dynamic"]
Scenery = Literal["plain", "greenhouse"]

PLAIN_OBS_MODES = ("state", "state_dict", "none", "sensor_data", "pointcloud")
REWARD_MODES = ("dense", "normalized_dense", "sparse", "none")
RENDER_MODES = ("human", "rgb_array", "sensors", "all")


def check_names(env_id: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Accepts options that the task or ManiSkill has.

    Args:
        env_id: The task.
        given: The names that `gymnasium.make` was given.
        known: Those that there are.
    """
    allowed = sorted(set(known) - {"self", "args", "kwargs"})
    for name in given:
        if name not in allowed:
            raise InvalidInputError(
                f"{env_id} has no option {name!r}{did_you_mean(name, allowed)}; it takes {', '.join(allowed)}"
            )


def check_obs_mode(obs_mode: str | None) -> None:
    """Accepts ManiSkill's plain observation modes and any textures joined by `+`, `rgbd` among them."""
    if obs_mode is None or obs_mode in PLAIN_OBS_MODES:
        return
    textures = (*ALL_VISUAL_TEXTURES, "rgbd", "state", "state_dict")
    if all(part in textures for part in obs_mode.split("+")):
        return
    raise InvalidInputError(
        f"obs_mode must be one of {_listed(PLAIN_OBS_MODES)}, or textures joined by '+' out of {_listed(textures)}; "
        f"got {obs_mode!r}"
    )


def check_motion(motion: str) -> None:
    """Accepts the values of `Motion`."""
    check_choice("motion", motion, get_args(Motion))


def check_scenery(scenery: str, num_envs: int) -> None:
    """Accepts the values of `Scenery`; a glasshouse is built round one environment."""
    check_choice("scenery", scenery, get_args(Scenery))
    if scenery == "greenhouse" and num_envs > 1:
        raise InvalidInputError(
            f"scenery='greenhouse' is for pictures of one environment, got num_envs={num_envs}; use 'plain' there"
        )


def check_num_envs(num_envs: int, sim_backend: str) -> None:
    """Accepts a positive number, more than one only where ManiSkill can: in its CUDA backend."""
    if num_envs < 1:
        raise InvalidInputError(f"num_envs must be 1 or more; got {num_envs}")
    if num_envs > 1 and (sim_backend in ("cpu", "physx_cpu") or not torch.cuda.is_available()):
        raise InvalidInputError(
            f"num_envs={num_envs} needs ManiSkill's CUDA backend and a GPU; on a CPU use num_envs=1, one process each "
            "(gymnasium.vector.AsyncVectorEnv over mani_skill's CPUGymWrapper)"
        )


def needs_rendering(obs_mode: str | None, render_mode: str | None) -> bool:
    """Whether these modes make pictures."""
    return render_mode is not None or obs_mode not in (None, "state", "state_dict", "none")


def _listed(values: Iterable[str]) -> str:
    return ", ".join(repr(v) for v in values)


def pick_sim_backend(sim_backend: str, num_envs: int) -> str:
    """ManiSkill's `auto`, said outright: CUDA for several environments, the CPU for one."""
    if sim_backend == "auto":
        return "physx_cuda" if num_envs > 1 else "physx_cpu"
    return sim_backend


def pick_render_backend(render_backend: str, rendering: bool) -> str:
    """`auto` means no renderer where no picture is asked for, else the GPU if there is one, else the CPU."""
    if render_backend != "auto":
        return render_backend
    if not rendering:
        return "none"
    return "gpu" if torch.cuda.is_available() else "cpu"


def device_failure(error: RuntimeError, rendering: bool) -> str | None:
    """What to tell a user whose SAPIEN raised this for want of a device; None if it is about something else."""
    if (missing := re.search(r'failed to find device "(.*)"', str(error))) is not None:
        what = "an NVIDIA GPU with its driver" if missing[1].startswith("cuda") else "a device of that name"
        return (
            f"sim_backend or render_backend asks for {missing[1]!r}, which needs {what}; leave them out to use what "
            "this machine has"
        )
    if not rendering:
        return None
    text = str(error).lower()
    if "window" in text or "display" in text:
        return (
            f"render_mode='human' opens a window, but there is no display ({error}); use render_mode='rgb_array', "
            "or start the program under xvfb-run"
        )
    if any(word in text for word in ("render", "vulkan", "vk::", "find a device")):
        return f"{NO_RENDERING_HINT}; obs_mode='state' with render_mode=None needs none ({error})"
    return None


def pick_reconfiguration_freq(freq: int | None, *, new_actors: bool, follows_list: bool) -> int:
    """How often the scene is built anew: at every reset where new plants need new actors, else never.

    Args:
        freq: What the user wants, None for that.
        new_actors: Whether plants change and are rendered.
        follows_list: Whether episodes come from a fixed list, each with its own plant.

    Raises:
        InvalidInputError: The plants that are drawn would never, or not always, be shown.
    """
    if freq is None:
        return 1 if new_actors else 0
    if new_actors and (freq == 0 or (follows_list and freq != 1)):
        raise InvalidInputError(
            f"reconfiguration_freq={freq} would keep showing the same plant where every episode has its own; leave it "
            "out or set it to 1, or do not render (obs_mode='state', render_mode=None)"
        )
    return freq


def check_partial_reset(count: int, num_envs: int, *, builds_anew: bool) -> None:
    """Accepts a reset of some environments unless it would build the scenes of all anew.

    Args:
        count: How many are to be reset.
        num_envs: How many there are.
        builds_anew: Whether the reset builds the scenes anew.

    Raises:
        InvalidInputError: It would end the episodes of the others.
    """
    if builds_anew and count < num_envs:
        raise InvalidInputError(
            f"a reset of {count} of {num_envs} environments would build the scenes of all anew, since every episode "
            "has a plant of its own that is rendered (reconfiguration_freq=1); reset all at once, keep one plant "
            "(plant={'seed': 3}), or observe what needs no renderer (obs_mode='state', or gymnasium.make_vec with "
            "'depth+segmentation')"
        )
