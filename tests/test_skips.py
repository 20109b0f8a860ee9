"""Skips where all tests must run: a test or a module that a missing package takes along fails there."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

CONFTEST = Path(__file__).parent / "conftest.py"

LISTED = "wandb is not installed; it is an extra"
MODULE = 'import pytest\npytest.importorskip("no_such_package")\ndef test_one() -> None: ...\n'
TESTS = """
import pytest

def test_that_runs() -> None: ...

def test_that_needs_a_package() -> None:
    pytest.importorskip("no_such_package")

@pytest.mark.skipif(True, reason="never here")
def test_of_another_machine() -> None: ...

@pytest.mark.parametrize("case", [])
def test_without_a_case(case: int) -> None: ...

@pytest.mark.xfail(reason="known", strict=True)
def test_that_is_known_to_fail() -> None:
    raise AssertionError
"""


def run_tests(folder: Path, ci: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Runs tests under this project's conftest.py in a folder of their own."""
    shutil.copy(CONFTEST, folder / "conftest.py")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-ra",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        str(folder),
        *options,
    ]
    return subprocess.run(
        [*command, str(folder)],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "CI": ci, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        timeout=120,
    )


def test_a_skip_fails_where_everything_must_run_unless_it_is_listed_with_its_reason(tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text(TESTS)
    for place, reason in (
        ("learning/test_learning_wandb.py::test_the_real_package_logs_without_a_network", LISTED),
        ("deploy/test_deploy_calibration.py::test_the_closed_form_is_that_of_opencv", "too slow"),
    ):
        file, name = place.split("::")
        (tmp_path / "tests" / file).parent.mkdir(parents=True)
        (tmp_path / "tests" / file).write_text(
            f"import pytest\ndef {name}() -> None: pytest.skip({reason!r})\n"
        )
    found = run_tests(tmp_path, "true")
    assert found.returncode == 1
    assert "2 failed, 1 passed, 1 skipped, 1 xfailed, 2 errors" in found.stdout, found.stdout
    for why in ("could not import 'no_such_package'", "never here", "got empty parameter set", "too slow"):
        assert f"no skip of it with this reason is listed: {why}" in found.stdout
    elsewhere = run_tests(tmp_path, "false")
    assert elsewhere.returncode == 0 and "1 passed, 5 skipped, 1 xfailed" in elsewhere.stdout


def test_a_module_that_is_skipped_as_a_whole_fails_in_parallel_runs_too(tmp_path: Path) -> None:
    (tmp_path / "test_module.py").write_text(MODULE)
    (tmp_path / "test_some.py").write_text("def test_that_runs() -> None: ...\n")
    found = run_tests(tmp_path, "true", "-p", "xdist", "-n", "2")
    assert found.returncode not in (0, 5)
    assert "ERROR test_module.py - skipped, but no skip of it" in found.stdout, found.stdout
