"""The parts of a benchmark, each in a process of its own, so that one that fails or hangs costs no other.

A fault on a GPU leaves a process that cannot use the GPU any more. What a part had found before it failed is kept.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final

SCRIPTS: Final = Path(__file__).resolve().parents[1]

LIMITS: Final[Mapping[str, float]] = {
    "kernels": 80.0,
    "vector": 90.0,
    "agreement": 40.0,
    "shell": 30.0,
    "rendering": 45.0,
    "fast-td3": 60.0,
    "pixels": 45.0,
    "segmenter": 20.0,
    "tests": 100.0,
    "profiles": 600.0,
}
"""The parts in their order, and how long each may take, in [s]: eight minutes in all without the profiles."""

FUNCTIONS: Final[Mapping[str, str]] = {"fast-td3": "fast_td3", "tests": "gpu_tests"}
"""The functions in `device_parts` that are not called like their part."""

STARTING: Final = 20.0
"""Beside its limit a process may take so long to import what it needs, in [s]."""

ERROR: Final = "error"
"""Under this name stands why a part failed."""


def run_parts(
    names: Sequence[str], setting: Mapping[str, Any], limits_scale: float = 1.0
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Does parts one after the other.

    Args:
        names: Of `LIMITS`.
        setting: The fields of `device_parts.Setting`.
        limits_scale: Times the limits of the parts.

    Yields:
        The name of each part and its findings, with `seconds`, and `error` where it failed.
    """
    for name in names:
        sys.stderr.write(f"{name} ...\n")
        findings = run_part(name, setting, LIMITS[name] * limits_scale)
        if ERROR in findings:
            sys.stderr.write(f"{name}: {findings[ERROR]}\n")
        yield name, findings


def run_part(name: str, setting: Mapping[str, Any], limit: float) -> dict[str, Any]:
    """Does one part in a process of its own; see `run_parts`."""
    path = os.pathsep.join([str(SCRIPTS), str(SCRIPTS.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    if setting["device"] == "cpu":
        environment["CUDA_VISIBLE_DEVICES"] = ""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "findings.jsonl"
        command = [sys.executable, "-W", "ignore", "-m", "benchmarking.parts", name, str(out)]
        start = time.perf_counter()
        process = subprocess.Popen(
            [*command, json.dumps(setting)],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        error = None
        try:
            _, said = process.communicate(timeout=limit + STARTING)
            if process.returncode < 0:
                error = f"ended by {signal.Signals(-process.returncode).name}; {_last_line(said)}"
            elif process.returncode > 0:
                error = f"ended with status {process.returncode}; {_last_line(said)}"
        except subprocess.TimeoutExpired:
            error = f"took longer than its {limit:.0f} s"
        finally:
            if process.poll() is None:
                # With all that it has started; Ctrl-C comes here as well.
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()
        lines = out.read_text().splitlines() if out.is_file() else []
        findings: dict[str, Any] = {}
        for line in lines:
            findings |= json.loads(line)
        findings["seconds"] = round(time.perf_counter() - start, 1)
        if error is not None:
            findings.setdefault(ERROR, error)
        return findings


def _last_line(text: str) -> str:
    lines = [line for line in text.strip().splitlines() if line.strip()]
    return lines[-1] if lines else "it said nothing"


def profile_tables(findings: Mapping[str, Any]) -> str:
    """Markdown of the part `profiles`: a table for all paths that have the same stages, a column for each."""
    tables: dict[tuple[str, ...], list[Any]] = {}
    for group in findings.values():
        for profile in group if isinstance(group, list) else ():
            tables.setdefault(tuple(profile["shares"]), []).append(profile)
    lines: list[str] = []
    for stages, profiles in tables.items():
        heads = [f"{profile['path']}: {profile['ms']:.3g} ms" for profile in profiles]
        lines += [f"| part | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
        for stage in stages:
            shares = [f"{profile['shares'][stage]:.0%}" for profile in profiles]
            lines.append(f"| {stage} | {' | '.join(shares)} |")
        lines.append("")
    return "\n".join(lines)


def _main(name: str, out: Path, setting: Mapping[str, Any]) -> int:
    """Does a part in this process, and writes each finding as a line of JSON; 1 if it failed."""
    import torch

    module: Any = import_module("benchmarking.device_parts")
    torch.set_num_threads(1)
    with out.open("w") as file:

        def tell(finding: Mapping[str, Any]) -> None:
            file.write(json.dumps(finding) + "\n")
            file.flush()

        try:
            part = getattr(module, FUNCTIONS.get(name, name))
            for key, value in part(module.Setting(**{**setting, "envs": tuple(setting["envs"])})):
                tell({key: value})
        except Exception as error:  # Whatever it is belongs into the file.
            traceback.print_exc()
            tell({ERROR: f"{type(error).__name__}: {error}"})
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1], Path(sys.argv[2]), json.loads(sys.argv[3])))
