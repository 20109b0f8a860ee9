"""The package as it is installed: complete, free of generic names, light to import."""

import fnmatch
import importlib.util
import json
import re
import subprocess
import sys
import tomllib
from importlib.metadata import distributions, entry_points, metadata
from pathlib import Path
from typing import Any

import pytest

import maniskill_tomato
from maniskill_tomato.assets import ASSETS_DIR, asset_path

ROOT = Path(__file__).resolve().parent.parent
MAPPED_FOLDERS = ("assets", "deploy", "tasks")
"""Folders at the root of the repository that install as subpackages of maniskill_tomato."""

CV2_WHEELS = (
    "opencv-python",
    "opencv-contrib-python",
    "opencv-python-headless",
    "opencv-contrib-python-headless",
)

needs_checkout = pytest.mark.skipif(
    not (ROOT / "pyproject.toml").is_file(), reason="the tests run outside a checkout"
)


def setuptools_table() -> dict[str, Any]:
    with (ROOT / "pyproject.toml").open("rb") as file:
        table: dict[str, Any] = tomllib.load(file)["tool"]["setuptools"]
    return table


def folders_with_code() -> set[str]:
    """The dotted names that the folders with an `__init__.py` must install under; links are not followed."""
    names = set()
    for top in ("maniskill_tomato", *MAPPED_FOLDERS):
        prefix = "" if top == "maniskill_tomato" else "maniskill_tomato."
        folder = ROOT / top
        if not folder.is_dir():
            continue
        for init in folder.rglob("__init__.py"):
            relative = init.parent.relative_to(ROOT)
            if any((ROOT / Path(*relative.parts[: i + 1])).is_symlink() for i in range(len(relative.parts))):
                continue
            names.add(prefix + ".".join(relative.parts))
    return names


def run_python(code: str, *options: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *options, "-c", code], capture_output=True, text=True, cwd=cwd, timeout=300
    )


@needs_checkout
def test_every_folder_with_code_is_listed_in_pyproject() -> None:
    assert set(setuptools_table()["packages"]) == folders_with_code()


@needs_checkout
def test_python_files_sit_only_in_folders_that_are_packages() -> None:
    homeless = [
        path.relative_to(ROOT)
        for top in ("maniskill_tomato", *MAPPED_FOLDERS)
        for path in (ROOT / top).rglob("*.py")
        if not (path.parent / "__init__.py").is_file()
    ]
    assert homeless == [], "these modules would be missing from the wheel"


@needs_checkout
def test_every_file_beside_the_code_is_covered_by_package_data() -> None:
    patterns = setuptools_table()["package-data"]
    forgotten = []
    for top, package in (("maniskill_tomato", "maniskill_tomato"), ("assets", "maniskill_tomato.assets")):
        for path in (ROOT / top).rglob("*"):
            if path.suffix in {".py", ".pyc"} or not path.is_file() or path.name == ".gitignore":
                continue
            relative = path.relative_to(ROOT / top).as_posix()
            # setuptools reads `**/` as "in this folder or any below it".
            candidates = [
                pattern.removeprefix("**/") for pattern in patterns[package] if pattern.startswith("**/")
            ]
            own = ".".join((package, *path.relative_to(ROOT / top).parent.parts))
            candidates += patterns.get(own, []) if own != package else []
            matched = any(fnmatch.fnmatch(path.name, pattern) for pattern in candidates)
            if not matched and relative not in patterns[package]:
                forgotten.append(f"{top}/{relative}")
    assert forgotten == [], "these files would be missing from the wheel; see [tool.setuptools.package-data]"


@needs_checkout
@pytest.mark.parametrize("name", ["assets", "tasks"])
def test_mapped_folders_are_linked_into_the_package_for_static_analysis(name: str) -> None:
    link = ROOT / "maniskill_tomato" / name
    assert link.is_symlink()
    assert link.readlink() == Path("..") / name


@pytest.mark.parametrize("name", MAPPED_FOLDERS)
def test_generic_names_are_not_importable_from_elsewhere(name: str, tmp_path: Path) -> None:
    result = run_python(f"import {name}", "-I", cwd=tmp_path)
    assert result.returncode != 0
    assert f"No module named '{name}'" in result.stderr


@needs_checkout
@pytest.mark.parametrize("name", ["assets", "tasks"])
def test_importing_a_mapped_folder_by_its_short_name_says_what_to_write_instead(name: str) -> None:
    result = run_python(f"import {name}", cwd=ROOT)
    assert result.returncode != 0
    assert f"imported as '{name}'; import `maniskill_tomato.{name}` instead" in result.stderr


def test_subpackages_are_one_module_each_not_two_copies(tmp_path: Path) -> None:
    code = (
        "import os, sys, maniskill_tomato.tasks, maniskill_tomato.assets\n"
        "root = os.path.realpath(os.path.dirname(maniskill_tomato.assets.__file__) + '/..')\n"
        "modules = [(n, m.__file__) for n, m in sys.modules.items() if getattr(m, '__file__', None)]\n"
        "files = {n: os.path.realpath(f) for n, f in modules}\n"
        "names = [n for n, f in files.items() if f.startswith((root + '/tasks/', root + '/assets/'))]\n"
        "assert len(names) >= 2 and all(n.startswith('maniskill_tomato.') for n in names), names\n"
    )
    result = run_python(code, "-I", cwd=tmp_path)
    assert result.returncode == 0, result.stderr


def test_importing_the_package_loads_none_of_the_heavy_libraries(tmp_path: Path) -> None:
    code = (
        "import json, sys, maniskill_tomato\n"
        "heavy = {'torch', 'sapien', 'mani_skill', 'warp', 'mujoco', 'cv2'}\n"
        "print(json.dumps(sorted(heavy & set(sys.modules))))\n"
    )
    result = run_python(code, "-I", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == []


def test_the_package_is_marked_as_typed() -> None:
    assert (Path(maniskill_tomato.__file__).parent / "py.typed").is_file()


def test_the_robot_description_is_an_asset_that_can_be_opened_by_path() -> None:
    text = asset_path("iiwa14/iiwa14.urdf").read_text(encoding="utf-8")
    assert "<robot" in text


def test_an_unknown_asset_is_refused_with_the_folder_and_its_content() -> None:
    with pytest.raises(FileNotFoundError, match="'iiwa15.urdf' not found in .*iiwa14") as caught:
        asset_path("iiwa15.urdf")
    assert str(ASSETS_DIR) in str(caught.value)


def test_assets_are_real_files_under_the_size_limit() -> None:
    sizes = {path: path.stat().st_size for path in ASSETS_DIR.rglob("*") if path.is_file()}
    # Segmenters see pictures: their weights are larger than anything else.
    limits = {path: 20_000_000 if path.parent.name == "perception" else 5_000_000 for path in sizes}
    assert {path.name: size for path, size in sizes.items() if size > limits[path]} == {}


def test_the_console_command_is_declared() -> None:
    (entry,) = entry_points(group="console_scripts", name="maniskill-tomato")
    assert entry.value == "maniskill_tomato.cli:main"


@needs_checkout
def test_the_citation_names_this_version_and_the_authors_of_the_package() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    about = metadata("maniskill-tomato")
    lines = (
        f"version: {maniskill_tomato.__version__}",
        f"license: {about['License-Expression']}",
        f"  - name: {about['Author']}",
    )
    assert [line for line in lines if line not in citation] == []
    assert about["Author"] in (ROOT / "LICENSE").read_text(encoding="utf-8")


def test_gymnasium_entry_point_is_not_declared() -> None:
    # Gymnasium 1.0 dropped it; declaring it would only mislead.
    assert not [entry for entry in entry_points(group="gymnasium.envs") if "tomato" in entry.value]


def test_exactly_one_wheel_brings_cv2_and_it_is_the_headless_one() -> None:
    names = {str(d.metadata["Name"]).lower().replace("_", "-") for d in distributions()}
    assert names & set(CV2_WHEELS) == {"opencv-python-headless"}


@pytest.mark.skipif(
    importlib.util.find_spec("torchvision") is None, reason="the perception extra is not installed"
)
def test_torchvision_operators_load_into_the_installed_torch() -> None:
    import torch
    from torchvision.ops import nms

    boxes = torch.tensor([[0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 2.0, 2.0], [5.0, 5.0, 6.0, 6.0]])
    # The second box equals the first and has the higher score, so it alone survives beside the third.
    assert nms(boxes, torch.tensor([0.3, 0.9, 0.5]), 0.5).tolist() == [1, 2]


@needs_checkout
def test_pictures_of_the_readme_ship_with_the_source_and_the_text_stands_without_them() -> None:
    # A page of a package index shows no relative picture, and there is no host that an address could name.
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", readme)
    assert pictures
    for told, path in pictures:
        assert len(told.split()) >= 3, f"{path} needs words for those who do not see it"
        assert path.startswith("docs/images/") and (ROOT / path).stat().st_size <= 500_000
    assert "graft docs" in (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines()
    assert "The pictures lie in `docs/images` of the source." in readme


@needs_checkout
@pytest.mark.parametrize(
    "name", ["constraints.txt", "overrides.txt", "overrides-cpu.txt", "overrides-robot.txt"]
)
def test_pinned_requirements_name_versions_and_never_an_address(name: str) -> None:
    lines = [line for line in (ROOT / name).read_text().splitlines() if line and not line.startswith("#")]
    assert lines
    for line in lines:
        assert "://" not in line and "@" not in line and not line.startswith("-"), line
        if name == "constraints.txt":
            assert line.count("==") == 1, line


@needs_checkout
def test_constraints_hold_every_direct_dependency() -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    pinned = {
        line.split("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    }
    requirements = list(project["dependencies"])
    for extra in ("dev", "docs", "lerobot", "perception", "ray", "sb3"):
        requirements += project["optional-dependencies"][extra]
    names = {requirement.split(">")[0].split("=")[0].split("[")[0].strip() for requirement in requirements}
    assert names - pinned == {project["name"]}, (
        "only the package itself, by which dev takes in docs, has no pin"
    )
