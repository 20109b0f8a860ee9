"""The checks of what a user may pass to `gymnasium.make`: every refusal names the allowed values."""

import math
from collections.abc import Iterable, Sequence
from typing import Literal, get_args

import torch
from mani_skill.envs.utils.observations import ALL_VISUAL_TEXTURES

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.rendering.vulkan_probe import NO_RENDERING_HINT

Motion = Literal["kinematic", "dynamic"]

PLAIN_OBS_MODES = ("state", "state_dict", "none", "sensor_data", "pointcloud")
REWARD_MODES = ("dense", "normalized_dense", "sparse", "none")
RENDER_MODES = ("human", "rgb_array", "sensors", "all")


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


def check_choice(name: str, value: str | None, allowed: Iterable[str]) -> None:
    """Accepts None and the `allowed` values of the option `name`."""
    if value is not None and value not in tuple(allowed):
        raise InvalidInputError.choice(name, value, allowed)


def check_motion(motion: str) -> None:
    """Accepts the values of `Motion`."""
    check_choice("motion", motion, get_args(Motion))


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


def check_rays_per_side(rays_per_side: int) -> None:
    """Accepts 4 to 256."""
    if isinstance(rays_per_side, bool) or not isinstance(rays_per_side, int) or not 4 <= rays_per_side <= 256:
        raise InvalidInputError(f"rays_per_side must be an integer from 4 to 256; got {rays_per_side!r}")


def check_other_targets(count: object) -> None:
    """Accepts how many other fruits are judged."""
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        raise InvalidInputError(f"other_targets must be an integer of 0 or more, got {count!r}")


def check_half_ranges(name: str, values: Sequence[float], size: int) -> tuple[float, ...]:
    """`values` as `size` finite numbers of 0 or more."""
    try:
        numbers = tuple(float(v) for v in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != size or not all(math.isfinite(v) and v >= 0.0 for v in numbers):
        raise InvalidInputError(f"{name} must be {size} finite numbers of 0 or more; got {values!r}")
    return numbers


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


def rendering_failure(error: RuntimeError) -> str | None:
    """What to tell a user whose SAPIEN raised this because it cannot draw; None if it is about something else."""
    text = str(error).lower()
    if "window" in text or "display" in text:
        return (
            f"render_mode='human' opens a window, but there is no display ({error}); use render_mode='rgb_array', "
            "or start the program under xvfb-run"
        )
    if any(word in text for word in ("render", "vulkan", "vk::", "find device", "find a device")):
        return f"{NO_RENDERING_HINT}; obs_mode='state' with render_mode=None needs none ({error})"
    return None


def check_range(name: str, values: Sequence[float]) -> tuple[float, float]:
    """`values` as two finite numbers, the first below the second."""
    try:
        numbers = tuple(float(v) for v in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != 2 or not all(math.isfinite(v) for v in numbers) or numbers[0] >= numbers[1]:
        raise InvalidInputError(f"{name} must be a range (low, high) of finite numbers; got {values!r}")
    return numbers[0], numbers[1]
