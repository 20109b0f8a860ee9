"""How a result came about: the command, the version and commit, the machine, the date, how long it took."""

import contextlib
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import maniskill_tomato


@dataclass(frozen=True, kw_only=True)
class RunningCommand:
    """A command that is being run."""

    text: str
    """As one would type it."""
    began: float
    """`time.monotonic()` at its start, in [s]."""


_running: ContextVar[RunningCommand | None] = ContextVar("running_command", default=None)


@contextlib.contextmanager
def running_command(words: Sequence[str]) -> Iterator[None]:
    """Tells reports that are written meanwhile which command writes them, and since when it has run.

    Args:
        words: The command with its arguments.
    """
    token = _running.set(RunningCommand(text=shlex.join(words), began=time.monotonic()))
    try:
        yield
    finally:
        _running.reset(token)


def is_command_running() -> bool:
    """Whether a command is being run, so that its start is known."""
    return _running.get() is not None


def command_text() -> str:
    """The command that is being run, as one would type it."""
    running = _running.get()
    if running is not None:
        return running.text
    return shlex.join([Path(sys.executable).name, *sys.argv]) if sys.argv and sys.argv[0] else "Python"


def run_facts(seconds: float | None = None) -> dict[str, str]:
    """What a report says about its origin, by name and in order.

    Args:
        seconds: How long it took, in [s]; by default since the command began, if there is one.
    """
    running = _running.get()
    if seconds is None and running is not None:
        seconds = time.monotonic() - running.began
    facts = {"command": command_text(), "package": f"maniskill-tomato {maniskill_tomato.__version__}"}
    if (found := commit(Path(__file__).resolve().parent)) is not None:
        facts["commit"] = found
    facts["machine"] = machine()
    facts["software"] = software()
    facts["date"] = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    if seconds is not None:
        facts["duration"] = f"{duration(seconds)}, of this call alone"
    return facts


def commit(folder: Path) -> str | None:
    """The commit that a folder is at, and whether its tracked files are as committed; None outside a checkout.

    A package that is installed inside another project's checkout is not part of it: its folder must be tracked.
    """

    def git(*words: str) -> str:
        done = subprocess.run(
            ("git", "-C", str(folder), *words), capture_output=True, text=True, timeout=10, check=True
        )
        return done.stdout.strip()

    try:
        if not git("ls-files", "--", "."):
            return None
        head = git("rev-parse", "--short=12", "HEAD")
        changed = git("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    files = len(changed.splitlines())
    return f"{head}, with changes in {files} file{'s' if files > 1 else ''}" if files else f"{head}, clean"


def machine() -> str:
    """Processor, cores, memory in [GB] and GPU."""
    memory = _memory_gb()
    parts = [
        processor(),
        f"{usable_cores()} of {os.cpu_count()} cores",
        "memory not known" if memory is None else f"{memory:.0f} GB of memory",
        _gpu(),
    ]
    return ", ".join(parts)


def software() -> str:
    """Python, PyTorch where it is loaded or installed, and the operating system."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        torch = f"torch {version('torch')}"
    except PackageNotFoundError:
        torch = "no torch"
    return f"Python {platform.python_version()}, {torch}, {platform.system()} {platform.release()}"


def processor() -> str:
    """The processor's name as the system tells it."""
    info = Path("/proc/cpuinfo")
    for line in info.read_text(errors="replace").splitlines() if info.is_file() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def duration(seconds: float) -> str:
    """A time in words: `3.2 s`, `4 min 05 s`, `2 h 03 min`."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def _memory_gb() -> float | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, OSError, ValueError):
        return None


def _gpu() -> str:
    """The GPU that PyTorch would use; a PyTorch that is not loaded uses none."""
    torch = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_available():
        return "no GPU"
    return f"GPU {torch.cuda.get_device_name()}"
