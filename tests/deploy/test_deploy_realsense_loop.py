"""The loop over a recording of the RealSense SDK: pictures, segmenter, policy, safety, arm."""

import importlib.util
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.cli import main
from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.deploy_errors import NotConnectedError
from maniskill_tomato.deploy.drivers import DriverContext
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.mock.twin_world import TwinWorld, twin_options, twin_world
from maniskill_tomato.deploy.profile import Profile, parse_profile
from maniskill_tomato.deploy.realsense.realsense_config import RealSenseConfig
from maniskill_tomato.deploy.realsense.source import FrameSource, load_sdk
from maniskill_tomato.deploy.run_records import KeptSteps, RunResult, Step
from maniskill_tomato.deploy.run_replay import load_recording
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.robot import d435
from maniskill_tomato.sensing.belief import Belief

if importlib.util.find_spec("pyrealsense2") is None:
    pytest.skip("the extra `hardware` is not installed", allow_module_level=True)

SEED = 9
COLOR = d435.color_intrinsics(640, 480)
DEPTH = d435.depth_intrinsics(424, 240)
PROFILE = """
[arm]
driver = "mock"
[camera]
driver = "{camera}"
{recording}
[twin]
width = 640
height = 480
depth_noise = 0.0
[perception]
segmenter = "{segmenter}"
[target]
source = "{source}"
{position}
[loop]
max_moves = 2
threshold = 0.99
"""


class Waving(Planner):
    """The same moves whatever it sees."""

    name = "waving"

    def __init__(self) -> None:
        self.moves = [(0.5, 0.3, 0.1), (-0.2, 0.4, 0.2)]
        self.beliefs: list[Tensor] = []

    def act(self, belief: Belief) -> Tensor:
        self.beliefs.append(belief.observation.clone())
        return torch.tensor([self.moves[len(self.beliefs) - 1]])


def world() -> TwinWorld:
    options = twin_options({"width": 640, "height": 480})
    return twin_world(options, DriverContext(clock=SimulatedClock(), seed=SEED))


def record(
    path: Path, of: TwinWorld, postures: Sequence[Float64], stamps_s: Sequence[float] | None = None
) -> None:
    """What a D435 would send from these postures: colours, and raw depth from the left infrared imager."""
    from maniskill_tomato.deploy.realsense.realsense_recording import write_recording

    pictures: list[tuple[NDArray[np.uint8], NDArray[np.uint16]]] = []
    for joints in postures:
        camera, links = of._poses(joints)
        picture = of.scene.picture(of.intrinsics, camera[0], of.episode.T_world_plant, links[0])
        left = camera[0] @ torch.tensor(np.array(d435.T_color_optical_depth_optical), dtype=torch.float32)
        depth = of.scene.picture(DEPTH, left, of.episode.T_world_plant, links[0]).depth
        pictures.append((of.color(picture), np.round(1000.0 * depth).astype(np.uint16)))
    mount = np.array(d435.T_color_optical_depth_optical)
    write_recording(path, pictures, COLOR, DEPTH, mount, stamps_s=stamps_s)


def profile(path: Path, recording: Path | None, target: Float64 | None = None) -> Profile:
    """Of the recording and a segmenter, or of the twin and the truth."""
    played = f'recording = "{recording}"\ntemporal = false' if recording else ""
    text = PROFILE.format(
        camera="realsense" if recording else "mock",
        recording=played,
        segmenter="colour" if recording else "ground_truth",
        source="seen" if target is None else "given",
        position="" if target is None else f"position = {target.tolist()}",
    )
    path.write_text(text)
    return parse_profile(text, path)


def run(of: Profile, policy: Planner) -> tuple[RunResult, list[Step]]:
    kept, workcell = KeptSteps(), make_workcell(of, SEED)
    with workcell.arm, workcell.camera, Stops() as stops:
        result = Loop(workcell, policy, stops, "unattended", [kept]).run()
    return result, kept.steps


def test_pictures_of_a_recording_guide_the_arm_as_the_twins_own_do(tmp_path: Path) -> None:
    made = world()
    start = made.episode.start_joints
    fruits = [
        made.episode.T_world_plant.double().numpy() @ [*f.centre, 1.0] for f in made.episode.plant.fruits
    ]

    # A dry run from the shell: one picture, the first move shown, nothing sent.
    record(tmp_path / "first.db3", made, [start] * 2)
    profile(tmp_path / "first.toml", tmp_path / "first.db3")
    out = tmp_path / "out"
    options = ["--profile", str(tmp_path / "first.toml"), "--seed", str(SEED), "--out", str(out), "--dry-run"]
    main(["deploy", "run", *options])
    content = json.loads((out / "result.json").read_text())
    assert (content["reason"], content["refused_moves"]) == ("dry_run", 0), content["detail"]
    assert content["devices"]["camera"]["driver"] == "realsense"
    assert "the first move would go to (" in content["detail"]
    target = np.array(load_recording(out / "run.mcap").steps[0].facts["target_position"])
    nearest = min(float(np.linalg.norm(fruit[:3] - target)) for fruit in fruits)
    assert nearest < 0.015, "segmented in colour, located by depth, put into the world by the flange's pose"

    # The twin's own camera, with the truth: where the arm goes.
    expected_policy = Waving()
    expected, twin_steps = run(profile(tmp_path / "twin.toml", None, target), expected_policy)
    assert expected.reason == "budget" and [s.outcome for s in twin_steps[:2]] == ["moved"] * 2

    # A recording from those viewpoints, played to the whole loop.
    stamps = [step.frame.stamp for step in twin_steps]
    record(tmp_path / "views.db3", made, [step.joint_positions for step in twin_steps], stamps)
    policy = Waving()
    result, steps = run(profile(tmp_path / "views.toml", tmp_path / "views.db3", target), policy)
    assert not result.is_fault and result.reason == "budget", result.detail
    assert len(steps) == len(twin_steps) == 3
    np.testing.assert_allclose(np.diff([s.frame.stamp for s in steps]), np.diff(stamps), atol=1e-6)
    for step, twin_step in zip(steps, twin_steps, strict=True):
        np.testing.assert_allclose(step.joint_positions, twin_step.joint_positions, atol=2e-3)
        mine, known = step.view.mask, twin_step.view.mask
        assert (mine & known).sum() > 0.5 * min(mine.sum(), known.sum()) > 20, "the same fruit, by its colour"
        both = (step.frame.depth > 0.0) & (twin_step.frame.depth > 0.0)
        assert both.mean() > 0.3
        assert float(np.median(np.abs(step.frame.depth - twin_step.frame.depth)[both])) < 0.004
    for seen, wanted in zip(policy.beliefs, expected_policy.beliefs, strict=True):
        assert float((seen - wanted).abs().median()) < 0.01


class StallingSdk:
    """The SDK on a machine that stalls for half a second after the streams' start."""

    def __init__(self, sdk: Any) -> None:
        self._sdk = sdk

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sdk, name)

    def pipeline(self, context: Any) -> "StallingPipeline":
        return StallingPipeline(self._sdk.pipeline(context))

    def pipeline_wrapper(self, stalling: "StallingPipeline") -> Any:
        return self._sdk.pipeline_wrapper(stalling.pipeline)


class StallingPipeline:
    """Its pipeline."""

    def __init__(self, pipeline: Any) -> None:
        self.pipeline = pipeline

    def __getattr__(self, name: str) -> Any:
        return getattr(self.pipeline, name)

    def start(self, settings: Any) -> Any:
        profile = self.pipeline.start(settings)
        time.sleep(0.5)
        return profile


def test_no_picture_of_a_recording_is_lost_to_a_busy_machine(tmp_path: Path) -> None:
    made = world()
    record(tmp_path / "views.db3", made, [made.episode.start_joints] * 3)
    config = RealSenseConfig(recording=str(tmp_path / "views.db3"), temporal=False)
    source = FrameSource(StallingSdk(load_sdk()), config)
    numbers = [source.next(2.0).get_color_frame().get_frame_number() for _ in range(3)]
    assert numbers == [1, 2, 3]
    with pytest.raises(NotConnectedError, match="over"):
        source.next(2.0)
    source.close()
