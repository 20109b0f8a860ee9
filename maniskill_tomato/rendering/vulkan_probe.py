"""Whether this machine can render: asked of SAPIEN in another process, because it may crash there."""

import functools
import logging
import os
import subprocess
import sys
from typing import Literal

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


@functools.cache
def rendering_available() -> bool:
    """Whether ManiSkill can take pictures here, on the GPU or on the CPU."""
    return render_backend() != "none"


@functools.cache
def render_backend() -> Literal["gpu", "cpu", "none"]:
    """The value of ManiSkill's `render_backend` that works here; `none` if there is no usable Vulkan device.

    The answer is found once per process by taking a tiny picture in a process of its own, with SAPIEN's smallest
    shaders: the usual ones need the same device and compile for about ten seconds.
    """
    if sys.platform.startswith("linux") and os.path.exists("/dev/nvidiactl") and _takes_a_picture("cuda"):
        return "gpu"
    return "cpu" if _takes_a_picture("cpu") else "none"


def _takes_a_picture(device: str) -> bool:
    command = [sys.executable, "-c", _PROBE, device]
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        logger.warning("asking SAPIEN for a picture on %s took over %.0f s", device, PROBE_TIMEOUT_SECONDS)
        return False
    works = result.returncode == 0 and "picture" in result.stdout
    if not works:
        lines = result.stderr.strip().splitlines() or [f"exit status {result.returncode}"]
        logger.info("SAPIEN cannot render on %s: %s", device, lines[-1])
    return works
