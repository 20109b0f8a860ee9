"""Where Warp's kernels go on a machine whose home may not be written."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

START = """
import os
from pathlib import Path
from maniskill_tomato.warp_runtime import CACHE_VARIABLE, start_warp
start_warp()
print(os.environ[CACHE_VARIABLE], Path(os.environ[CACHE_VARIABLE]).is_dir())
"""


def start(**environment: str) -> subprocess.CompletedProcess[str]:
    cleared = {
        key: value for key, value in os.environ.items() if key not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")
    }
    return subprocess.run(
        [sys.executable, "-c", START],
        env={**cleared, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_a_home_that_cannot_be_written_costs_the_kernels_and_not_the_run() -> None:
    done = start(HOME=f"{os.devnull}/home")
    assert done.returncode == 0, done.stderr
    folder, was_there = done.stdout.split()
    assert was_there == "True" and not Path(folder).exists()
    assert "set WARP_CACHE_PATH to a folder that may be written" in done.stderr


def test_a_folder_that_was_asked_for_and_cannot_be_written_is_refused_with_the_remedy() -> None:
    done = start(WARP_CACHE_PATH=f"{os.devnull}/kernels")
    assert done.returncode == 1
    assert f"warp cannot keep its kernels in {os.devnull}/kernels" in done.stderr.splitlines()[-1]
