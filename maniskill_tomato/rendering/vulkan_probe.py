"""Whether this machine can render: asked of SAPIEN in another process, because it may crash there."""

import functools
import logging
import os
import subprocess
import sys
from importlib.util import find_spec
from typing import Literal

from maniskill_tomato.errors import MissingPackageError

logger = logging.getLogger(__name__)

PROBE_TIMEOUT_SECONDS = 180.0
"""A picture with the smallest shaders takes a second or two."""

NO_RENDERING_HINT = (
    "No Vulkan device that SAPIEN can use was found; `make vulkan` installs one that runs on the CPU "
    "(Debian and Ubuntu)"
)

_PROBE = """
import sys
import sapien
sapien.render.set_camera_shader_dir("trivial")
system = sapien.render.RenderSystem(sapien.Device(sys.argv[1]))
scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), system])
camera = scene.add_camera("probe", 8, 8, 1.0, 0.1, 1.0)
scene.update_render()
camera.take_picture()
print("picture", camera.get_picture("Color").shape)
"""


def rendering_available() -> bool:
    """Whether ManiSkill can take pictures here, on the GPU or on the CPU."""
    return rendering_problem() is None


def rendering_problem() -> str | None:
    """Why ManiSkill can take no pictures here and what to do; None if it can."""
    if find_spec("sapien") is None:
        return str(MissingPackageError.simulator())
    if render_backend() != "none":
        return None
    answer = _ask_for_a_picture("cpu")
    words = answer.lower()
    if any(word in words for word in ("vk::", "vulkan", "find device", "find a device")):
        return _hidden_drivers() or f"{NO_RENDERING_HINT} ({answer})"
    return f"SAPIEN cannot take a picture here ({answer})"


def _hidden_drivers() -> str | None:
    """Says which variable names drivers that are not there, so that Vulkan sees none at all."""
    for variable in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        named = [path for path in os.environ.get(variable, "").split(os.pathsep) if path]
        if named and not any(os.path.exists(path) for path in named):
            return (
                f"Vulkan sees no driver, because {variable} names files that are not there ({', '.join(named)}); "
                f"`unset {variable}`, and if there is no driver then, `make vulkan` installs one"
            )
    return None


@functools.cache
def render_backend() -> Literal["gpu", "cpu", "none"]:
    """The value of ManiSkill's `render_backend` that works here; `none` if there is no usable Vulkan device.

    The answer is found once per process by taking a tiny picture in a process of its own, with SAPIEN's smallest
    shaders: the usual ones need the same device and compile for about ten seconds. A machine that is too busy to answer
    in time may still render, so that `cpu` is the answer there, with a warning.
    """
    if find_spec("sapien") is None:
        return "none"
    if sys.platform.startswith("linux") and os.path.exists("/dev/nvidiactl"):
        try:
            if not _ask_for_a_picture("cuda"):
                return "gpu"
        except subprocess.TimeoutExpired:
            logger.warning(
                "a test picture on the GPU took over %.0f s; the CPU is asked instead", PROBE_TIMEOUT_SECONDS
            )
    try:
        return "none" if _ask_for_a_picture("cpu") else "cpu"
    except subprocess.TimeoutExpired:
        logger.warning(
            "a test picture took over %.0f s: this machine is busy, or its Vulkan driver hangs; rendering is tried "
            "all the same",
            PROBE_TIMEOUT_SECONDS,
        )
        return "cpu"


@functools.cache
def _ask_for_a_picture(device: str) -> str:
    """Why SAPIEN takes no picture on a device; empty if it takes one."""
    command = [sys.executable, "-c", _PROBE, device]
    result = subprocess.run(
        command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_SECONDS, check=False
    )
    if result.returncode == 0 and "picture" in result.stdout:
        return ""
    lines = result.stderr.strip().splitlines() or [f"exit status {result.returncode}"]
    logger.debug("SAPIEN cannot render on %s: %s", device, lines[-1])
    return lines[-1]
