"""Measures speed and memory on this machine, all in one run, as one JSON, and compares it with an older one.

Usage:
    python scripts/benchmark.py --out benchmark.json
    python scripts/benchmark.py --out new.json --compare benchmark.json
    python scripts/benchmark.py --rivals --out rivals.json
    python scripts/benchmark.py --device cuda --out gpu.json
    python scripts/benchmark.py --parts vector shell --envs 1 16 --shells 4
    python scripts/benchmark.py --parts profiles
    python scripts/benchmark.py --plants --out plants.json
"""

import json
import logging
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Literal

import torch
import tyro

from benchmarking.comparison import check_same_kind, compare_rates, comparison_text, read_run
from benchmarking.detectors import check_detection
from benchmarking.parts import ERROR, LIMITS, profile_tables, run_parts
from benchmarking.plants_and_processes import plants_and_processes
from benchmarking.rivals import rival_results, rival_tables
from benchmarking.simulator import images, kinematics, look_times, memory, simulated, vectors
from benchmarking.turns import Measurement, in_turns
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.plant_store import LIMIT_VARIABLE
from maniskill_tomato.rendering.vulkan_probe import rendering_available
from maniskill_tomato.run_facts import processor, run_facts

STORE_MB: Final = "512"
"""Megabytes of plants that are kept where nothing else is asked for: the resets whose memory is measured fill them."""

CPU_ENVS: Final = (1, 64, 256)
CUDA_ENVS: Final = (1, 64, 1024, 4096)

Part = Literal[
    "kernels",
    "vector",
    "agreement",
    "shell",
    "rendering",
    "fast-td3",
    "pixels",
    "segmenter",
    "tests",
    "profiles",
]

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
    plants: bool = False
    """Measure resets with kept and with new plants, how fast plants grow, and two processes beside one, instead;
    much of it by the clock, so that it wants a machine of its own."""
    device: str = "cpu"
    """`cuda` does all `--parts` but `profiles`, in about eight minutes, and none of what is measured in turns."""
    parts: tuple[Part, ...] = ()
    """Do these instead, each in a process of its own and within a limit: what can be otherwise on a GPU, and where the
    processor's time goes. A part that fails leaves its error in the file, and the command fails when all are done."""
    envs: tuple[int, ...] = ()
    """Environments at once without a simulator; by default 1, 64 and 256, with `--device cuda` 1, 64, 1024 and 4096."""
    shells: int = 16
    """Environments at once in ManiSkill, in the parts `shell` and `rendering`; on a CPU as many single ones."""
    part_seconds: float = 1.0
    """How long a part measures each rate, in [s]; its trainings take 30 times as long."""
    limits_scale: float = 1.0
    """Times the limits of the parts, for slow machines."""
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
            "shells",
        ):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.rivals + self.plants + (self.compare is not None) > 1:
            raise InvalidInputError(
                "--rivals and --plants measure something else than the rates that --compare compares; give one of them"
            )
        if not self.rivals and (self.photos is not None or self.yolo is not None):
            raise InvalidInputError("--photos and --yolo go with --rivals")
        check_detection(self.photos, self.yolo)
        for name in ("part_seconds", "limits_scale"):
            if not getattr(self, name) > 0.0:
                raise InvalidInputError(f"{name} must be above 0, got {getattr(self, name)}")
        if min(self.envs, default=1) < 1:
            raise InvalidInputError(f"envs must be numbers from 1, got {self.envs}")
        try:
            kind = torch.device(self.device).type
        except RuntimeError as error:
            raise InvalidInputError(f"device must be cpu or cuda, got {self.device!r}") from error
        if kind == "cuda" and not torch.cuda.is_available():
            raise InvalidInputError(
                "PyTorch finds no CUDA device here; leave out --device to measure the CPU"
            )
        if self.all_parts and (self.rivals or self.plants or self.compare is not None):
            raise InvalidInputError(
                "--rivals, --plants and --compare go with what is measured in turns, not with --parts or --device cuda"
            )

    @property
    def kind(self) -> str:
        """`cpu` or `cuda`."""
        return torch.device(self.device).type

    @property
    def all_parts(self) -> tuple[str, ...]:
        """The parts to do; none to measure in turns."""
        if self.parts or self.kind == "cpu":
            return self.parts
        return tuple(name for name in LIMITS if name != "profiles")

    @property
    def counts(self) -> tuple[int, ...]:
        """Environments at once without a simulator."""
        return self.envs or (CPU_ENVS if self.kind == "cpu" else CUDA_ENVS)


def machine_facts(device: str) -> dict[str, Any]:
    """What the rates are of."""
    is_cuda = torch.device(device).type == "cuda"
    return {
        "processor": processor(),
        "accelerator": torch.cuda.get_device_name(device) if is_cuda else None,
        "accelerator_memory_mib": torch.cuda.mem_get_info(device)[1] // 2**20 if is_cuda else None,
        "driver": driver() if is_cuda else None,
        "cuda": torch.version.cuda if is_cuda else None,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "torch_threads": torch.get_num_threads(),
        **{name: version(name) for name in PACKAGES},
    }


def driver() -> str | None:
    """Version of NVIDIA's driver; None if its tool is missing."""
    command = ("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    try:
        told = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    return told.splitlines()[0].strip() if told.strip() else None


def part_results(args: Args) -> Iterator[dict[str, Any]]:
    """The findings of the parts so far, after each of them."""
    setting = {
        "device": args.kind,
        "envs": args.counts,
        "shells": args.shells,
        "seconds": args.part_seconds,
    }
    found: dict[str, Any] = {}
    for name, findings in run_parts(args.all_parts, setting, args.limits_scale):
        found[name] = findings
        yield {"parts": found, "failed": [part for part, results in found.items() if ERROR in results]}


def own_results(args: Args) -> dict[str, Any]:
    """Rates and memory of this package."""
    os.environ.setdefault(LIMIT_VARIABLE, STORE_MB)
    can_render = rendering_available()
    with ExitStack() as stack:
        measurements: dict[str, Measurement] = {
            **stack.enter_context(simulated(can_render)),
            **vectors(args.counts, args.device),
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
    """Does what is asked for and writes the file; 1 if a part failed, or --compare finds a rate that got slower."""
    logging.getLogger("mani_skill").setLevel(logging.ERROR)
    torch.set_num_threads(1)
    facts = machine_facts(args.device)
    old = None
    if args.compare is not None:
        old = read_run(args.compare)
        check_same_kind(old, facts)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {}

    def write() -> str:
        text = json.dumps({"machine": facts, "run": run_facts(), **results}, indent=2) + "\n"
        args.out.write_text(text)
        return text

    if args.all_parts:
        for so_far in part_results(args):
            results |= so_far
            write()
        if profiles := results["parts"].get("profiles"):
            args.out.with_suffix(".md").write_text(profile_tables(profiles))
        sys.stdout.write(write())
        return int(bool(results["failed"]))
    if args.rivals:
        results |= rival_results(args.repeats, args.poses, args.counts, args.photos, args.yolo)
    elif args.plants:
        for found in plants_and_processes(args.repeats):
            results |= found
            write()
    else:
        results |= own_results(args)
    sys.stdout.write(write())
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
