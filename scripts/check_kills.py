"""Kills commands with SIGKILL at random moments, lets them go on, and compares what they leave with an unbroken run.

Usage:
    python scripts/check_kills.py --commands train,benchmark --kills 20 --out kills.json

A round is a folder in which a command is killed up to `--kills-a-round` times and is then left alone. `train`,
`dataset` and `benchmark` go on where they were; `detect` and `deploy inspect` begin again in what is left. The
recording of every inspection that was killed must be the beginning of the unbroken one's. Children must end too.
"""

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import tyro

from maniskill_tomato.deploy.deploy_errors import CutOffError
from maniskill_tomato.deploy.recording_reader import read_messages
from maniskill_tomato.files import read_tensors, write_json

MARK = "TOMATO_CHECK_KILLS"
"""Environment variable by which the processes of a round are found."""

CHILDREN_SECONDS = 30.0
"""How long children may take to notice that the command was killed."""

TIMES = frozenset(
    {"seconds", "device_seconds", "stage_ms", "timing_ms", "decision_ms", "decision_ms_p95", "wall_seconds"}
)
"""Keys of JSON files whose values are processor time."""

Content = dict[str, str]
"""What a finished run left, as a digest by name."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to kill, how often, and where to say what came of it."""

    commands: str = "train,dataset,benchmark,detect,inspect"
    """Which of them, with commas between."""
    kills: int = 20
    """Of each command."""
    kills_a_round: int = 5
    """The most in one folder before it is left to end."""
    seed: int = 0
    """Of the moments."""
    out: Path = Path("kills.json")
    """The JSON file."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command and what its result is."""

    begin: list[str]
    """Arguments of the first start; OUT stands for the folder."""
    go_on: list[str]
    """Arguments of every later one."""
    content: Callable[[Path], Content]
    """What a finished run left in its folder."""
    left: Callable[[Path, Path], str | None] = lambda unbroken, killed: None
    """What is wrong with what a killed run left, beside the unbroken one; None if nothing is."""


@dataclass(kw_only=True)
class Outcome:
    """What became of one command."""

    seconds_unbroken: float = 0.0
    kills: int = 0
    rounds: int = 0
    moments_s: list[float] = field(default_factory=list)
    """When each kill came after its start."""
    differing: list[str] = field(default_factory=list)
    """What was not as after the unbroken run, by round."""
    left_running: int = 0
    """Children that outlived a killed command."""


def plain(value: Any) -> Any:
    """JSON without times and folders."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items() if k not in TIMES}
    return [plain(v) for v in value] if isinstance(value, list) else value


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def json_digest(path: Path) -> str:
    return digest(json.dumps(plain(json.loads(path.read_text())), sort_keys=True).encode())


def flat(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict | list | tuple):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from flat(inner, f"{path}/{key}")
    else:
        yield path, value


def train_content(out: Path) -> Content:
    """Weights, optimisers, replay, random states and counters of the last checkpoint, episodes and history."""
    found = {"episodes.csv": digest((out / "episodes.csv").read_bytes())}
    newest = max((out / "checkpoints").glob("step_*.pt"))
    for name in ("policy.pt", str(newest.relative_to(out))):
        for key, value in flat(read_tensors(out / name)):
            if "seconds" in key or "event_files" in key:
                continue
            data = value.numpy().tobytes() if isinstance(value, torch.Tensor) else repr(value).encode()
            found[f"{name}{key}"] = digest(data)
    with np.load(out / "history.npz") as history:
        found |= {f"history/{name}": digest(history[name].tobytes()) for name in history.files}
    return found


def file_content(out: Path) -> Content:
    """Every file that is seen, JSON without times."""
    files = [p for p in out.rglob("*") if p.is_file() and p.suffix not in (".mcap", ".html")]
    found = {}
    for path in files:
        name = str(path.relative_to(out))
        found[name] = json_digest(path) if path.suffix == ".json" else digest(path.read_bytes())
    return found


def benchmark_content(out: Path) -> Content:
    """The lines of results and the tables made of them, without times; plots and pages show times."""
    found = {}
    for path in sorted((out / "results").rglob("*.jsonl")):
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        results = {line["number"]: plain(line["result"]) for line in lines}
        found[path.name] = digest(json.dumps(results, sort_keys=True).encode())
    return found | {"benchmark.json": json_digest(out / "benchmark.json")}


def inspect_content(out: Path) -> Content:
    """The list and the pictures."""
    return {name: value for name, value in file_content(out).items() if name != "report.png"}


def steps(path: Path) -> list[str]:
    """The looks of a recording without times, as far as they are whole."""
    found = []
    try:
        for topic, message in read_messages(path):
            if topic == "/step":
                found.append(json.dumps(plain(message), sort_keys=True))
    except CutOffError:
        pass
    return found


def recording_left(unbroken: Path, killed: Path) -> str | None:
    path = killed / "run.mcap"
    if not path.is_file() or not path.stat().st_size:
        return None
    whole, part = steps(unbroken / "run.mcap"), steps(path)
    return None if whole[: len(part)] == part else "the recording of the killed run is no beginning"


def commands(images: Path) -> dict[str, Command]:
    """Every command with the smallest settings that still write several times."""

    def words(text: str) -> list[str]:
        return list(text.split())

    begin = words(
        "train TomatoViewpointGuided-v1 --plant one_tomato --total-timesteps 1500 --learning-starts 100 "
        "--batch-size 32 --checkpoint-every 100 --out OUT"
    )
    go_on = words("train --resume OUT")
    dataset = words("dataset --count 14 --width 64 --height 64 --jobs 2 --out OUT")
    benchmark = words(
        "benchmark --policies random_viewpoint,fixed_sweep --episodes 8 --no-pictures --jobs 2 --out OUT"
    )
    detect = ["detect", str(images), *words("--quick --out OUT/list.json --pictures OUT/drawn")]
    inspect = words("deploy inspect --seed 0 --max-moves 6 --out OUT")
    return {
        "train": Command(begin=begin, go_on=go_on, content=train_content),
        "dataset": Command(begin=dataset, go_on=dataset, content=file_content),
        "benchmark": Command(begin=benchmark, go_on=benchmark, content=benchmark_content),
        "detect": Command(begin=detect, go_on=detect, content=file_content),
        "inspect": Command(begin=inspect, go_on=inspect, content=inspect_content, left=recording_left),
    }


def start(arguments: list[str], out: Path, mark: str) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "maniskill_tomato.cli", *(a.replace("OUT", str(out)) for a in arguments)]
    with (out.parent / f"{out.name}.log").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, MARK: mark})


def marked(mark: str) -> list[int]:
    """Processes that carry a mark, other than those that only wait to be forgotten."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdigit() and int(process.name) != os.getpid():
            try:
                if f"{MARK}={mark}".encode() in (process / "environ").read_bytes():
                    found.append(int(process.name))
            except OSError:  # It has ended, or is another user's.
                continue
    return found


def wait_for_children(mark: str) -> int:
    """How many processes are left after a while; they are killed."""
    end = time.monotonic() + CHILDREN_SECONDS
    while marked(mark) and time.monotonic() < end:
        time.sleep(0.2)
    left = marked(mark)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    return len(left)


def must_end(command: Command, out: Path, mark: str, began: bool) -> None:
    if start(command.go_on if began else command.begin, out, mark).wait() != 0:
        log = (out.parent / f"{out.name}.log").read_text(errors="replace")
        raise RuntimeError(f"{out}: {log[-2000:]}")


def check(command: Command, folder: Path, args: Args, rng: random.Random) -> Outcome:
    """Kills one command as often as asked."""
    outcome, mark = Outcome(), uuid.uuid4().hex
    unbroken = folder / "unbroken"
    began = time.monotonic()
    must_end(command, unbroken, mark, False)
    outcome.seconds_unbroken = round(time.monotonic() - began, 2)
    expected = command.content(unbroken)
    while outcome.kills < args.kills:
        outcome.rounds += 1
        out = folder / f"round-{outcome.rounds}"
        ended = False
        for kill in range(min(args.kills_a_round, args.kills - outcome.kills)):
            goes_on = command.go_on if may_go_on(command, out) else command.begin
            process = start(goes_on, out, mark)
            moment = rng.uniform(0.0, outcome.seconds_unbroken)
            try:
                ended = process.wait(moment) == 0
                if not ended:
                    outcome.differing.append(f"round {outcome.rounds}, start {kill}: {process.returncode}")
                break
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            outcome.kills += 1
            outcome.moments_s.append(round(moment, 3))
            outcome.left_running += wait_for_children(mark)
            if (wrong := command.left(unbroken, out)) is not None:
                outcome.differing.append(f"round {outcome.rounds}: {wrong}")
        if not ended:
            must_end(command, out, mark, may_go_on(command, out))
        found = command.content(out)
        for name in sorted(expected.keys() | found.keys()):
            if expected.get(name) != found.get(name):
                outcome.differing.append(f"round {outcome.rounds}: {name}")
    return outcome


def may_go_on(command: Command, out: Path) -> bool:
    """Whether a killed command had come far enough to be continued by other arguments."""
    return command.begin == command.go_on or (out / "config.json").is_file()


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    rng = random.Random(args.seed)
    outcomes: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="tomato-kills-") as place:
        images = Path(place) / "images"
        images.mkdir()
        noise = np.random.default_rng(0)
        for number in range(16):
            picture = cv2.resize(noise.integers(0, 256, (12, 16, 3), np.uint8), (640, 480))
            cv2.imwrite(str(images / f"{number}.png"), picture)
        every = commands(images)
        for name in args.commands.split(","):
            folder = Path(place) / name
            folder.mkdir()
            outcomes[name] = asdict(check(every[name], folder, args, rng))
            write_json(args.out, {"seed": args.seed, "commands": outcomes})
            print(name, outcomes[name], flush=True)
    if any(outcome["differing"] or outcome["left_running"] for outcome in outcomes.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
