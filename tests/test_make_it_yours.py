"""The package of `examples/make_it_yours`, built outside of the repository: the commands use everything in it."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torchvision.models.detection import maskrcnn_resnet50_fpn

from maniskill_tomato.cli import main
from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.deploy_errors import NotConnectedError
from maniskill_tomato.deploy.drivers import DriverContext, make_camera
from maniskill_tomato.deploy.interface import Frame
from maniskill_tomato.policies.trained_actor import load_actor

EXAMPLE = Path(__file__).parents[1] / "examples" / "make_it_yours"
TASK = "TomatoFromBelow-v1"

pytestmark = pytest.mark.usefixtures("extras")


def test_train_and_eval_take_its_task_plants_and_policy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["--num-envs", "1", "--total-timesteps", "10", "--learning-starts", "8", "--batch-size", "8"]
    main(["train", TASK, "--plant", "potted", *few, "--out", str(tmp_path / "run")])
    policy = tmp_path / "run" / "policy.pt"
    assert load_actor(policy).env_id == TASK
    assert load_actor(policy).env_options == {"plant": {"generator": "potted"}}
    main(["train", "--resume", str(tmp_path / "run"), "--total-timesteps", "14"])
    assert load_actor(policy).counters["steps"] == 14
    out = tmp_path / "eval"
    judged = ["--episodes", "1", "--no-baseline", "--no-video", "--beside", "spiral", "--out", str(out)]
    main(["eval", TASK, "--policy", str(policy), "--plant", "potted", *judged])
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["env_id"] == TASK and metrics["beside"]["spiral"]["episodes"] == 1
    report = (out / "report.html").read_text()
    assert f"maniskill-tomato eval {TASK} --policy {policy}" in report and "--plant potted" in report
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(["eval", TASK, "--plant", "poted"])
    assert "did you mean 'potted'" in capsys.readouterr().err


def test_detect_takes_its_segmenter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The public weights are a download; random ones of the same network stand in their place.
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    place = tmp_path / "hub" / "checkpoints"
    place.mkdir(parents=True)
    torch.manual_seed(0)
    network = maskrcnn_resnet50_fpn(weights=None, weights_backbone=None)
    torch.save(network.state_dict(), place / "maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth")
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((48, 64, 3), 90, np.uint8))
    out = tmp_path / "found.json"
    main(["detect", str(tmp_path / "grey.png"), "--segmenter", "coco", "--out", str(out)])
    assert {fruit["category"] for fruit in json.loads(out.read_text())} <= {"tomato"}


def test_deploy_moves_its_arm(tmp_path: Path) -> None:
    profile = tmp_path / "iiwa7.toml"
    profile.write_text((EXAMPLE / "iiwa7_twin.toml").read_text() + "\n[loop]\nmax_moves = 1\n")
    main(["deploy", "run", "--profile", str(profile), "--policy", "spiral", "--out", str(tmp_path / "run")])
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert (result["policy_name"], result["moves"]) == ("spiral", 1)


@pytest.fixture
def pictures(tmp_path: Path) -> tuple[Path, Frame]:
    """A folder with a picture of the twin, and the picture."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    context = DriverContext(clock=SimulatedClock(0.0), seed=3)
    with make_camera("mock", {"episodes": "held_out", "width": 424, "height": 240}, context) as camera:
        frame = camera.read()
    cv2.imwrite(str(folder / "color_000.png"), frame.color[..., ::-1])
    cv2.imwrite(str(folder / "depth_000.png"), np.rint(1000.0 * frame.depth).astype(np.uint16))
    numbers = {name: getattr(frame.intrinsics, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps(numbers))
    return folder, frame


def test_its_camera_shows_the_pictures_of_a_folder(pictures: tuple[Path, Frame]) -> None:
    folder, frame = pictures
    clock = SimulatedClock(5.0)
    camera: Any = make_camera("folder", {"folder": str(folder)}, DriverContext(clock=clock))
    with camera:
        shown, again = camera.read(), camera.read(after=clock.now())
    np.testing.assert_array_equal(shown.color, frame.color)
    np.testing.assert_allclose(shown.depth, frame.depth, atol=5.1e-4)
    assert shown.intrinsics == frame.intrinsics
    assert again.number == shown.number + 1 and again.stamp > shown.stamp >= 5.0
    empty: Any = make_camera("folder", {"folder": str(folder.parent)}, DriverContext(clock=clock))
    with pytest.raises(NotConnectedError, match="must hold"):
        empty.connect()
    (folder / "color_001.png").write_bytes((folder / "color_000.png").read_bytes())
    with pytest.raises(NotConnectedError, match="there is no .*depth_001.png"):
        camera.connect()
    assert not camera.is_connected


def test_deploy_check_looks_through_its_camera(
    pictures: tuple[Path, Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = pictures
    profile = tmp_path / "folder.toml"
    text = (EXAMPLE / "folder_camera.toml").read_text().replace('"pictures"', f'"{folder}"')
    profile.write_text(text.replace('"light"', '"colour"'))
    main(["deploy", "check", "--profile", str(profile), "--out", str(tmp_path / "check")])
    told = capsys.readouterr().out
    assert "camera        driver folder" in told and "target        at [" in told
