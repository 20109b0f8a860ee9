"""Measures speed and memory on this machine, all in one run, as one JSON, and compares it with an older one.

Usage:
    python scripts/benchmark.py --out benchmark.json
    python scripts/benchmark.py --out new.json --compare benchmark.json
    python scripts/benchmark.py --rivals --out rivals.json
"""

import json
import logging
import os
import platform
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import tyro

from benchmarking.comparison import check_same_kind, compare_rates, comparison_text, read_run
from benchmarking.detectors import check_detection
from benchmarking.rivals import rival_results, rival_tables
from benchmarking.simulator import images, kinematics, look_times, memory, simulated, vectors
from benchmarking.turns import Measurement, in_turns
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.rendering.vulkan_probe import rendering_available
from maniskill_tomato.run_facts import run_facts

PACKAGES = ("mani-skill", "sapien", "torch", "warp-lang", "gymnasium", "maniskill-tomato")


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to measure and where to write it."""

    out: Path = Path("benchmark.json")
    """The JSON file."""
    compare: Path | None = None
    """A file of an older run on a machine of this kind; the command fails if a rate got slower than the noise."""
    rivals: bool = False
    """Measure other libraries beside this package's parts instead (extra `rivals`; those that are not installed are
    left out), and write their tables as Markdown beside the JSON."""
    device: str = "cpu"
    """Torch device of the environments without a simulator."""
    envs: tuple[int, ...] = (1, 64, 256)
    """Environments at once without a simulator."""
    repeats: int = 5
    """Turns; each rate is the median of as many measurements."""
    memory_steps: int = 10_000
    """Steps of ManiSkill's environment over which memory must not grow."""
    memory_vector_steps: int = 100_000
    """Environments' steps without a simulator over which memory must not grow."""
    memory_resets: int = 500
    """Resets with new plants over which memory must not grow."""
    look_episodes: int = 5
    """Episodes whose rendered views a camera's look is timed on, four views each."""
    poses: int = 10_000
    """That every inverse kinematics solves, with --rivals."""
    photos: str | None = None
    """FOLDER:SPLIT of annotated photos to compare detectors on, with --rivals."""
    yolo: Path | None = None
    """A YOLO that Ultralytics exported to ONNX (extra `yolo`), judged beside ours on --photos."""

    def __post_init__(self) -> None:
        for name in (
            "repeats",
            "memory_steps",
            "memory_vector_steps",
            "memory_resets",
            "look_episodes",
            "poses",
        ):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.rivals and self.compare is not None:
            raise InvalidInputError(
                "--rivals writes tables and --compare compares rates of this package; give one"
            )
        if not self.rivals and (self.photos is not None or self.yolo is not None):
            raise InvalidInputError("--photos and --yolo go with --rivals")
        check_detection(self.photos, self.yolo)
        if not self.envs or min(self.envs) < 1:
            raise InvalidInputError(f"envs must be numbers from 1, got {self.envs}")
        try:
            kind = torch.device(self.device).type
        except RuntimeError as error:
            raise InvalidInputError(f"device must be cpu or cuda, got {self.device!r}") from error
        if kind == "cuda" and not torch.cuda.is_available():
            raise InvalidInputError(
                "PyTorch finds no CUDA device here; leave out --device to measure the CPU"
            )


def machine_facts(device: str) -> dict[str, Any]:
    """What the rates are of."""
    is_cuda = torch.device(device).type == "cuda"
    return {
        "processor": processor(),
        "accelerator": torch.cuda.get_device_name(device) if is_cuda else None,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "torch_threads": torch.get_num_threads(),
        **{name: version(name) for name in PACKAGES},
    }


def processor() -> str:
    """Name of the processor."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


def own_results(args: Args) -> dict[str, Any]:
    """Rates and memory of this package."""
    can_render = rendering_available()
    with ExitStack() as stack:
        measurements: dict[str, Measurement] = {
            **stack.enter_context(simulated(can_render)),
            **vectors(args.envs, args.device),
            **kinematics(),
            **stack.enter_context(images(can_render)),
        }
        rates = in_turns(measurements, args.repeats)
    return {
        "rates": rates,
        "ratios": ratios({name: rate["median"] for name, rate in rates.items()}),
        "memory": memory(args.memory_steps, args.memory_vector_steps, args.memory_resets, args.device),
        "look": look_times(args.look_episodes, 4) if can_render else None,
        "left_out": []
        if can_render
        else ["rendered steps and images, look: no Vulkan device (`make vulkan`)"],
    }


def ratios(medians: dict[str, float]) -> dict[str, float]:
    """Steps of the empty environment over guided ones, and of vectors over ManiSkill's single environment."""
    wanted = {"guided/steps over empty/steps": ("guided/steps", "empty/steps")}
    for name in medians:
        task = name.partition("/")[0]
        if "/vector_" in name and name.endswith("_steps"):
            wanted[f"{name} over {task}/steps"] = (name, f"{task}/steps")
    return {name: round(medians[above] / medians[below], 3) for name, (above, below) in wanted.items()}


def main(args: Args) -> int:
    """Runs every measurement and writes the file; 1 if --compare finds a rate that got slower."""
    logging.getLogger("mani_skill").setLevel(logging.ERROR)
    torch.set_num_threads(1)
    facts = machine_facts(args.device)
    old = None
    if args.compare is not None:
        old = read_run(args.compare)
        check_same_kind(old, facts)
    results: dict[str, Any] = {}
    if args.rivals:
        results |= rival_results(args.repeats, args.poses, args.envs, args.photos, args.yolo)
    else:
        results |= own_results(args)
    text = json.dumps({"machine": facts, "run": run_facts(), **results}, indent=2)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")
    if args.rivals:
        args.out.with_suffix(".md").write_text(rival_tables(results))
    if old is None:
        return 0
    changes, alone = compare_rates(old["rates"], results["rates"])
    sys.stdout.write("\n" + comparison_text(changes, alone))
    return int(any(change.verdict == "slower" for change in changes))


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except InvalidInputError as error:
        sys.exit(f"error: {error}")
