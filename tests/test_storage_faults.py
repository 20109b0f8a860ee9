"""Disks that are full or read-only, two processes in one folder, a clock that is set back: real files and processes."""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
from matplotlib.figure import Figure

from maniskill_tomato.cli import main
from maniskill_tomato.deploy.clock import MonotonicClock
from maniskill_tomato.deploy.recording import McapRecorder
from maniskill_tomato.errors import CheckpointError, NotWrittenError, TomatoError
from maniskill_tomato.experiments import film
from maniskill_tomato.experiments.configs import BenchmarkConfig
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.experiments.viewpoint_benchmark import run_benchmark
from maniskill_tomato.files import write_atomically, write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.plants.episode_list import load_episodes, write_episodes
from maniskill_tomato.report_plots import save_figure
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.segmentation.synthesis.dataset_rendering import DatasetConfig, make_dataset

NOBODY = 65534


@contextmanager
def full_disk(room: int) -> Iterator[None]:
    """No file of this process, nor of those that it starts, may grow beyond `room` bytes: the real write fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def draw(path: Path) -> None:
    figure = Figure()
    figure.subplots().plot([0, 1], [1, 0])
    save_figure(figure, path)


WRITERS: dict[str, Callable[[Path], None]] = {
    "bytes": lambda p: write_atomically(p, b"x" * 5000),
    "a.json": lambda p: write_json(p, ["x"] * 5000),
    "a.png": draw,
    "b.png": lambda p: write_picture(p, np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)),
    "episodes.json": lambda p: write_episodes(p, load_episodes("held_out")[:50]),
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_a_full_disk_does_not_take_leaves_the_old_file_and_no_part_of_the_new_one(
    tmp_path: Path, name: str
) -> None:
    path = tmp_path / name
    path.write_bytes(b"before")
    with full_disk(1000), pytest.raises(NotWrittenError, match=f"cannot write .*{name}: File too large"):
        WRITERS[name](path)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]
    WRITERS[name](path)
    assert path.stat().st_size > 1000


def test_a_film_that_the_disk_does_not_take_is_told_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (24, 128, 128, 3), np.uint8)

    def photograph(env: object, policy: object, seed: int, camera: Any) -> film.Film:
        for picture in noise:
            camera.writer.append_data(picture)
        return SimpleNamespace(seed=seed)  # type: ignore[return-value]

    monkeypatch.setattr(film, "photograph", photograph)
    monkeypatch.setattr(film, "_Camera", lambda env, caption, writer: SimpleNamespace(writer=writer))
    path, nothing = tmp_path / "video.mp4", SimpleNamespace()
    with full_disk(4000), pytest.raises(NotWrittenError, match=r"cannot write the film .*video.mp4"):
        film.film_episodes(nothing, nothing, [1], path)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
    shown: Any = film.film_episodes(nothing, nothing, [1], path)[0]  # type: ignore[arg-type]
    reader: Any = imageio.get_reader(path)
    assert shown.seed == 1 and reader.count_frames() == len(noise)


def test_a_run_whose_report_does_not_fit_names_no_file_that_is_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "deploy",
        "run",
        "--policy",
        "stay",
        "--seed",
        "9",
        "--no-record",
        "--out",
        str(tmp_path / "out"),
    ]
    with full_disk(200), pytest.raises(SystemExit) as ended:
        main(command)
    told = capsys.readouterr()
    assert ended.value.code == 3
    assert "cannot write the report into" in told.err
    assert "result.json" not in told.out and "report.png" not in told.out
    assert not [p for p in (tmp_path / "out").rglob("*") if p.is_file()]


def told_by(write: Callable[[], object]) -> str:
    """What the error of a writer says."""
    try:
        write()
    except TomatoError as error:
        return str(error)
    return "written"


def as_nobody(function: Callable[[], list[str]]) -> list[str]:
    """What a function returns in another process, which is not root's: root may write anywhere."""
    reading, writing = os.pipe()
    if (child := os.fork()) == 0:
        try:
            if os.geteuid() == 0:
                os.setgid(NOBODY)
                os.setuid(NOBODY)
            os.write(writing, json.dumps(function()).encode())
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as answer:
        lines: list[str] = json.loads(answer.read())
    os.waitpid(child, 0)
    return lines


def test_a_folder_that_is_not_ours_is_told_in_words_and_left_as_it_is() -> None:
    with tempfile.TemporaryDirectory(prefix="tomato-read-only-") as place:
        folder = Path(place)
        (folder / "kept.txt").write_text("before")
        folder.chmod(0o555)

        def lock() -> None:
            with only_writer(folder / "new"):
                pass

        writers: list[Callable[[], object]] = [
            lock,
            lambda: write_json(folder / "a.json", 1),
            lambda: write_json(folder / "new" / "a.json", 1),
            lambda: ResultStore(folder / "new", {}),
            lambda: McapRecorder(folder / "run.mcap", {}, MonotonicClock(), np.eye(4)),
        ]
        lines = as_nobody(lambda: [told_by(write) for write in writers])
        assert len(lines) == len(writers)
        assert all(line.startswith("cannot write") and "Permission denied" in line for line in lines), lines
        assert [p.name for p in folder.iterdir()] == ["kept.txt"]
        folder.chmod(0o755)


HOLD = """
import sys, time
from pathlib import Path
from maniskill_tomato.folder_lock import only_writer
with only_writer(Path(sys.argv[1]), "works"):
    print("holds", flush=True)
    time.sleep(600)
"""


@contextmanager
def held(folder: Path) -> Iterator["subprocess.Popen[str]"]:
    """Another process that holds a folder."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "holds\n"
        try:
            yield process
        finally:
            process.kill()


def test_a_folder_that_another_process_works_in_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with held(tmp_path) as process:
        with pytest.raises(CheckpointError, match="another process renders in"):
            make_dataset(DatasetConfig(count=1), tmp_path)
        with pytest.raises(CheckpointError, match="another process measures in"):
            run_benchmark(BenchmarkConfig(out=tmp_path, policies="fixed_sweep", episodes=1))
        for name in ("run", "inspect"):
            with pytest.raises(SystemExit):
                main(["deploy", name, "--policy", "fixed_sweep", "--out", str(tmp_path)])
            assert "another process runs in" in capsys.readouterr().err
        assert list(tmp_path.iterdir()) == []
        process.kill()
        process.wait()
        with only_writer(tmp_path):
            pass


def _light_training(out: Path) -> None:
    from maniskill_tomato.segmentation.training.light_training import LightTraining

    object.__new__(LightTraining).run(out, print)  # The folder comes before the network and the images.


def _yolo(out: Path) -> None:
    from maniskill_tomato.segmentation.training.yolo_training import YOLO_SETTINGS, train_yolo

    images: Any = None
    train_yolo(images, out, YOLO_SETTINGS["thesis"], "yolov8n.yaml", 0)


def _demonstrations(out: Path) -> None:
    from maniskill_tomato.learning.imitation.demonstrations import record_demonstrations

    env: Any = None
    record_demonstrations(env, env, range(2), out)


LONG_COMMANDS: dict[str, Callable[[Path], object]] = {
    "train-imitation": lambda out: main(["train-imitation", "--out", str(out)]),
    "train-view-quality": lambda out: main(["train-view-quality", "--out", str(out)]),
    "train-ppo": lambda out: main(["train-ppo", "TomatoViewpoint-v1", "--out", str(out.parent)]),
    "train --seeds": lambda out: main(
        ["train", "TomatoViewpoint-v1", "--seeds", "0", "1", "--out", str(out)]
    ),
    "train-segmenter light": _light_training,
    "train-segmenter yolo": _yolo,
    "demonstrations": _demonstrations,
    "benchmark-rows": lambda out: main(["benchmark-rows", "--policies", "fixed_sweep", "--out", str(out)]),
    "judge perception": lambda out: main(["judge", "perception", "--policies", "nbv", "--out", str(out)]),
    "judge twin": lambda out: main(["judge", "twin", "--out", str(out)]),
    "ablate": lambda out: main(["ablate", "--out", str(out)]),
    "reproduce": lambda out: main(["reproduce", "guided", "--out", str(out.parent)]),
    "deploy calibrate": lambda out: main(["deploy", "calibrate", "--profile", "mock", "--out", str(out)]),
}
"""What writes into a folder for minutes or hours, beside what the test above has."""

HELD_NAMES = {"train-ppo": "seed-0", "reproduce": "guided"}
"""The folder in `--out` that is held, where that is not all of it."""


def test_every_command_that_writes_for_long_is_refused_in_the_folder_of_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, run in LONG_COMMANDS.items():
        out = tmp_path / name / HELD_NAMES.get(name, "out")
        out.mkdir(parents=True)
        # This process holds it through another open file, as another one would.
        with only_writer(out):
            try:
                run(out)
            except CheckpointError as error:
                told = str(error)
            except SystemExit as end:
                assert end.code in (1, 2), name
                told = capsys.readouterr().err
            else:
                pytest.fail(f"{name} worked in a folder that another process holds")
        assert "another process " in told and f" in {out}; wait for it" in told, (name, told)
        assert list(out.iterdir()) == [], name


ADD = """
import sys
from pathlib import Path
from maniskill_tomato.experiments.result_store import ResultStore
store = ResultStore(Path(sys.argv[1]), {"env_id": "x"})
first = int(sys.argv[2])
for number in range(first, first + 40):
    store.add("part", "name", {number: {"text": f"{first} " * 2000}})
"""


def test_lines_that_two_processes_add_to_one_file_are_all_whole(tmp_path: Path) -> None:
    ResultStore(tmp_path, {"env_id": "x"})
    both = [subprocess.Popen([sys.executable, "-c", ADD, str(tmp_path), first]) for first in ("0", "1000")]
    assert [process.wait(300) for process in both] == [0, 0]
    found = ResultStore(tmp_path, {"env_id": "x"}).read("part", "name")
    assert sorted(found) == [*range(40), *range(1000, 1040)]
    assert all(result["text"] == f"{n // 1000 * 1000} " * 2000 for n, result in found.items())


def test_no_clock_of_the_robot_follows_the_date(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = MonotonicClock()
    before = clock.now()
    monkeypatch.setattr(time, "time", lambda: 0.0)
    assert 0.0 <= clock.now() - before < 60.0


def test_times_of_a_training_stay_in_order_when_the_date_is_set_back(tmp_path: Path) -> None:
    """TensorBoard's events carry the date; a comparison of runs draws over them."""
    from torch.utils.tensorboard import SummaryWriter

    from maniskill_tomato.experiments.training_runs import read_clock

    writer: Any = SummaryWriter(str(tmp_path))
    for step, date in enumerate([1000.0, 1010.0, 500.0, 505.0, 520.0]):
        writer.add_scalar("a", 1.0, step, walltime=date)
    writer.close()
    clock = read_clock(tmp_path)
    assert clock is not None
    assert clock[:, 0].tolist() == [1, 2, 3, 4]
    assert (np.diff(clock[:, 1]) >= 0.0).all() and clock[0, 1] >= 0.0


def test_json_of_a_disk_that_is_full_is_the_old_one(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": 1})
    with full_disk(3), pytest.raises(NotWrittenError):
        write_json(tmp_path / "a.json", {"a": 2})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": 1}
