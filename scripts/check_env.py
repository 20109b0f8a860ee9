"""Says whether the environment is sound: one cv2, torch and torchvision of one kind, SAPIEN, the tasks.

Usage:
    .venv/bin/python scripts/check_env.py
"""

import importlib
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version

CV2_WHEELS = (
    "opencv-python",
    "opencv-contrib-python",
    "opencv-python-headless",
    "opencv-contrib-python-headless",
)
"""Every wheel that brings a `cv2`; two of them overwrite each other's files."""

REBUILD = "make the environment anew: rm -rf .venv && make venv"


class EnvironmentProblem(Exception):
    """Something is wrong with the environment; the message says what to do."""


def installed(names: Sequence[str]) -> list[str]:
    """Those of the distributions `names` that are installed, as `name version`."""
    found = []
    for name in names:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return found


def check_cv2() -> str:
    """Exactly one wheel brings cv2, and it is the headless one."""
    wheels = installed(CV2_WHEELS)
    if [wheel.split()[0] for wheel in wheels] != ["opencv-python-headless"]:
        raise EnvironmentProblem(
            "cv2 must come from opencv-python-headless alone, "
            f"but these are installed: {', '.join(wheels) or 'none'}; {REBUILD}"
        )
    import cv2

    if not hasattr(cv2, "imdecode"):
        raise EnvironmentProblem(f"cv2 is damaged (another cv2 was removed over it?); {REBUILD}")
    return f"cv2 from {wheels[0]}"


def check_torch() -> str:
    """torchvision's compiled operators load into this torch."""
    import torch

    try:
        from torchvision.ops import nms
    except (ImportError, RuntimeError) as error:
        raise EnvironmentProblem(
            f"torch {torch.__version__} and torchvision differ in kind ({error}); {REBUILD}"
        ) from error
    boxes = torch.tensor([[0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0]])
    kept = nms(boxes, torch.tensor([0.2, 0.9]), 0.5)
    if kept.tolist() != [1]:
        raise EnvironmentProblem(f"torchvision.ops.nms gives {kept.tolist()} instead of [1]; {REBUILD}")
    return f"torch {torch.__version__} with torchvision {version('torchvision')}"


def check_sapien() -> str:
    """SAPIEN and ManiSkill load."""
    try:
        importlib.import_module("mani_skill.envs")
    except ImportError as error:
        raise EnvironmentProblem(f"ManiSkill does not load ({error}); {REBUILD}") from error
    return f"mani-skill {version('mani-skill')} with sapien {version('sapien')}"


def check_tasks() -> str:
    """The tasks are registered by the package's import."""
    gymnasium = importlib.import_module("gymnasium")
    package = importlib.import_module("maniskill_tomato")
    ids = sorted(env_id for env_id in gymnasium.registry if env_id.startswith("TomatoViewpoint"))
    if not ids:
        raise EnvironmentProblem(f"`import maniskill_tomato` registers no task; {REBUILD}")
    return f"maniskill-tomato {package.__version__} with {', '.join(ids)}"


def main() -> int:
    checks: tuple[Callable[[], str], ...] = (check_cv2, check_torch, check_sapien, check_tasks)
    status = 0
    for check in checks:
        try:
            print(f"  ok: {check()}")
        except EnvironmentProblem as problem:
            print(f"  problem: {problem}", file=sys.stderr)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main())
