"""Every piece of Python that the documentation shows runs as it stands, after what its page takes for granted."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import maniskill_tomato  # noqa: F401  The snippets make its tasks.
from maniskill_tomato.assets import asset_path
from maniskill_tomato.deploy.profile_files import profile_path
from maniskill_tomato.policies.registry import SHIPPED_FILES

ROOT = Path(__file__).resolve().parent.parent
PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
SNIPPETS = {
    f"{page.relative_to(ROOT)}-{k}": code
    for page in PAGES
    for k, code in enumerate(
        re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    )
}
GYM = "import gymnasium as gym"
BEFORE = {
    "docs/detection.md-0": "import numpy as np; image = np.zeros((48, 64, 3), np.uint8)",
    "docs/export.md-0": "import numpy as np; observations = np.zeros((2, 9), np.float32)",
    "docs/hardware.md-0": (
        f"{GYM}; import numpy as np\n"
        "from maniskill_tomato.deploy.profile import load_profile\n"
        "from maniskill_tomato.deploy.real_agent import IiwaRealAgent\n"
        "from maniskill_tomato.deploy.sim2real import TomatoSim2RealEnv\n"
        "from maniskill_tomato.deploy.workcell import make_workcell\n"
        "action = np.array([0.1, 0.0, 0.0], np.float32)"
    ),
    "docs/planners.md-0": (
        "from maniskill_tomato.tasks.vector_env import make_vector_env\n"
        "env = make_vector_env('TomatoViewpoint-v1', num_envs=1); env.reset(seed=0)"
    ),
    "docs/plants.md-1": GYM,
    "docs/plants.md-2": GYM,
}
"""What a page has told before a snippet, or leaves to the reader."""

RENDERS = ("README.md-0",)
"""Snippets that ask for pictures."""


def write_vine(path: Path, scale: float, fruit: str, to_file: NDArray[np.float64]) -> None:
    """A small plant as another program would write it: a stem, leaves in rows, one fruit between them.

    Args:
        path: A GLB or OBJ.
        scale: Units of the file in a metre.
        fruit: Name of the fruit.
        to_file: Turns z up into the file's axes. Shape (4, 4).
    """
    stem = trimesh.creation.cylinder(0.006, segment=([0.0, 0.0, 0.0], [0.0, 0.0, 1.2]))
    parts = {"stem": stem, fruit: trimesh.creation.icosphere(2, 0.03).apply_translation([-0.06, 0.0, 0.8])}
    for k, (y, z) in enumerate((y, z) for y in (-0.12, 0.0, 0.12) for z in (0.7, 0.8, 0.9)):
        leaf = trimesh.creation.box((0.004, 0.1, 0.09)).apply_translation([-0.13, y, z])
        parts[f"leaf_{k}"] = leaf
    scene = trimesh.Scene(
        {name: mesh.apply_scale(scale).apply_transform(to_file) for name, mesh in parts.items()}
    )
    scene.export(path)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with the files that the snippets name."""
    monkeypatch.chdir(tmp_path)
    for run, asset in (
        ("general", SHIPPED_FILES["view_quality"]),
        ("guided", "policies/TomatoViewpointGuided-v1.pt"),
    ):
        (tmp_path / "runs" / run).mkdir(parents=True)
        shutil.copy(asset_path(asset), tmp_path / "runs" / run / "policy.pt")
    shutil.copy(profile_path("mock"), tmp_path / "lab.toml")
    y_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    (tmp_path / "foreign" / "validation").mkdir(parents=True)
    for place in (tmp_path, tmp_path / "foreign" / "validation"):
        write_vine(place / "vine.glb", 1.0, "tomato", y_up)
    write_vine(tmp_path / "vine.obj", 100.0, "ball_1", y_up)
    return tmp_path


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.render) if name in RENDERS else name for name in SNIPPETS],
)
def test_a_snippet_runs(name: str, folder: Path) -> None:
    if name == "docs/export.md-0":
        from maniskill_tomato.cli import main

        main(["export", "--policy", "runs/guided/policy.pt", "--out", "exported"])
    space: dict[str, Any] = {"__name__": "snippet"}
    exec(BEFORE.get(name, ""), space)
    exec(compile(SNIPPETS[name], name, "exec"), space)
    for value in space.values():
        if callable(close := getattr(value, "close", None)) and not isinstance(value, type):
            close()


def test_what_pages_take_for_granted_belongs_to_a_snippet() -> None:
    assert {*BEFORE, *RENDERS} <= SNIPPETS.keys()
