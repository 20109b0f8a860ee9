"""Data sets for LeRobot, read back with pyarrow and Pillow. `tests/integrations` reads them with LeRobot itself."""

import io
import json
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from maniskill_tomato.cli import main
from maniskill_tomato.conversion.episodes import Episode, Feature, color, depth, flag, vector
from maniskill_tomato.conversion.lerobot_conversion import convert_to_lerobot
from maniskill_tomato.conversion.lerobot_dataset import LeRobotWriter
from maniskill_tomato.deploy.policy_run import RunConfig, run
from maniskill_tomato.deploy.profile import parse_profile
from maniskill_tomato.deploy.run_replay import RecordedRun, load_recording
from maniskill_tomato.errors import InvalidInputError, NotWrittenError, TomatoError
from twin_profile import TWIN_PROFILE

parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")

TWIN = (
    TWIN_PROFILE
    + """
[loop]
max_moves = 3
"""
)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two runs of the twin."""
    profile = parse_profile(TWIN, Path("recorded.toml"))
    folders = [tmp_path_factory.mktemp("run") for _ in range(2)]
    for seed, out in zip((3, 9), folders, strict=True):
        run(RunConfig(profile=profile, out=out, policy="nbv", seed=seed))
    return folders[0] / "run.mcap", folders[1] / "run.mcap"


def write_trajectories(path: Path, with_images: bool = False, moves: tuple[int, ...] = (2, 0, 3)) -> Path:
    """Demonstrations as ManiSkill's recorder lays them out, with random content."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as opened:
        file: Any = opened
        for number, count in enumerate(moves):
            group = file.create_group(f"traj_{number}")
            views = count + 1
            group["actions"] = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
            group["rewards"] = rng.normal(size=count).astype(np.float32)
            group["success"] = np.arange(count) == count - 1
            if with_images:
                group["obs/agent/qpos"] = rng.normal(size=(views, 7)).astype(np.float32)
                group["obs/extra/time"] = rng.uniform(size=(views, 1)).astype(np.float32)
                camera = "obs/sensor_data/d435"
                group[f"{camera}/rgb"] = rng.integers(0, 256, (views, 30, 40, 3), dtype=np.uint8)
                group[f"{camera}/depth"] = rng.integers(0, 32767, (views, 30, 40, 1), dtype=np.int16)
                group[f"{camera}/segmentation"] = np.zeros((views, 30, 40, 1), np.int16)
            else:
                group["obs"] = rng.normal(size=(views, 9)).astype(np.float32)
    about = {"env_info": {"env_id": "TomatoViewpoint-v1", "env_kwargs": {}}}
    path.with_suffix(".json").write_text(json.dumps({**about, "episodes": [{"control_mode": "pd_look_at"}]}))
    return path


def table_of(folder: Path, file: str = "data/chunk-000/file-000.parquet") -> dict[str, list[Any]]:
    columns: dict[str, list[Any]] = parquet.read_table(folder / file).to_pydict()
    return columns


def info_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "meta" / "info.json").read_text())
    return content


def pixels(cell: dict[str, Any]) -> NDArray[Any]:
    return np.array(Image.open(io.BytesIO(cell["bytes"])))


def looks_of(paths: tuple[Path, ...]) -> list[RecordedRun]:
    return [load_recording(path) for path in paths]


def test_runs_become_episodes_with_a_frame_for_each_look(
    recordings: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "converted"
    main(["convert", *map(str, recordings), "--to", "lerobot", "--out", str(out)])
    runs = looks_of(recordings)
    steps = [step for one in runs for step in one.steps]
    assert f"2 episodes, {len(steps)} frames" in capsys.readouterr().out
    rows = table_of(out)
    lengths = [len(one.steps) for one in runs]
    assert rows["index"] == list(range(len(steps)))
    assert rows["episode_index"] == [0] * lengths[0] + [1] * lengths[1]
    assert rows["frame_index"] == [*range(lengths[0]), *range(lengths[1])]
    assert rows["timestamp"] == [float(k) for k in rows["frame_index"]]
    for k, step in enumerate(steps):
        joints = np.array(step.facts["joint_positions"], np.float32)
        assert rows["observation.state"][k] == joints.tolist()
        sent = step.facts["commanded"]
        assert rows["move_sent"][k] == (sent is not None)
        assert rows["action"][k] == (joints if sent is None else np.array(sent, np.float32)).tolist()
        move: Any = step.facts["action"] or (0.0, 0.0, 0.0)
        assert rows["policy_move"][k] == np.array(move, np.float32).tolist()
        assert rows["visible_fraction"][k] == np.float32(step.facts["visible_fraction"])
        assert np.array_equal(pixels(rows["observation.images.wrist"][k]), step.frame.color)
        seen = pixels(rows["observation.images.wrist_depth"][k])
        assert seen.dtype == np.uint16 and np.abs(seen / 1000.0 - step.frame.depth).max() <= 0.0005001
        camera = np.array(step.facts["T_world_camera"])
        x, y, z, qw, qx, qy, qz = rows["camera_pose"][k]
        assert [x, y, z] == camera[:3, 3].astype(np.float32).tolist()
        # The axis along which the camera looks, by the quaternion's formula.
        axis = [2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy)]
        assert np.allclose(axis, camera[:3, 2], atol=1e-6)
    ends = [lengths[0] - 1, len(steps) - 1]
    assert [k for k, done in enumerate(rows["next.done"]) if done] == ends
    won = [k for k, success in enumerate(rows["next.success"]) if success]
    assert won == [k for k in ends if steps[k].facts["outcome"] == "success"]
    first, last = runs[1].steps[0].frame, runs[1].steps[-1].frame
    assert rows["seconds"][lengths[0]] == 0.0 and rows["seconds"][-1] == np.float32(last.stamp - first.stamp)


def test_the_description_says_what_the_frames_are(recordings: tuple[Path, Path], tmp_path: Path) -> None:
    convert_to_lerobot(recordings, tmp_path / "converted", task="Find the red one.", fps=2)
    info = info_of(tmp_path / "converted")
    lengths = [len(one.steps) for one in looks_of(recordings)]
    assert info["codebase_version"] == "v3.0" and info["fps"] == 2 and info["robot_type"] == "iiwa14"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, sum(lengths), 1)
    assert info["splits"] == {"train": "0:2"} and info["video_path"] is None
    joints = [f"joint_{k}.pos" for k in range(1, 8)]
    state = info["features"]["observation.state"]
    assert state == {"dtype": "float32", "shape": [7], "names": joints, "info": {"unit": "rad"}}
    seen = info["features"]["observation.images.wrist_depth"]
    assert seen["dtype"] == "image" and seen["shape"] == [120, 160, 1]
    assert seen["info"]["is_depth_map"] and seen["info"]["depth_unit"] == "mm"
    intrinsics = looks_of(recordings)[0].steps[0].frame.intrinsics
    assert seen["info"]["intrinsics"]["fx"] == intrinsics.fx
    rows = table_of(tmp_path / "converted")
    assert set(rows) == set(info["features"])
    assert rows["timestamp"][:3] == [0.0, 0.5, 1.0]
    tasks = table_of(tmp_path / "converted", "meta/tasks.parquet")
    assert tasks == {"task_index": [0], "task": ["Find the red one."]}
    episodes = table_of(tmp_path / "converted", "meta/episodes/chunk-000/file-000.parquet")
    assert episodes["length"] == lengths and episodes["tasks"] == [["Find the red one."]] * 2
    assert episodes["dataset_from_index"] == [0, lengths[0]]
    assert episodes["dataset_to_index"] == [lengths[0], sum(lengths)]
    groups = parquet.ParquetFile(tmp_path / "converted" / "data/chunk-000/file-000.parquet").metadata
    assert [groups.row_group(k).num_rows for k in range(groups.num_row_groups)] == lengths
    origin = json.loads((tmp_path / "converted" / "meta" / "origin.json").read_text())
    assert [one["source"] for one in origin["episodes"]] == list(map(str, recordings))


def test_statistics_are_those_of_the_values(recordings: tuple[Path, Path], tmp_path: Path) -> None:
    convert_to_lerobot(recordings, tmp_path / "converted")
    statistics = json.loads((tmp_path / "converted" / "meta" / "stats.json").read_text())
    rows = table_of(tmp_path / "converted")
    assert set(statistics) == set(rows)
    joints = np.array(rows["observation.state"])
    found = statistics["observation.state"]
    for name, expected in (("min", joints.min(0)), ("max", joints.max(0)), ("mean", joints.mean(0))):
        assert np.allclose(found[name], expected)
    assert np.allclose(found["std"], joints.std(0)) and found["count"] == [len(joints)]
    images = np.stack([pixels(cell) for cell in rows["observation.images.wrist"]]) / 255.0
    found = statistics["observation.images.wrist"]
    assert np.shape(found["mean"]) == (3, 1, 1)
    assert np.allclose(np.ravel(found["mean"]), images.mean((0, 1, 2)))
    assert np.allclose(np.ravel(found["std"]), images.std((0, 1, 2)))
    depths = np.stack([pixels(cell) for cell in rows["observation.images.wrist_depth"]]).astype(float)
    found = statistics["observation.images.wrist_depth"]
    assert np.ravel(found["max"]) == depths.max() and np.allclose(np.ravel(found["std"]), depths.std())
    # Of one episode, a quantile is the smallest value that so many do not exceed.
    episodes = table_of(tmp_path / "converted", "meta/episodes/chunk-000/file-000.parquet")
    first = depths[: episodes["length"][0]].ravel()
    for name, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        value = np.ravel(episodes[f"stats/observation.images.wrist_depth/{name}"][0])[0]
        assert (first <= value).mean() >= share > (first < value).mean()


@pytest.mark.parametrize("with_images", [False, True])
def test_demonstrations_become_episodes_with_a_frame_for_each_move(tmp_path: Path, with_images: bool) -> None:
    path = write_trajectories(tmp_path / "trajectory.h5", with_images)
    out = tmp_path / "converted"
    done = convert_to_lerobot([path], out)
    assert (done.episodes, done.frames) == (2, 5)  # The one without a move is left out.
    rows, features = table_of(out), info_of(out)["features"]
    assert features["action"]["names"] == ["right", "up", "forward"]
    with h5py.File(path) as opened:
        file: Any = opened
        for name, begin, count in (("traj_0", 0, 2), ("traj_2", 2, 3)):
            group = file[name]
            these = slice(begin, begin + count)
            assert np.array_equal(rows["action"][these], group["actions"])
            assert np.array_equal(rows["next.reward"][these], group["rewards"])
            assert rows["next.done"][these] == [False] * (count - 1) + [True]
            state = group["obs/agent/qpos"] if with_images else group["obs"]
            assert np.array_equal(rows["observation.state"][these], state[:-1])
            if with_images:
                assert rows["observation.time"][these] == group["obs/extra/time"][:-1, 0].tolist()
                for k in range(count):
                    seen = pixels(rows["observation.images.d435"][begin + k])
                    assert np.array_equal(seen, group["obs/sensor_data/d435/rgb"][k])
                    seen = pixels(rows["observation.images.d435_depth"][begin + k])
                    assert np.array_equal(seen, group["obs/sensor_data/d435/depth"][k, ..., 0])
    assert with_images == (features["observation.state"]["names"][0] == "joint_1.pos")


def test_depth_can_be_left_out(tmp_path: Path) -> None:
    path = write_trajectories(tmp_path / "trajectory.h5", with_images=True)
    out = tmp_path / "converted"
    main(["convert", str(path), "--to", "lerobot", "--out", str(out), "--no-depth"])
    assert {name for name in table_of(out) if "images" in name} == {"observation.images.d435"}
    assert "observation.images.d435_depth" not in info_of(out)["features"]


def soft_link(path: Path) -> None:
    write_trajectories(path.with_name("other.h5"))
    with h5py.File(path, "a") as file:
        del file["traj_2/rewards"]
        file["traj_2/rewards"] = h5py.ExternalLink("other.h5", "/traj_0/rewards")


def nan_in_a_reward(path: Path) -> None:
    with h5py.File(path, "a") as file:
        rewards: Any = file["traj_2/rewards"]
        rewards[1] = np.nan


def short_views(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["traj_2/obs"]
        file["traj_2/obs"] = np.zeros((2, 9), np.float32)


def other_size(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["traj_2/obs"]
        file["traj_2/obs"] = np.zeros((4, 8), np.float32)


def text(path: Path) -> None:
    with h5py.File(path, "a") as opened:
        file: Any = opened
        del file["traj_0/obs"]
        file["traj_0/obs"] = np.array([b"a", b"b", b"c"])


def no_actions(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["traj_0/actions"]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:3000])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (soft_link, "traj_2/rewards must lie in the file itself"),
        (nan_in_a_reward, "traj_2, frame 1: next.reward holds numbers that are not finite"),
        (short_views, "traj_2 must hold obs for each of its 3 moves"),
        (other_size, r"traj_2, frame 0: observation.state must be float32 of shape \(9,\)"),
        (text, "must hold numbers"),
        (no_actions, r"must hold actions of shape \(T, A\)"),
        (cut, "cannot be read as demonstrations"),
        (lambda path: path.with_suffix(".json").unlink(), "there is no file .*json"),
    ],
)
def test_demonstrations_that_cannot_be_used_leave_nothing(tmp_path: Path, change: Any, message: str) -> None:
    source = tmp_path / "source"
    source.mkdir()
    path = write_trajectories(source / "trajectory.h5")
    change(path)
    with pytest.raises(InvalidInputError, match=message):
        convert_to_lerobot([path], tmp_path / "out" / "converted")
    assert not list(tmp_path.glob("out/*")) and not list(tmp_path.glob("out/.*"))


def test_sources_that_do_not_go_together_are_refused(recordings: tuple[Path, Path], tmp_path: Path) -> None:
    path = write_trajectories(tmp_path / "trajectory.h5")
    images = write_trajectories(tmp_path / "images.h5", with_images=True)
    for sources, message in (
        ([recordings[0], path], "convert them apart"),
        ([path, images], "because observation.images.d435 is image of shape .* there and missing here"),
        ([], "name one recording"),
        ([tmp_path / "no.mcap"], "there is no file"),
        ([tmp_path / "trajectory.json"], "must end in .mcap or .h5"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            convert_to_lerobot(sources, tmp_path / "converted")
    wrong: tuple[dict[str, Any], ...] = ({"fps": 0}, {"task": " "}, {"task": "a\nb"})
    for options in wrong:
        message = f"--{next(iter(options))} must be"
        with pytest.raises(InvalidInputError, match=message):
            convert_to_lerobot([path], tmp_path / "converted", **options)
    assert not (tmp_path / "converted").exists()


def test_what_is_there_is_never_overwritten(tmp_path: Path) -> None:
    path = write_trajectories(tmp_path / "trajectory.h5")
    out = tmp_path / "converted"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    with pytest.raises(InvalidInputError, match="converted exists; choose another place"):
        convert_to_lerobot([path], out)
    assert [p.name for p in out.iterdir()] == ["mine.txt"]
    (out / "mine.txt").unlink()
    convert_to_lerobot([path], out)  # An empty folder is nobody's.
    with pytest.raises(InvalidInputError, match="converted exists"):
        convert_to_lerobot([path], out)


def test_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    path = write_trajectories(tmp_path / "trajectory.h5", with_images=True)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with pytest.raises(NotWrittenError, match="nothing was left there"):
            convert_to_lerobot([path], tmp_path / "out" / "converted")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list((tmp_path / "out").iterdir()) == []


def episode(frames: list[dict[str, NDArray[Any]]]) -> Episode:
    def each() -> Iterator[dict[str, NDArray[Any]]]:
        yield from frames

    return Episode(task="t", frames=each(), source="made up")


def test_a_frame_that_is_not_as_its_feature_says_is_refused_by_name(tmp_path: Path) -> None:
    features: dict[str, Feature] = {
        "a": vector(("x", "y")),
        "b": flag(),
        "rgb": color(4, 6),
        "far": depth(4, 6),
    }
    good: dict[str, NDArray[Any]] = {
        "a": np.zeros(2, np.float32),
        "b": np.array([True]),
        "rgb": np.zeros((4, 6, 3), np.uint8),
        "far": np.full((4, 6, 1), 65535, np.uint16),
    }
    writer = LeRobotWriter(tmp_path, features, 1, "robot")
    for name, value in (
        ("a", np.zeros(2)),
        ("a", np.array([0.0, np.inf], np.float32)),
        ("b", np.array([1])),
        ("rgb", np.zeros((4, 6, 1), np.uint8)),
        ("far", np.zeros((4, 6, 1), np.uint8)),
    ):
        with pytest.raises(InvalidInputError, match=f"made up, frame 1: {name} "):
            writer.add(episode([good, {**good, name: value}]))
    with pytest.raises(InvalidInputError, match="has no far"):
        writer.add(episode([{k: v for k, v in good.items() if k != "far"}]))
    with pytest.raises(InvalidInputError, match="has no frame"):
        writer.add(episode([]))
    with pytest.raises(InvalidInputError, match="no episode"):
        writer.finish()
    assert writer.add(episode([good])) == 1
    writer.finish()
    assert (pixels(table_of(tmp_path)["far"][0]) == 65535).all()
    for name in ("index", "a/b"):
        with pytest.raises(TomatoError, match="must not be called"):
            LeRobotWriter(tmp_path, {name: flag()}, 1, "robot")


def test_large_data_sets_are_several_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maniskill_tomato.conversion.lerobot_dataset.LARGEST_FILE_MB", 0.01)
    rng = np.random.default_rng(0)
    writer = LeRobotWriter(tmp_path, {"rgb": color(40, 50)}, 1, "robot")
    frames = [{"rgb": rng.integers(0, 256, (40, 50, 3), dtype=np.uint8)} for _ in range(4)]
    for k in range(4):
        writer.add(episode([frames[k]]))
    writer.finish()
    rows = table_of(tmp_path, "meta/episodes/chunk-000/file-000.parquet")
    assert rows["data/file_index"] == [0, 1, 2, 3]
    third = table_of(tmp_path, "data/chunk-000/file-002.parquet")
    assert third["episode_index"] == [2] and np.array_equal(pixels(third["rgb"][0]), frames[2]["rgb"])
