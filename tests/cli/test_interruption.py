"""Ctrl-C ends a command wherever it comes."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

SWALLOWING = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.2)
except BaseException:
    print("swallowed", flush=True)
"""
"""A package that takes an interrupt for one of its optional packages that is missing, as trimesh does."""

COMMAND = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # A shell in the background leaves it ignored.
from maniskill_tomato import cli

def run(argv):
    import trimesh
    time.sleep(20)
    print("went on")

cli.run = run
cli.main([])
"""


def test_an_interrupt_during_an_import_that_would_swallow_it_ends_the_command(tmp_path: Path) -> None:
    (tmp_path / "trimesh.py").write_text(SWALLOWING)
    done = subprocess.run(
        [sys.executable, "-c", COMMAND],
        env={"PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "stopped\n")
