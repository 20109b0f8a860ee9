"""`doctor`: whether this machine has what the package needs, and the command that mends what is wrong.

Each check loads what it checks itself, so that a broken package is one line of the answer.
"""

import importlib
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final, Literal

import tyro

from maniskill_tomato.errors import UnsoundEnvironmentError

CV2_WHEELS: Final = (
    "opencv-python",
    "opencv-contrib-python",
    "opencv-python-headless",
    "opencv-contrib-python-headless",
)
"""Every wheel that brings a `cv2`; two of them overwrite each other's files."""

LEAST_DISK: Final = 2.0
"""Free space for runs, in [GB]: a training with its checkpoints takes up to 1."""

REBUILD: Final = "make the environment anew: rm -rf .venv && make venv, with the TORCH and KIND that it had"


@dataclass(frozen=True)
class Finding:
    """What a check found."""

    state: Literal["ok", "note", "problem"]
    """A note is something that is not there and that only some commands need."""
    words: str
    remedy: str = ""
    """What mends it, or what needs it."""

    @property
    def lines(self) -> str:
        """For the terminal."""
        told = f"{self.state:<9}{self.words}"
        return f"{told}\n{'':<9}-> {self.remedy}" if self.remedy else told


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Say whether this machine has what the package needs; for each problem, what mends it.

    Exit status 1 if there is a problem. A note is something that is not there and that only some commands need.
    """

    packages: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Check the installed packages alone: seconds, and nothing about the machine."""

    def run(self) -> None:
        """Prints a line or two for every check.

        Raises:
            UnsoundEnvironmentError: One of them found a problem.
        """
        problems = 0
        for check in PACKAGE_CHECKS if self.packages else (*PACKAGE_CHECKS, *MACHINE_CHECKS):
            try:
                finding = check()
            except Exception as error:  # A damaged package may fail in any way, which is what was asked.
                finding = Finding("problem", f"{_title(check)}: {type(error).__name__}: {error}", REBUILD)
            print(finding.lines, flush=True)
            problems += finding.state == "problem"
        if problems:
            raise UnsoundEnvironmentError(
                f"{problems} problem{'s' if problems > 1 else ''}; the lines above say what to do"
            )


def check_python() -> Finding:
    """The interpreter."""
    return Finding("ok", f"Python {platform.python_version()} ({sys.prefix})")


def check_cv2() -> Finding:
    """Exactly one wheel brings cv2, and it is the headless one."""
    wheels = [f"{name} {found}" for name in CV2_WHEELS if (found := _version(name))]
    if [wheel.split()[0] for wheel in wheels] != ["opencv-python-headless"]:
        told = ", ".join(wheels) or "none"
        return Finding(
            "problem", f"cv2 must come from opencv-python-headless alone; installed: {told}", REBUILD
        )
    if not hasattr(importlib.import_module("cv2"), "imdecode"):
        return Finding("problem", "cv2 is damaged (was another cv2 removed over it?)", REBUILD)
    return Finding("ok", f"cv2 from {wheels[0]}")


def check_torch() -> Finding:
    """PyTorch loads, and torchvision's compiled operators load into it."""
    import torch

    if find_spec("torchvision") is None:
        return Finding("ok", f"torch {torch.__version__}")
    try:
        from torchvision.ops import nms
    except (ImportError, RuntimeError) as error:
        return Finding(
            "problem", f"torch {torch.__version__} and torchvision differ in kind ({error})", REBUILD
        )
    boxes = torch.tensor([[0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0]])
    kept = nms(boxes, torch.tensor([0.2, 0.9]), 0.5).tolist()
    if kept != [1]:
        return Finding("problem", f"torchvision.ops.nms gives {kept} instead of [1]", REBUILD)
    return Finding("ok", f"torch {torch.__version__} with torchvision {version('torchvision')}")


def check_maniskill() -> Finding:
    """ManiSkill and SAPIEN load, where they are installed."""
    if find_spec("mani_skill") is None:
        return Finding(
            "note",
            "ManiSkill is not installed, as on a robot's PC: worlds, training, play, detect and deploy work without",
            "gym.make, dataset and films need it: make venv KIND=full, or pip install maniskill-tomato",
        )
    importlib.import_module("mani_skill.envs")
    return Finding("ok", f"mani-skill {version('mani-skill')} with sapien {version('sapien')}")


def check_tasks() -> Finding:
    """The import of the package registers its tasks."""
    gymnasium = importlib.import_module("gymnasium")
    package = importlib.import_module("maniskill_tomato")
    ids = sorted(env_id for env_id in gymnasium.registry if env_id.startswith("TomatoViewpoint"))
    if not ids:
        return Finding("problem", "`import maniskill_tomato` registers no task", REBUILD)
    return Finding("ok", f"maniskill-tomato {package.__version__} with {', '.join(ids)}")


def check_kernels() -> Finding:
    """Warp compiles kernels into a folder that it may write."""
    import warp as wp

    from maniskill_tomato.warp_runtime import CACHE_VARIABLE, start_warp

    remedy = f"set {CACHE_VARIABLE} to a folder that may be written"
    named = os.environ.get(CACHE_VARIABLE)
    folder = named or "its folder"
    try:
        start_warp()
        folder = wp.config.kernel_cache_dir
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, UnsoundEnvironmentError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        reason = getattr(cause, "strerror", error)
        return Finding("problem", f"warp cannot keep its kernels in {folder} ({reason})", remedy)
    if os.environ.get(CACHE_VARIABLE) != named:
        return Finding("note", f"warp {wp.config.version} compiles its kernels anew in every run", remedy)
    return Finding("ok", f"warp {wp.config.version}, kernels in {folder}")


def check_cuda() -> Finding:
    """A GPU that PyTorch can use."""
    import torch

    if torch.cuda.is_available():
        names = [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
        return Finding("ok", f"CUDA {torch.version.cuda}: {', '.join(names)}")
    if os.path.exists("/dev/nvidiactl") and torch.version.cuda is None:
        return Finding(
            "note",
            f"there is an NVIDIA GPU, which torch {torch.__version__}, built for the CPU, does not use",
            "make venv TORCH=cuda",
        )
    if os.path.exists("/dev/nvidiactl"):
        return Finding(
            "problem",
            f"there is an NVIDIA GPU, but torch {torch.__version__} cannot use it",
            "see whether nvidia-smi works, and whether its driver is new enough for this torch",
        )
    return Finding("note", "no CUDA device: everything runs on the processor")


def check_vulkan() -> Finding:
    """SAPIEN takes a picture."""
    if find_spec("sapien") is None:
        return Finding("note", "no SAPIEN, so nothing is rendered; depth and labels are cast without it")
    from maniskill_tomato.rendering.vulkan_probe import render_backend, rendering_problem

    problem = rendering_problem()
    if problem is not None:
        return Finding("problem", problem, "" if "`make vulkan`" in problem else "make vulkan")
    return Finding("ok", f"Vulkan renders on the {render_backend().upper()}")


def check_disk() -> Finding:
    """Space where runs are written."""
    free = shutil.disk_usage(".").free / 1e9
    told = f"{free:.1f} GB free in {Path.cwd()}"
    if free < LEAST_DISK:
        return Finding(
            "problem", told, f"make room, or give --out a folder elsewhere; runs need {LEAST_DISK:g} GB"
        )
    return Finding("ok", told)


def check_cameras() -> Finding:
    """RealSense cameras that are plugged in."""
    if find_spec("pyrealsense2") is None:
        return Finding(
            "note",
            "pyrealsense2 is not installed",
            'a RealSense camera needs it: pip install "maniskill-tomato[hardware]"',
        )
    from maniskill_tomato.deploy.realsense.source import connected_serials, load_sdk

    sdk = load_sdk()
    found = connected_serials(sdk, sdk.context())
    if not found:
        return Finding("note", "no RealSense camera is plugged in")
    return Finding("ok", f"RealSense: {', '.join(found)}")


PACKAGE_CHECKS: Final[tuple[Callable[[], Finding], ...]] = (
    check_python,
    check_cv2,
    check_torch,
    check_maniskill,
    check_tasks,
)

MACHINE_CHECKS: Final[tuple[Callable[[], Finding], ...]] = (
    check_kernels,
    check_cuda,
    check_vulkan,
    check_disk,
    check_cameras,
)


def _title(check: Callable[[], Finding]) -> str:
    return check.__name__.removeprefix("check_")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
