"""Exported policies in the loop: the same moves as in PyTorch, and files that must not move an arm."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from maniskill_tomato.assets import asset_path
from maniskill_tomato.cli import main
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.deploy.robot_perception import RobotBelief
from maniskill_tomato.deploy.run_records import KeptSteps
from maniskill_tomato.deploy.run_replay import load_recording, replay
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.errors import PolicyError
from maniskill_tomato.files import write_tensors
from maniskill_tomato.learning.rl.agent import make_agent
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.export import export_policy
from maniskill_tomato.learning.rl.presets import get_preset
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.observation import ObservationLayout
from twin_profile import TWIN_PROFILE

TASK = "TomatoViewpoint-v1"
SEED = 9
PROFILE = (
    TWIN_PROFILE
    + """
[loop]
max_moves = 5
threshold = 0.999
"""
)


def saved(path: Path, bound: float = 1.0) -> Path:
    """A policy of the general task as `train` saves it, with weights that no training touched."""
    torch.manual_seed(3)
    agent = make_agent(get_preset("general-td3"), ObservationLayout().size, 3)
    with torch.no_grad():
        agent.actor.output.weight *= 10.0
        agent.actor.output.bias[:] = torch.tensor([0.6, 0.8, 0.5])
    bounds = (-bound * torch.ones(3), bound * torch.ones(3))
    write_tensors(path, make_checkpoint(agent, TASK, bounds, {"steps": 1, "episodes": 1, "seed": 3}))
    return path


def saved_with_eyes(path: Path) -> Path:
    """A policy that observes images, with weights that no training touched."""
    torch.manual_seed(3)
    agent = make_agent(get_preset("general-pixel-td3"), 11, 3, privileged_dim=ObservationLayout().size)
    with torch.no_grad():
        agent.actor.output.weight *= 30.0
    bounds = (-torch.ones(3), torch.ones(3))
    write_tensors(path, make_checkpoint(agent, TASK, bounds, {"steps": 1, "episodes": 1, "seed": 3}))
    return path


def change_constant(model: Path, name: str, value: float) -> None:
    """Writes a value into a constant of the graph, and the SHA-256 that belongs to it: a valid pair of files."""
    proto = onnx.load(str(model))
    constant = next(tensor for tensor in proto.graph.initializer if tensor.name == name)
    constant.CopyFrom(numpy_helper.from_array(np.full(3, value, dtype=np.float32), name))
    content = proto.SerializeToString()
    model.write_bytes(content)
    description = json.loads(model.with_suffix(".json").read_text())
    description["onnx"]["sha256"] = hashlib.sha256(content).hexdigest()
    model.with_suffix(".json").write_text(json.dumps(description))


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(PROFILE)
    return path


def run(profile: Path, policy: Path, out: Path) -> dict[str, Any]:
    arguments = ["--profile", str(profile), "--policy", str(policy), "--seed", str(SEED), "--out", str(out)]
    main(["deploy", "run", *arguments])
    content: dict[str, Any] = json.loads((out / "result.json").read_text())
    return content


def test_an_exported_policy_makes_the_moves_that_it_makes_in_torch(tmp_path: Path, profile: Path) -> None:
    source = saved(tmp_path / "policy.pt")
    content = run(profile, export_policy(source, tmp_path / "exported").model, tmp_path / "out")
    assert content["reason"] == "budget" and content["policy"].endswith("policy.onnx")
    exported = [step.facts for step in load_recording(tmp_path / "out" / "run.mcap").steps]
    workcell, kept = make_workcell(load_profile(str(profile)), SEED), KeptSteps()
    with workcell.arm, workcell.camera, Stops() as stops:
        policy = open_policy(source, env_id=TASK)
        Loop(workcell, policy, stops, "unattended", [kept]).run()
    # Five moves; a way to another view takes several looks.
    assert len(kept.steps) == len(exported) >= 6
    assert any(step.outcome == "moved" for step in kept.steps)
    for step, facts in zip(kept.steps, exported, strict=True):
        assert step.outcome == facts["outcome"]
        np.testing.assert_allclose(step.joint_positions, facts["joint_positions"], atol=1e-4)
        assert (step.action is None) == (facts["action"] is None)
        if step.action is not None:
            np.testing.assert_allclose(step.action, facts["action"], atol=1e-4)
    moves = np.array([step.action for step in kept.steps if step.action is not None])
    assert len(moves) >= 3
    assert np.abs(moves).min() > 1e-3 and np.ptp(moves, axis=0).max() > 1e-3, "it looks at what it sees"


@pytest.mark.parametrize(
    ("constant", "value", "words"),
    [("output.bias", float("nan"), "not finite"), ("scale", 2.0, "outside [-1, 1]")],
)
def test_an_exported_policy_that_answers_nonsense_moves_nothing(
    constant: str,
    value: float,
    words: str,
    tmp_path: Path,
    profile: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """NaN in its weights; or a scale and bounds that reach beyond those of the task."""
    model = export_policy(saved(tmp_path / "policy.pt", bound=2.0), tmp_path / "exported").model
    change_constant(model, constant, value)
    with pytest.raises(SystemExit) as end:
        run(profile, model, tmp_path / "out")
    assert end.value.code == 3
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert (content["reason"], content["moves"], content["success"]) == ("policy", 0, False)
    assert words in content["detail"] and content["steps"] == []
    assert capsys.readouterr().err.strip().endswith(f"error: {content['detail']}")


def test_exported_policies_of_other_tasks_and_damaged_ones_are_refused_before_anything_begins(
    tmp_path: Path, profile: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = export_policy(asset_path("policies/TomatoViewpointGuided-v1.pt"), tmp_path / "other").model
    damaged = export_policy(saved(tmp_path / "policy.pt"), tmp_path / "damaged").model
    damaged.write_bytes(damaged.read_bytes()[:-20])
    alone = tmp_path / "alone.onnx"
    alone.write_bytes(other.read_bytes())
    for model, words in (
        (other, "was trained on TomatoViewpointGuided-v1, not on TomatoViewpoint-v1"),
        (damaged, "SHA-256 differ"),
        (alone, "must stay together"),
        (
            asset_path("policies/TomatoViewpointSparse-v1.pt"),
            "was trained on TomatoViewpointSparse-v1, not on",
        ),
    ):
        with pytest.raises(SystemExit) as end:
            run(profile, model, tmp_path / "out")
        assert end.value.code == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and words in error and error.count("\n") == 1
        assert not (tmp_path / "out").exists()
        with pytest.raises(PolicyError):
            open_policy(str(model), env_id=TASK)


@pytest.mark.parametrize("sight", ["images", "rays"])
def test_a_policy_of_images_moves_the_twin_and_its_recording_replays(
    tmp_path: Path, profile: Path, sight: str
) -> None:
    profile.write_text(PROFILE.replace("[perception]", f'[perception]\nsight = "{sight}"'))
    policy = export_policy(saved_with_eyes(tmp_path / "policy.pt"), tmp_path / "exported").model
    content = run(profile, policy, tmp_path / "out")
    assert content["reason"] == "budget"
    steps = [step.facts for step in load_recording(tmp_path / "out" / "run.mcap").steps]
    actions = np.array([facts["action"] for facts in steps if facts["action"] is not None])
    assert len(actions) >= 3 and np.ptp(actions, axis=0).max() > 1e-3, "it looks at what it sees"
    assert not replay(load_recording(tmp_path / "out" / "run.mcap"), str(policy)).differences


def test_the_twins_true_roles_are_those_of_the_simulated_task(tmp_path: Path, profile: Path) -> None:
    profile.write_text(PROFILE.replace("[perception]", '[perception]\nsight = "rays"'))
    workcell = make_workcell(load_profile(str(profile)), SEED)
    layout = ImageLayout(kinds=("depth", "segmentation"), width=64, height=48)
    with workcell.arm, workcell.camera:
        joints = workcell.arm.read().joint_positions
        frame = workcell.camera.read()
        belief = RobotBelief(workcell.profile.T_flange_camera, 5)
        sighting = workcell.perception.look(frame, belief.camera_pose(joints))
        assert sighting.images is not None and frame.truth is not None
        images = sighting.images(layout)
    role = images["segmentation"][0, ..., 0].numpy()
    assert {int(Role.STEM), int(Role.LEAF)} <= set(np.unique(role).tolist())
    rows = ((np.arange(48) + 0.5) * 120 / 48).astype(int)
    columns = ((np.arange(64) + 0.5) * 160 / 64).astype(int)
    labels = frame.truth.labels[np.ix_(rows, columns)]
    assert np.array_equal(role == int(Role.TARGET), labels == frame.truth.target_label)
    assert np.array_equal(role == int(Role.BACKGROUND), labels == 0)
    assert np.array_equal(np.isin(labels, frame.truth.stem_labels), role == int(Role.STEM))
