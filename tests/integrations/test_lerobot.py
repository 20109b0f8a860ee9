"""Data sets and plug-ins in the real LeRobot, which needs an environment of its own.

`MANISKILL_TOMATO_LEROBOT_PYTHON` names its Python; docs/lerobot.md says how it is made. What LeRobot says there is
compared here with values from the files, or from plain loops over the tasks.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.cli import main
from maniskill_tomato.conversion.lerobot_conversion import convert_to_lerobot
from maniskill_tomato.deploy.policy_run import RunConfig, run
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.deploy.run_replay import load_recording
from maniskill_tomato.tasks.vector_env import make_vector_env

ROOT = Path(__file__).resolve().parents[2]
INTEGRATIONS = ROOT / "integrations" / "lerobot"
PLUGINS = ("lerobot_robot_kuka_iiwa", "lerobot_camera_maniskill_tomato", "lerobot_env_maniskill_tomato")
PYTHON = "MANISKILL_TOMATO_LEROBOT_PYTHON"
SECONDS = 570

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def lerobot() -> str:
    """The Python of LeRobot's environment."""
    path = os.environ.get(PYTHON)
    if path is None:
        pytest.skip(f"{PYTHON} names no environment with LeRobot")
    return path


@pytest.fixture(scope="module")
def plugins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The plug-ins, built and unpacked as pip installs them."""
    site = tmp_path_factory.mktemp("site")
    for name in PLUGINS:
        source = tmp_path_factory.mktemp("source") / name
        shutil.copytree(INTEGRATIONS / name, source)
        command = [
            sys.executable,
            "-m",
            "build",
            "--wheel",
            "--no-isolation",
            "--outdir",
            str(source / "dist"),
        ]
        subprocess.run([*command, str(source)], check=True, capture_output=True, timeout=SECONDS)
        (wheel,) = (source / "dist").glob("*.whl")
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(site)
    return site


def said(lerobot: str, words: list[str], site: Path | None = None) -> dict[str, Any]:
    """What `check_with_lerobot.py` prints."""
    places = [str(ROOT)] if site is None else [str(site), str(ROOT)]
    given = {"HF_HUB_OFFLINE": "1", "CUDA_VISIBLE_DEVICES": "", "PYTHONPATH": os.pathsep.join(places)}
    found = subprocess.run(
        [lerobot, str(INTEGRATIONS / "check_with_lerobot.py"), *words],
        capture_output=True,
        text=True,
        timeout=SECONDS,
        env={**os.environ, **given},
    )
    assert found.returncode == 0, found.stderr[-6000:]
    answer: dict[str, Any] = json.loads(found.stdout.splitlines()[-1])
    return answer


def digest(image: NDArray[Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest()


def check_statistics(off: dict[str, dict[str, float]], features: dict[str, Any]) -> None:
    """LeRobot's own writer finds the same.

    Its quantiles are those of histograms of 5000 bins, its deviations the difference of two large sums in single
    precision, and of images from 300 pixels on it takes every second pixel or fewer.
    """
    assert set(off) == set(features)
    for key, one in off.items():
        assert set(one) == {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}
        is_thinned = features[key]["dtype"] == "image" and max(features[key]["shape"]) >= 300
        for name, share in one.items():
            allowed = 0.02 if is_thinned else 1e-5 if name in ("min", "max", "mean", "count") else 1e-3
            assert share <= allowed, f"{name} of {key} is off by {share} of the range"


def test_the_name_of_each_distribution_is_that_of_its_module(plugins: Path) -> None:
    for name in PLUGINS:
        (metadata,) = plugins.glob(f"{name}-*.dist-info/METADATA")
        assert Parser().parsestr(metadata.read_text())["Name"] == name
        assert (plugins / name / "__init__.py").is_file()


def test_lerobot_loads_runs_as_they_were_recorded(lerobot: str, tmp_path: Path) -> None:
    paths = []
    for seed in (3, 9):
        out = tmp_path / f"run-{seed}"
        run(RunConfig(profile=load_profile("mock"), out=out, policy="nbv", seed=seed))
        paths.append(out / "run.mcap")
    converted = tmp_path / "converted"
    main(["convert", *map(str, paths), "--to", "lerobot", "--out", str(converted)])
    runs = [load_recording(path) for path in paths]
    answer = said(lerobot, ["dataset", str(converted), str(tmp_path / "work")])
    steps = [(one, k) for one in runs for k in range(len(one.steps))]
    assert len(answer["frames"]) == len(steps)
    assert answer["depth_keys"] == ["observation.images.wrist_depth"]
    for frame, back, (one, k) in zip(answer["frames"], answer["back"], steps, strict=True):
        step = one.steps[k]
        joints = np.array(step.facts["joint_positions"], np.float32)
        assert np.array_equal(np.array(frame["observation.state"], np.float32), joints)
        assert frame["observation.images.wrist"] == digest(step.frame.color)
        millimetres = np.rint(step.frame.depth.astype(np.float64) * 1000.0).astype(np.uint16)
        assert frame["observation.images.wrist_depth"] == digest(millimetres[..., None])
        assert frame["timestamp"] == frame["frame_index"] == k
        assert frame["task"] == "Look at the tomato until it is fully visible."
        before = one.steps[max(0, k - 1)].facts["joint_positions"]
        assert np.array_equal(np.array(back["state"], np.float32)[0], np.array(before, np.float32))
        assert back["action_is_pad"] == [False, k == len(one.steps) - 1]
    assert answer["batches"][0]["observation.images.wrist_depth"] == [3, 1, 240, 424]
    check_statistics(answer["rewritten"]["off"], answer["rewritten"]["info"]["features"])
    lengths = [len(one.steps) for one in runs]
    ours, theirs = json.loads((converted / "meta" / "info.json").read_text()), answer["rewritten"]["info"]
    assert ours == theirs
    assert answer["edited"]["kept"] == [lengths[1], 1]
    assert answer["edited"]["merged"] == [sum(lengths) + lengths[1], 3]
    first = np.array(runs[1].steps[0].facts["joint_positions"], np.float32)
    assert np.array_equal(np.array(answer["edited"]["first_kept"], np.float32), first)
    assert np.isfinite(answer["loss"]) and answer["loss"] > 0.0


@pytest.mark.render
def test_lerobot_loads_demonstrations_with_images(lerobot: str, tmp_path: Path) -> None:
    import gymnasium as gym
    from mani_skill.utils.wrappers.record import RecordEpisode

    size = {"width": 64, "height": 48}
    env: Any = gym.make("TomatoViewpoint-v1", obs_mode="rgb+depth+segmentation", sensor_configs=size)
    env = RecordEpisode(
        env,
        output_dir=str(tmp_path),
        save_video=False,
        trajectory_name="trajectory",
        source_type="motionplanning",
        source_desc="random moves",
    )
    for seed in (0, 1):
        env.reset(seed=seed)
        for _ in range(2 + seed):
            env.step(env.action_space.sample())
    env.close()
    convert_to_lerobot([tmp_path / "trajectory.h5"], tmp_path / "converted")
    answer = said(lerobot, ["dataset", str(tmp_path / "converted"), str(tmp_path / "work")])
    with h5py.File(tmp_path / "trajectory.h5") as opened:
        file: Any = opened
        moves = [(file[name], k) for name, count in (("traj_0", 2), ("traj_1", 3)) for k in range(count)]
        assert len(answer["frames"]) == len(moves)
        for frame, (group, k) in zip(answer["frames"], moves, strict=True):
            camera = group["obs/sensor_data/d435"]
            assert frame["observation.images.d435"] == digest(camera["rgb"][k])
            depth = camera["depth"][k].astype(np.uint16)
            assert frame["observation.images.d435_depth"] == digest(depth)
            assert np.array_equal(np.array(frame["action"], np.float32), group["actions"][k])
            assert np.array_equal(np.array(frame["observation.pose"], np.float32), group["obs/extra/pose"][k])
    check_statistics(answer["rewritten"]["off"], answer["rewritten"]["info"]["features"])
    assert (
        json.loads((tmp_path / "converted" / "meta" / "info.json").read_text()) == answer["rewritten"]["info"]
    )
    assert np.isfinite(answer["loss"])


def test_lerobot_drives_the_guarded_arm_and_is_refused_what_is_unsafe(
    lerobot: str, plugins: Path, tmp_path: Path
) -> None:
    answer = said(lerobot, ["robot", str(tmp_path)], plugins)
    assert answer["unconnected"].startswith("DeviceNotConnectedError")
    assert answer["connected_twice"].startswith("DeviceAlreadyConnectedError")
    for move, sent in zip(answer["moves"], answer["sent"], strict=True):
        assert sent == pytest.approx(move["wanted"], abs=1e-6) and move["depth"] == "uint16"
    ends = [move["joints"] for move in answer["moves"][1:]] + [answer["stands"]]
    for sent, reached in zip(answer["sent"], ends, strict=True):
        assert reached == pytest.approx(sent, abs=1e-3)
    assert answer["recorded"] == 3
    refused = answer["refused"]
    assert refused["far"].startswith("RefusedError: joint_step: joint_2 would turn 2.0000 rad")
    assert refused["nan"].startswith("RefusedError")
    assert (
        "missing: ['joint_2.pos'" in refused["missing"] and "unknown: ['gripper.pos']" in refused["unknown"]
    )
    assert refused["text"].startswith("InvalidInputError: an action must hold numbers")
    assert answer["after"] == pytest.approx(answer["stands"], abs=1e-6)
    assert answer["disconnected"]
    shown = subprocess.run(
        [lerobot, str(INTEGRATIONS / "turn_a_joint.py")],
        capture_output=True,
        text=True,
        timeout=SECONDS,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join((str(plugins), str(ROOT))),
            "HF_LEROBOT_HOME": str(tmp_path),
        },
    )
    assert shown.returncode == 0 and "'joint_7.pos': 1.6517" in shown.stdout, shown.stderr[-3000:]
    start, held = answer["held"]
    assert held == pytest.approx(start, abs=1e-6)
    assert answer["side"] == answer["side_feature"] == [240, 424, 3]
    # What is recorded through LeRobot is what a converted run holds: policies go from one to the other.
    run(RunConfig(profile=load_profile("mock"), out=tmp_path / "run", policy="nbv", seed=3))
    convert_to_lerobot([tmp_path / "run" / "run.mcap"], tmp_path / "converted")
    ours = json.loads((tmp_path / "converted" / "meta" / "info.json").read_text())["features"]
    assert len(answer["features"]) == 4
    for name, feature in answer["features"].items():
        assert {key: ours[name][key] for key in ("dtype", "shape", "names")} == {
            key: feature[key] for key in ("dtype", "shape", "names")
        }
        is_depth, told = (one.get("info", {}).get("is_depth_map", False) for one in (ours[name], feature))
        assert is_depth == told == name.endswith("_depth")
    camera = answer["camera"]
    assert camera["unconnected"].startswith("DeviceNotConnectedError")
    assert {one["id"] for one in camera["known"]} >= {"mock", "iiwa14_d435"}
    assert camera["color"] == ["uint8", [240, 424, 3]] and camera["size"] == [424, 240]
    assert camera["depth"][:2] == ["uint16", [240, 424, 1]] and 100 < camera["depth"][2] < 10_000
    assert camera["again"] and camera["unread"] == camera["kept"] == [240, 424, 3]
    assert camera["late"].startswith("TimeoutError") and camera["stays_closed"]
    assert "width must be 424" in camera["wrong_size"]


def test_lerobot_replays_a_converted_run_on_its_twin_and_on_no_other(
    lerobot: str, plugins: Path, tmp_path: Path
) -> None:
    run(RunConfig(profile=load_profile("mock"), out=tmp_path / "run", policy="nbv", seed=3))
    convert_to_lerobot([tmp_path / "run" / "run.mcap"], tmp_path / "converted")
    places = os.pathsep.join((str(plugins), str(ROOT)))
    given = {"HF_HUB_OFFLINE": "1", "PYTHONPATH": places, "HF_LEROBOT_HOME": str(tmp_path / "home")}

    def replay(seed: int) -> subprocess.CompletedProcess[str]:
        command = [str(Path(lerobot).with_name("lerobot-replay")), "--robot.type=kuka_iiwa"]
        dataset = ["--dataset.repo_id=local/run", f"--dataset.root={tmp_path / 'converted'}"]
        words = [*command, f"--robot.seed={seed}", *dataset, "--dataset.episode=0", "--play_sounds=false"]
        return subprocess.run(
            words, capture_output=True, text=True, timeout=SECONDS, env={**os.environ, **given}
        )

    same = replay(3)
    assert same.returncode == 0, same.stderr[-3000:]
    other = replay(9)  # The arm of this one stands elsewhere.
    assert other.returncode != 0 and "RefusedError" in other.stderr


def scripted_episodes(seeds: range) -> list[tuple[bool, float]]:
    """Success and sum of rewards of the scripted moves, one environment at a time."""
    found = []
    for seed in seeds:
        env = make_vector_env("TomatoViewpointSparse-v1", 1, scene="thesis", max_episode_steps=6)
        env.reset(seed=seed)
        done, success, rewards, step = False, False, 0.0, 0
        while not done:
            action = 0.1 * np.cos(step + np.arange(6, dtype=np.float32))
            _, reward, terminated, truncated, info = env.step(action[None].astype(np.float32))
            done, success = bool(terminated[0] | truncated[0]), bool(info["success"][0])
            rewards += float(reward[0])
            step += 1
        found.append((success, rewards))
    return found


def test_lerobots_evaluation_counts_successes_as_a_plain_loop_does(
    lerobot: str, plugins: Path, tmp_path: Path
) -> None:
    answer = said(lerobot, ["env", str(tmp_path)], plugins)
    assert answer["suite"] == "TomatoViewpoint-v1" and answer["plugin_suite"] == "maniskill_tomato"
    told = answer["next_step"]["episodes"]
    assert [one["seed"] for one in told] == list(range(100, 109))
    expected = scripted_episodes(range(100, 109))
    assert [one["success"] for one in told] == [success for success, _ in expected]
    assert [one["sum_reward"] for one in told] == pytest.approx([reward for _, reward in expected], abs=1e-4)
    assert 0.0 < answer["next_step"]["percent"] < 100.0
    # LeRobot looks one step beyond an episode's end, which with SameStep is the first of the next.
    same = [one["success"] for one in answer["same_step"]["episodes"]]
    assert all(counted or not success for counted, (success, _) in zip(same, expected, strict=True))
    assert answer["features"] == {
        "action": [[3], False],
        "observation.state": [[11], False],
        "observation.images.wrist": [[72, 96, 3], True],
    }
    assert answer["seen"] == {"observation.state": [2, 11], "observation.images.wrist": [2, 3, 72, 96]}
    assert len(answer["films"]) == 2 and min(answer["films"]) > 1000
