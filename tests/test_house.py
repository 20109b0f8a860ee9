"""The map of the house in CONTRIBUTING.md, checked against the imports of every module."""

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "maniskill_tomato"
MAPPED_FOLDERS = ("assets", "deploy", "tasks")
"""Folders at the root of the repository that install as subpackages of maniskill_tomato."""

FOUNDATION = frozenset(
    {
        "array_files",
        "assets",
        "errors",
        "extension_points",
        "files",
        "folder_lock",
        "network_weights",
        "report_design",
        "report_plots",
        "run_facts",
        "tables",
        "task_registry",
        "text_files",
        "version",
        "warp_runtime",
        "ray_jobs",
        "worker_pool",
    }
)
"""What every room may import: files of arrays, asset files, errors, files on the disk, locks of folders, weights put
into a network, the look of reports and plots, how a result came about, tables of TOML and JSON, tasks by ID, the reader
of such files, the version, the start of Warp, the pool of processes."""

WORLD = FOUNDATION | {"robot", "plants", "raycast"}
SENSES = WORLD | {"segmentation", "sensing"}

ALLOWED: dict[str, frozenset[str]] = {
    "assets": frozenset(),
    "robot": FOUNDATION,
    "plants": FOUNDATION,
    "raycast": FOUNDATION | {"robot", "plants"},
    "rendering": WORLD,
    "segmentation": WORLD | {"rendering"},
    "sensing": WORLD | {"segmentation"},
    "policies": SENSES,
    "deploy": SENSES | {"rendering", "policies"},
    "tasks": SENSES | {"rendering", "policies"},
    "learning": SENSES | {"policies", "tasks"},
    "experiments": SENSES | {"rendering", "policies", "tasks", "learning"},
    "view": SENSES | {"policies", "tasks", "learning", "experiments", "deploy"},
    "conversion": SENSES | {"policies", "tasks", "learning", "deploy"},
    "cli": SENSES
    | {"rendering", "policies", "tasks", "learning", "experiments", "deploy", "view", "conversion"},
}
"""The rooms that a module of each room may import, besides its own. CONTRIBUTING.md has the same in words."""

EXCEPTIONS = {
    ("deploy.sim2real", "tasks"): "ManiSkill's Sim2RealEnv compares the robot with the task's controllers",
    ("experiments.twin_comparison", "deploy"): "it runs the twin of deploy beside the simulated task",
    ("experiments.twin_inspection", "deploy"): "it inspects rows with the twin of deploy",
}
"""Single modules that may import one room more, with the reason."""

SIMULATOR_USERS = (
    "rendering",
    "segmentation.synthesis",
    "tasks.maniskill",
    "learning.rl.envs",
    "learning.rl.gymnasium_env",
    "deploy.mock.sapien_view",
    "deploy.real_agent",
    "deploy.sim2real",
)
"""Rooms and modules that may import ManiSkill or SAPIEN; everything else runs without a simulator."""

needs_checkout = pytest.mark.skipif(
    not (ROOT / "pyproject.toml").is_file(), reason="the tests run outside a checkout"
)


@cache
def modules() -> dict[str, ast.Module]:
    """The syntax tree of every module by its dotted name without the package's; links are not followed."""
    trees = {}
    for top in (PACKAGE, *MAPPED_FOLDERS):
        for path in sorted((ROOT / top).rglob("*.py")):
            relative = path.relative_to(ROOT)
            if any((ROOT / parent).is_symlink() for parent in relative.parents):
                continue
            parts = list(relative.with_suffix("").parts)
            if parts[0] == PACKAGE:
                parts = parts[1:]
            if parts[-1] == "__init__":
                parts = parts[:-1]
            trees[".".join(parts)] = ast.parse(path.read_text(encoding="utf-8"), str(path))
    return trees


@cache
def imported_names(module: str) -> frozenset[str]:
    """Full dotted names of everything that a module imports, at its top or inside its functions."""
    names: set[str] = set()
    for node in ast.walk(modules()[module]):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


def room_of(module: str) -> str:
    """The room of a module, or the module itself if it stands beside the rooms."""
    return module.partition(".")[0]


def imported_rooms(module: str) -> set[str]:
    """The rooms from which a module imports."""
    rooms = set()
    for name in imported_names(module):
        if name == PACKAGE or name == f"{PACKAGE}.__version__":
            rooms.add("version")
        elif name.startswith(f"{PACKAGE}."):
            rooms.add(room_of(name.removeprefix(f"{PACKAGE}.")))
    return rooms


@needs_checkout
def test_every_room_has_its_place_in_the_order_of_imports() -> None:
    rooms = {room_of(module) for module in modules() if "." in module}
    assert rooms <= ALLOWED.keys(), "a new room needs a line in ALLOWED and in CONTRIBUTING.md"


@needs_checkout
def test_imports_go_down_the_house_only() -> None:
    wrong = [
        f"{module} imports {room}"
        for module in modules()
        if (own := room_of(module)) in ALLOWED
        for room in sorted(imported_rooms(module) - {own} - ALLOWED[own])
        if (module, room) not in EXCEPTIONS
    ]
    assert wrong == []


@needs_checkout
def test_modules_beside_the_rooms_import_no_room() -> None:
    outside = [module for module in modules() if room_of(module) not in ALLOWED and module]
    wrong = [
        f"{module} imports {room}"
        for module in outside
        for room in sorted(imported_rooms(module) - {room_of(module)} - FOUNDATION)
    ]
    assert wrong == []


@needs_checkout
def test_every_exception_is_still_needed() -> None:
    unneeded = [
        (module, room)
        for module, room in EXCEPTIONS
        if module not in modules() or room not in imported_rooms(module)
    ]
    assert unneeded == []


def test_the_order_of_imports_has_no_circles() -> None:
    reached: set[str] = set(FOUNDATION)
    left = dict(ALLOWED)
    while ready := [room for room, below in left.items() if below <= reached | {room}]:
        for room in ready:
            reached.add(room)
            del left[room]
    assert left == {}


@needs_checkout
def test_only_the_shells_import_the_simulator() -> None:
    wrong = [
        f"{module} imports {name}"
        for module in modules()
        if not any(module == user or module.startswith(f"{user}.") for user in SIMULATOR_USERS)
        for name in sorted(imported_names(module))
        if name.partition(".")[0] in ("mani_skill", "sapien")
    ]
    assert wrong == []


@needs_checkout
def test_contributing_has_a_line_for_every_room() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rooms = {room_of(module) for module in modules() if "." in module}
    assert [room for room in sorted(rooms | {"assets"}) if f"- `{room}/`: " not in text] == []
