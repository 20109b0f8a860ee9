"""Hand-eye calibration from rendered boards: a known camera on the flange comes back, and what is wrong is said."""

import importlib
import json
import os
import pty
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from maniskill_tomato.cli import calibrate_command, main
from maniskill_tomato.cli.operator_prompt import goes
from maniskill_tomato.deploy.calibration.board import CharucoBoard
from maniskill_tomato.deploy.calibration.calibration_file import (
    picture_id,
    read_calibration,
    write_calibration,
)
from maniskill_tomato.deploy.calibration.evaluation import evaluate
from maniskill_tomato.deploy.calibration.hand_eye import (
    BoardView,
    CalibrationError,
    HandEyeResult,
    board_pose,
    calibrate_hand_eye,
)
from maniskill_tomato.deploy.calibration.picture import draw_calibration, print_board
from maniskill_tomato.deploy.calibration.view_capture import CapturePlan, camera_poses, capture_views
from maniskill_tomato.deploy.calibration.view_folder import (
    RecordedView,
    board_view,
    flange_pose,
    read_views,
    write_views,
)
from maniskill_tomato.deploy.clock import Clock, SimulatedClock
from maniskill_tomato.deploy.deploy_errors import ProfileError, StoppedError
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import Arm, ArmState, Camera, Float64, Frame, JointMove
from maniskill_tomato.deploy.profile import Profile, parse_profile
from maniskill_tomato.deploy.rigid import difference, transform
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import d435
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics
from maniskill_tomato.robot.look_at import look_at_pose

BOARD = CharucoBoard()
COLOR = d435.color_intrinsics(640, 480, "measured")
# A bracket 20 mm and 4 degrees off its drawing.
X = d435.T_flange_camera_color_optical @ transform(
    Rotation.from_rotvec([0.03, -0.05, 0.04]), [0.012, -0.008, 0.015]
)
# The board lies on a block before the robot, its print up.
Z = transform(
    Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    * Rotation.from_rotvec([0.1, 0.0, 0.3]),
    [0.5, -0.1, 0.15],
)
TODAY = datetime.now(UTC).isoformat(timespec="seconds")
START = np.deg2rad([0.0, 20.0, 0.0, -95.0, 0.0, 65.0, 0.0])


def rendered(T_camera_board: Float64, seed: int, noise: float = 3.0) -> NDArray[np.uint8]:
    """The board's print seen by the camera: a homography at three times the size, reduced, blurred, with noise."""
    edge, up = 100, 3
    paper = cv2.copyMakeBorder(BOARD.picture(edge), edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=(255,))
    metres = BOARD.square_length / edge
    # From the paper's pixels (OpenCV counts from their centres) to metres on the board, to pixels of the picture.
    to_board = np.array([[metres, 0, (0.5 - edge) * metres], [0, metres, (0.5 - edge) * metres], [0, 0, 1]])
    to_pixels = np.diag([up, up, 1.0]) @ COLOR.matrix @ T_camera_board[:3, [0, 1, 3]]
    shift = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    size = (COLOR.width, COLOR.height)
    large = cv2.warpPerspective(
        paper,
        shift @ to_pixels @ to_board,
        (size[0] * up, size[1] * up),
        flags=cv2.INTER_AREA,
        borderValue=(90,),
    )
    grey = cv2.GaussianBlur(cv2.resize(large, size, interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    noisy = 0.8 * grey + 20.0 + np.random.default_rng(seed).normal(0.0, noise, grey.shape)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def postures(count: int, seed: int = 0, roll: float = 1.0, tilt: float = 0.6) -> list[Float64]:
    """Joint angles from which the camera sees the board."""
    rng = np.random.default_rng(seed)
    kinematics, found = InverseKinematics(), list[Float64]()
    middle = (Z @ np.array([BOARD.size[0] / 2, BOARD.size[1] / 2, 0.0, 1.0]))[:3]
    while len(found) < count:
        angle, azimuth, distance = rng.uniform(0, tilt), rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.42)
        away = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
        pose = look_at_pose(
            torch.from_numpy(middle + distance * away), torch.from_numpy(middle), rng.uniform(-roll, roll)
        ).numpy()
        solution = kinematics.solve(
            torch.from_numpy(pose @ np.linalg.inv(X))[None], torch.from_numpy(START)[None], neighbour=False
        )
        if int(solution.reach[0]) == 0:
            found.append(solution.qpos[0].numpy())
    return found


def recorded(joints: Float64, number: int, noise: float = 3.0) -> RecordedView:
    picture = rendered(np.linalg.inv(flange_pose(joints) @ X) @ Z, number, noise)
    return RecordedView(name=f"view_{number:03d}.png", color=picture, joint_positions=joints, taken=TODAY)


def exact_views(joints: list[Float64], noise_px: float = 0.0, seed: int = 0) -> list[BoardView]:
    """Views without pictures: corners by projection."""
    rng = np.random.default_rng(seed)
    views = []
    for number, q in enumerate(joints):
        points = BOARD.corners @ (chain := np.linalg.inv(flange_pose(q) @ X) @ Z)[:3, :3].T + chain[:3, 3]
        pixels = COLOR.project(points) + rng.normal(0.0, noise_px, (len(points), 2))
        inside = np.all((pixels > 0) & (pixels < [COLOR.width, COLOR.height]), axis=1)
        views.append(
            BoardView(
                name=f"{number}",
                T_base_flange=flange_pose(q),
                corner_ids=np.flatnonzero(inside).astype(np.int64),
                corners_px=pixels[inside],
            )
        )
    return views


@pytest.fixture(scope="module")
def views() -> list[RecordedView]:
    return [recorded(q, k) for k, q in enumerate(postures(15))]


@pytest.fixture(scope="module")
def result(views: list[RecordedView]) -> HandEyeResult:
    return calibrate_hand_eye(BOARD, [board_view(BOARD, v) for v in views], COLOR)


def test_a_known_camera_comes_back_from_rendered_boards_to_a_millimetre_and_a_tenth_of_a_degree(
    result: HandEyeResult,
) -> None:
    distance, angle = difference(result.T_flange_camera, X)
    assert distance < 0.001 and np.degrees(angle) < 0.1
    # What it does reach here, with a margin: a regression would show.
    assert distance < 0.0002 and np.degrees(angle) < 0.03
    distance, angle = difference(result.T_base_board, Z)
    assert distance < 0.0005 and np.degrees(angle) < 0.05
    assert len(result.views) == 15 and result.left_out == ()
    assert result.rms_px < 0.15


def test_its_standard_deviation_is_that_of_many_noisy_calibrations() -> None:
    joints = postures(8, seed=3)
    found = [calibrate_hand_eye(BOARD, exact_views(joints, 0.3, seed), COLOR) for seed in range(24)]
    errors = np.array([r.T_flange_camera[:3, 3] - X[:3, 3] for r in found])
    spread = np.sqrt(np.mean(np.sum(errors**2, axis=1)))
    assert np.mean([r.position_std for r in found]) == pytest.approx(spread, rel=0.3)
    angles = np.array([difference(r.T_flange_camera, X)[1] for r in found])
    assert np.mean([r.rotation_std for r in found]) == pytest.approx(np.sqrt(np.mean(angles**2)), rel=0.3)


def test_views_without_noise_give_the_exact_answer() -> None:
    exact = calibrate_hand_eye(BOARD, exact_views(postures(6, seed=1)), COLOR)
    distance, angle = difference(exact.T_flange_camera, X)
    assert distance < 1e-8 and angle < 1e-8
    assert exact.rms_px < 1e-6


@pytest.mark.skipif(
    not hasattr(cv2, "calibrateHandEye"), reason="this OpenCV hides its own solution from Python"
)
def test_the_closed_form_is_that_of_opencv() -> None:
    from maniskill_tomato.deploy.calibration.hand_eye import _closed_form

    seen = exact_views(postures(8, seed=2), 0.5)
    flanges = np.stack([v.T_base_flange for v in seen])
    boards = np.stack([board_pose(BOARD, v, COLOR) for v in seen])
    ours = _closed_form(flanges, boards)
    rotation, translation = cv2.calibrateHandEye(  # type: ignore[attr-defined]
        flanges[:, :3, :3],
        flanges[:, :3, 3],
        boards[:, :3, :3],
        boards[:, :3, 3],
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    np.testing.assert_allclose(ours[:3, :3], rotation, atol=1e-9)
    np.testing.assert_allclose(ours[:3, 3], translation.ravel(), atol=1e-9)


def test_a_board_that_was_pushed_in_one_view_leaves_that_view_out() -> None:
    joints = postures(10, seed=4)
    seen = exact_views(joints, 0.1)
    pushed = seen[3].T_base_flange.copy()
    pushed[:3, 3] += [0.01, -0.005, 0.0]
    seen[3] = replace(seen[3], T_base_flange=pushed)
    found = calibrate_hand_eye(BOARD, seen, COLOR)
    assert [text.split(":")[0] for text in found.left_out] == ["3"]
    assert difference(found.T_flange_camera, X)[0] < 0.0005


def test_turns_about_one_axis_only_are_refused() -> None:
    seen = exact_views(postures(1))
    # The flange turned about the camera's axis: the board only spins in the picture.
    spun = [
        replace(
            seen[0],
            T_base_flange=seen[0].T_base_flange @ transform(Rotation.from_rotvec([0.0, 0.0, a]), np.zeros(3)),
        )
        for a in np.linspace(-0.5, 0.5, 8)
    ]
    shown = []
    for view in spun:
        chain = np.linalg.inv(view.T_base_flange @ X) @ Z
        pixels = COLOR.project(BOARD.corners @ chain[:3, :3].T + chain[:3, 3])
        shown.append(replace(view, corner_ids=np.arange(len(pixels), dtype=np.int64), corners_px=pixels))
    with pytest.raises(CalibrationError, match="second axis"):
        calibrate_hand_eye(BOARD, shown, COLOR)


def test_too_few_views_or_corners_are_refused_with_their_names() -> None:
    seen = exact_views(postures(6, seed=5))
    with pytest.raises(CalibrationError, match="4 usable views"):
        calibrate_hand_eye(BOARD, seen[:4], COLOR)
    few = [replace(v, corner_ids=v.corner_ids[:5], corners_px=v.corners_px[:5]) for v in seen[:2]]
    with pytest.raises(CalibrationError, match="left out: 0: 5 corners; 1: 5 corners"):
        calibrate_hand_eye(BOARD, [*few, *seen[2:]], COLOR)


def test_an_empty_picture_shows_no_board() -> None:
    ids, pixels = BOARD.find(np.full((480, 640, 3), 128, np.uint8))
    assert len(ids) == 0 and pixels.shape == (0, 2)


def test_corners_are_found_where_they_are_drawn() -> None:
    """The print itself as a picture: corners lie on whole squares, counted from the picture's edge."""
    edge = 40
    paper = cv2.copyMakeBorder(BOARD.picture(edge), 30, 30, 20, 20, cv2.BORDER_CONSTANT, value=(255,))
    ids, pixels = BOARD.find(np.repeat(np.asarray(paper, np.uint8)[..., None], 3, axis=2))
    assert len(ids) == (BOARD.columns - 1) * (BOARD.rows - 1)
    off = pixels - (BOARD.corners[ids, :2] / BOARD.square_length * edge + [20, 30])
    # Corners of pure black and white pixels come out up to 0.2 px off, to both sides; half a pixel would be a mistake.
    assert np.abs(off).max() < 0.25
    assert np.abs(off.mean(axis=0)).max() < 0.1


def test_the_board_is_printed_at_its_true_size(tmp_path: Path) -> None:
    small = CharucoBoard(columns=4, rows=3, dictionary="DICT_4X4_50")
    print_board(tmp_path / "board.png", small)
    page = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_COLOR)
    assert page is not None
    ids, pixels = small.find(np.asarray(page, np.uint8))
    assert len(ids) == 6
    # 254 dots an inch are ten a millimetre.
    np.testing.assert_allclose(pixels, 10_000.0 * (small.corners[ids, :2] + 0.02), atol=1.0)
    print_board(tmp_path / "board.pdf", small)
    # A page 160 mm wide, in points of 1/72 inch.
    assert b"[ 0 0 453.54330" in (tmp_path / "board.pdf").read_bytes()
    with pytest.raises(InvalidInputError, match="pdf"):
        print_board(tmp_path / "board.bmp", small)


def test_a_folder_of_views_comes_back_as_it_was_written(tmp_path: Path, views: list[RecordedView]) -> None:
    write_views(tmp_path, views[:2], COLOR, "123")
    write_views(tmp_path, views[:3], COLOR, "123")
    again, intrinsics, serial = read_views(tmp_path)
    assert serial == "123" and intrinsics == COLOR and len(again) == 3
    assert [view.taken for view in again] == [TODAY] * 3
    for one, other in zip(again, views, strict=False):
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.joint_positions, other.joint_positions)


def broken(change: Callable[[dict[str, Any]], object]) -> Callable[[dict[str, Any]], object]:
    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda i: i.pop("intrinsics"), "intrinsics must have"),
        (lambda i: i["intrinsics"].update(fx=float("nan")), "cannot be read|intrinsics must have"),
        (lambda i: i.update(views={}), "list `views`"),
        (lambda i: i["views"][0].pop("joint_positions"), r"views\[0\].joint_positions"),
        (lambda i: i["views"][1].update(joint_positions=[0.0] * 6), r"views\[1\].joint_positions"),
        (lambda i: i["views"][1].update(joint_positions=[90.0] * 7), "in radians"),
        (lambda i: i["views"][1].update(joint_positions=[None] * 7), r"views\[1\].joint_positions"),
        (lambda i: i["views"][0].update(image="../view_000.png"), "file of this folder"),
        (lambda i: i["views"][0].update(image="views.json"), "cannot be read as an image"),
        (lambda i: i["intrinsics"].update(width=641), "640 x 480"),
        (lambda i: i["views"][1].update(taken="yesterday"), r"views\[1\].taken must be a date such as"),
        (lambda i: i["views"][1].update(taken="2026-11-29T12:00:00"), "it has no time zone"),
        (lambda i: i["views"][1].update(taken=7), r"views\[1\].taken must be a date"),
    ],
)
def test_a_broken_folder_is_told_with_the_key(
    tmp_path: Path, views: list[RecordedView], change: Callable[[dict[str, Any]], object], match: str
) -> None:
    write_views(tmp_path, views[:2], COLOR)
    index = json.loads((tmp_path / "views.json").read_text())
    change(index)
    (tmp_path / "views.json").write_text(json.dumps(index))
    with pytest.raises(CalibrationError, match=match):
        read_views(tmp_path)


def profile_of(file: Path) -> Profile:
    """The profile that names a calibration file."""
    text = f'[arm]\ndriver = "mock"\n[camera]\ndriver = "mock"\n[calibration]\nfile = "{file.name}"\n'
    return parse_profile(text, file.with_name("lab.toml"))


def test_the_profile_reads_what_the_calibration_file_was_given(
    tmp_path: Path, result: HandEyeResult, views: list[RecordedView]
) -> None:
    path = tmp_path / "calibration.json"
    written = write_calibration(path, result, views, COLOR, "0123 4'5")
    profile = profile_of(path)
    np.testing.assert_array_equal(profile.T_flange_camera, result.T_flange_camera)
    facts = profile.calibration
    assert facts == written == read_calibration(path)[1]
    assert facts is not None
    assert (facts.serial, facts.taken, facts.intrinsics, facts.view_count) == ("0123 4'5", TODAY, COLOR, 15)
    assert facts.pictures == tuple(picture_id(view.color) for view in views)
    assert facts.rms_px == result.rms_px and facts.position_std == result.position_std
    # By hand: the board by each view alone.
    chain = [v.T_base_flange @ result.T_flange_camera @ board_pose(BOARD, v, COLOR) for v in result.views]
    apart = [difference(result.T_base_board, board) for board in chain]
    assert facts.board_position_rms == pytest.approx(np.sqrt(np.mean([d**2 for d, _ in apart])))
    assert facts.board_turn_rms == pytest.approx(np.sqrt(np.mean([a**2 for _, a in apart])))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t: t.pop("T_flange_camera"), "calibration.file: .* it has no T_flange_camera"),
        (lambda t: t.update(rms_px=float("nan")), "rms_px must be a finite number"),
        (lambda t: t.update(taken=3), "taken must be a string"),
        (lambda t: t["intrinsics"].update(fx=-1.0), "fx must be a positive number"),
        (lambda t: t["T_flange_camera"][0].__setitem__(0, float("nan")), "must be a 4 x 4 transform"),
        (lambda t: t["T_flange_camera"][0].__setitem__(0, 2.0), "rotation"),
        (lambda t: t["T_flange_camera"][2].__setitem__(3, 47.0), "metres"),
        (lambda t: t["T_flange_camera"].pop(), "must be a 4 x 4 transform"),
    ],
)
def test_a_broken_calibration_file_is_told_with_the_key(
    tmp_path: Path,
    result: HandEyeResult,
    views: list[RecordedView],
    change: Callable[[dict[str, Any]], object],
    match: str,
) -> None:
    path = tmp_path / "calibration.json"
    write_calibration(path, result, views, COLOR)
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    with pytest.raises(ProfileError, match=match):
        profile_of(path)


def test_the_picture_of_the_residuals_is_drawn(tmp_path: Path, result: HandEyeResult) -> None:
    draw_calibration(tmp_path / "calibration.png", result, COLOR)
    picture = cv2.imread(str(tmp_path / "calibration.png"))
    assert picture is not None and picture.shape[1] > 1000
    assert picture.std() > 10.0


def test_the_command_calculates_from_a_folder_and_writes_file_and_picture(
    tmp_path: Path, views: list[RecordedView], capsys: pytest.CaptureFixture[str]
) -> None:
    write_views(tmp_path / "views", views, COLOR, "42")
    out = tmp_path / "out"
    main(["deploy", "calibrate", "--views", str(tmp_path / "views"), "--out", str(out)])
    assert "15 views" in capsys.readouterr().out
    assert json.loads((out / "calibration.json").read_text())["serial"] == "42"
    assert difference(profile_of(out / "calibration.json").T_flange_camera, X)[0] < 0.0002
    assert (out / "calibration.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ([], "either --profile"),
        (["--views", "/nowhere"], "there is no folder /nowhere"),
        (["--views", "."], "no views.json"),
        (["--views", ".", "--square", "30"], "square_length must be"),
        (["--profile", "mock", "--confirm", "--unattended"], "exclude each other"),
    ],
)
def test_the_command_says_in_one_line_what_is_wrong(
    arguments: list[str], match: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["deploy", "calibrate", "--out", str(tmp_path), *arguments])
    assert ended.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("error: ") and match in lines[-1]


@pytest.fixture(scope="module")
def new_views() -> list[RecordedView]:
    """Views that no calibration here is made from."""
    return [recorded(q, 100 + k) for k, q in enumerate(postures(15, seed=21))]


@pytest.fixture(scope="module")
def calibration_file(
    tmp_path_factory: pytest.TempPathFactory, result: HandEyeResult, views: list[RecordedView]
) -> Path:
    path = tmp_path_factory.mktemp("calibration") / "calibration.json"
    write_calibration(path, result, views, COLOR, "42")
    return path


def test_a_good_calibration_passes_on_views_that_it_was_not_made_from(
    calibration_file: Path, new_views: list[RecordedView], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_views(tmp_path / "new", new_views, COLOR, "42")
    command = ["deploy", "calibrate", "--evaluate", str(calibration_file), "--views", str(tmp_path / "new")]
    main([*command, "--out", str(tmp_path / "out")])
    told = capsys.readouterr().out
    assert told.splitlines()[0].startswith("15 new views, 0.0") and told.splitlines()[-1] == "passed"
    found = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert found["passed"] is True and found["problems"] == [] and found["view_count"] == 15
    # The corners by projection with the calibrated camera and the board where it really is: no worse than these.
    pose, _ = read_calibration(calibration_file)
    off = []
    for view in new_views:
        seen = board_view(BOARD, view)
        chain = np.linalg.inv(seen.T_base_flange @ pose) @ Z
        points = BOARD.corners[seen.corner_ids] @ chain[:3, :3].T + chain[:3, 3]
        off.append(COLOR.project(points) - seen.corners_px)
    there = float(np.sqrt(np.mean(np.sum(np.concatenate(off) ** 2, axis=1))))
    assert 0.5 * there < found["rms_px"] <= there < 0.2
    assert 0.0 < found["board_position_rms"] < 0.0003 and 0.0 < found["board_turn_rms"] < np.radians(0.2)
    assert (tmp_path / "out" / "evaluation.png").stat().st_size > 10_000


@pytest.mark.parametrize("kind", ["shifted", "turned", "another file's pose", "identity", "49 cm off"])
def test_a_wrong_calibration_does_not_pass_an_evaluation(
    kind: str,
    calibration_file: Path,
    new_views: list[RecordedView],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rng = np.random.default_rng(1)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    table = json.loads(calibration_file.read_text())
    T = np.array(table["T_flange_camera"])
    table["T_flange_camera"] = {
        "shifted": T @ transform(Rotation.identity(), 0.002 * direction),
        "turned": T @ transform(Rotation.from_rotvec(np.radians(0.5) * direction), np.zeros(3)),
        "another file's pose": d435.T_flange_camera_color_optical,
        "identity": np.eye(4),
        "49 cm off": T @ transform(Rotation.identity(), 0.49 * direction),
    }[kind].tolist()
    wrong = tmp_path / "calibration.json"
    wrong.write_text(json.dumps(table))
    write_views(tmp_path / "new", new_views, COLOR, "42")
    with pytest.raises(SystemExit) as end:
        main(
            ["deploy", "calibrate", "--evaluate", str(wrong), "--views", str(tmp_path / "new")]
            + ["--out", str(tmp_path / "out")]
        )
    captured = capsys.readouterr()
    assert isinstance(end.value, SystemExit)
    if kind == "49 cm off":
        assert end.value.code == 2 and "more than 0.5 m from the flange" in captured.err
        return
    assert end.value.code == 3
    assert "FAIL    rms_px is " in captured.out and "1 px at most is allowed" in captured.out
    assert captured.out.splitlines()[-1] == f"{wrong} does not pass"
    assert json.loads((tmp_path / "out" / "evaluation.json").read_text())["passed"] is False


def test_an_evaluation_does_not_take_the_place_of_the_calibration_that_it_measures(
    calibration_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    named_so = tmp_path / "evaluation.json"
    named_so.write_bytes(calibration_file.read_bytes())
    (tmp_path / "link").symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(SystemExit) as end:
        main(
            ["deploy", "calibrate", "--evaluate", str(tmp_path / "link" / "evaluation.json")]
            + ["--views", str(tmp_path), "--out", str(tmp_path)]
        )
    assert end.value.code == 2 and "choose another --out" in capsys.readouterr().err
    assert named_so.read_bytes() == calibration_file.read_bytes()


def test_views_that_the_calibration_was_made_from_say_nothing_of_it(
    calibration_file: Path, views: list[RecordedView], new_views: list[RecordedView]
) -> None:
    pose, facts = read_calibration(calibration_file)
    # In another file, under another name.
    old = replace(views[3], name="holiday.png")
    with pytest.raises(
        CalibrationError, match=r"1 of 15 views were used for this calibration \(holiday.png\)"
    ):
        evaluate(BOARD, pose, facts, [*new_views[:14], old], COLOR, "42")
    with pytest.raises(CalibrationError, match="does not say from which pictures"):
        evaluate(BOARD, pose, replace(facts, pictures=()), new_views, COLOR, "42")
    with pytest.raises(CalibrationError, match="it is of camera 42, the connected one is 43"):
        evaluate(BOARD, pose, facts, new_views, COLOR, "43")
    with pytest.raises(CalibrationError, match=f"it is of an arm iiwa7, these are of {IIWA14.name}"):
        evaluate(BOARD, pose, replace(facts, arm_model="iiwa7"), new_views, COLOR, "42")
    other = replace(COLOR, fx=COLOR.fx + 4.0)
    with pytest.raises(CalibrationError, match=r"differ by 2\.1 px at a corner"):
        evaluate(BOARD, pose, facts, new_views, other, "42")
    with pytest.raises(CalibrationError, match="4 usable views, 5 are needed"):
        evaluate(BOARD, pose, facts, new_views[:4], COLOR, "42")


def test_one_view_that_does_not_agree_stays_in_an_evaluation(
    calibration_file: Path, new_views: list[RecordedView]
) -> None:
    pose, facts = read_calibration(calibration_file)
    pushed = replace(new_views[0], joint_positions=new_views[0].joint_positions + 0.02)
    found = evaluate(BOARD, pose, facts, [pushed, *new_views[1:]], COLOR, "42")
    assert len(found.agreement.views) == 15 and found.problems


def test_a_calibration_that_a_real_arm_would_refuse_is_written_and_said_to_be_refused(
    tmp_path: Path, views: list[RecordedView], capsys: pytest.CaptureFixture[str]
) -> None:
    undated = [replace(view, taken="") for view in views[:7]]
    write_views(tmp_path / "views", undated, COLOR, "42")
    with pytest.raises(SystemExit) as end:
        main(["deploy", "calibrate", "--views", str(tmp_path / "views"), "--out", str(tmp_path / "out")])
    assert end.value.code == 3
    told = capsys.readouterr().out.splitlines()
    assert told[-1] == "a real arm would not move by it"
    assert [line.split(",")[0] for line in told[-3:-1]] == [
        "FAIL    it tells of 7 views",
        "FAIL    it has no date with a time zone when its views were taken",
    ]
    assert (tmp_path / "out" / "calibration.json").exists()


def test_boards_that_cannot_be_are_refused() -> None:
    cases: list[dict[str, Any]] = [
        {"columns": 2},
        {"square_length": 30.0},
        {"marker_length": 0.03},
        {"dictionary": "DICT_9X9"},
        {"columns": 12, "rows": 12, "dictionary": "DICT_4X4_50"},
    ]
    for wrong in cases:
        with pytest.raises(InvalidInputError):
            CharucoBoard(**wrong)


class StillArm(Arm):
    """An arm that stands where it was sent as soon as that is asked."""

    name = "still"
    model = IIWA14

    def __init__(self, clock: Clock) -> None:
        self.joints, self.clock = START, clock
        self.moves: list[JointMove] = []

    @property
    def is_connected(self) -> bool:
        return True

    def connect(self) -> None:
        pass

    def disconnect(self) -> None:
        pass

    def read(self, max_age_s: float = 0.5) -> ArmState:
        return ArmState(joint_positions=self.joints, joint_velocities=np.zeros(7), stamp=self.clock.now())

    def command(self, move: JointMove) -> JointMove:
        self.clock.sleep(self.move_seconds(move.joint_positions - self.joints, move.speed_fraction))
        self.joints = move.joint_positions
        self.moves.append(move)
        return move

    def wait(self, timeout_s: float) -> bool:
        return True

    def stop(self) -> bool:
        return True


class BoardCamera(Camera):
    """A camera on that arm before the board."""

    name = "board"

    def __init__(self, arm: StillArm) -> None:
        self.arm, self.number = arm, 0

    @property
    def is_connected(self) -> bool:
        return True

    def connect(self) -> None:
        pass

    def disconnect(self) -> None:
        pass

    @property
    def serial(self) -> str:
        return "B7"

    @property
    def intrinsics(self) -> CameraIntrinsics:
        return COLOR

    def read(self, max_age_s: float = 0.5, after: float | None = None) -> Frame:
        self.number += 1
        self.arm.clock.sleep(0.03)
        color = rendered(np.linalg.inv(flange_pose(self.arm.joints) @ X) @ Z, self.number)
        depth = np.zeros(color.shape[:2], np.float32)
        return Frame(
            color=color, depth=depth, intrinsics=COLOR, stamp=self.arm.clock.now(), number=self.number
        )


def test_the_arm_goes_round_the_board_through_the_guard_and_the_operator(tmp_path: Path) -> None:
    clock = SimulatedClock()
    arm = StillArm(clock)
    camera = BoardCamera(arm)
    asked: list[str] = []

    def confirm(question: str) -> bool:
        asked.append(question)
        return len(asked) % 3 != 0

    guarded = GuardedArm(arm, Safety(SafetyConfig()), clock)
    taken = capture_views(guarded, camera, BOARD, tmp_path, clock, confirm, CapturePlan(views=8), serial="7")
    assert len(taken) >= 7
    assert len(arm.moves) == len(asked) - len(asked) // 3
    folder, intrinsics, serial = read_views(tmp_path)
    assert len(folder) == len(taken) and serial == "7"
    found = calibrate_hand_eye(BOARD, [board_view(BOARD, v) for v in folder], intrinsics)
    distance, angle = difference(found.T_flange_camera, X)
    assert distance < 0.001 and np.degrees(angle) < 0.1


def test_nothing_moves_when_the_operator_says_no_or_the_board_is_not_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimulatedClock()
    arm = StillArm(clock)
    guarded = GuardedArm(arm, Safety(SafetyConfig()), clock)
    taken = capture_views(guarded, BoardCamera(arm), BOARD, tmp_path, clock, lambda question: False)
    assert len(taken) == 1 and arm.moves == []
    other = CharucoBoard(dictionary="DICT_4X4_50")
    with pytest.raises(CalibrationError, match="not in the picture"):
        capture_views(guarded, BoardCamera(arm), other, tmp_path, clock, lambda question: True)
    assert arm.moves == []


def test_a_stop_ends_the_taking_of_views_and_keeps_those_taken(tmp_path: Path) -> None:
    clock = SimulatedClock()
    arm = StillArm(clock)
    guarded = GuardedArm(arm, Safety(SafetyConfig()), clock)
    folder, file = tmp_path / "views", tmp_path / "STOP"

    def confirm(question: str) -> bool:
        if len(arm.moves) == 2:
            file.touch()
        return True

    with pytest.raises(
        StoppedError, match=r"stop file .*STOP\) after 3 views; the arm stands and holds its position"
    ):
        capture_views(guarded, BoardCamera(arm), BOARD, folder, clock, confirm, stops=Stops(stop_file=file))
    assert len(arm.moves) == 2, "the stop outweighs the yes"
    assert len(read_views(folder)[0]) == 3
    # While the arm moves, too: it never arrives here.
    moving = StillArm(clock)
    stops = Stops()

    def wait(timeout_s: float) -> bool:
        stops.request("SIGTERM")
        return False

    moving.wait = wait  # type: ignore[method-assign]
    guarded = GuardedArm(moving, Safety(SafetyConfig()), clock)
    with pytest.raises(StoppedError, match="SIGTERM"):
        capture_views(guarded, BoardCamera(moving), BOARD, tmp_path / "b", clock, lambda q: True, stops=stops)
    assert len(moving.moves) == 1


def test_an_arm_that_moves_on_after_a_stop_is_not_said_to_stand_while_views_are_taken(tmp_path: Path) -> None:
    clock, stops = SimulatedClock(), Stops()

    class Rolling(StillArm):
        def read(self, max_age_s: float = 0.5) -> ArmState:
            return replace(super().read(), joint_velocities=np.full(7, 0.2 if self.moves else 0.0))

        def wait(self, timeout_s: float) -> bool:
            stops.request("SIGTERM")
            return False

    arm = Rolling(clock)
    guarded = GuardedArm(arm, Safety(SafetyConfig()), clock)
    with pytest.raises(
        StoppedError, match=r"after 1 views; the arm was told to stop and still moves at 0\.200 rad/s"
    ):
        capture_views(guarded, BoardCamera(arm), BOARD, tmp_path, clock, lambda q: True, stops=stops)


DRIVERS = """
from maniskill_tomato.deploy.interface import Arm, Camera


def make_arm(options, context):
    return context.shared("arm", lambda: HERE.StillArm(context.clock))


def make_camera(options, context):
    return HERE.BoardCamera(make_arm(options, context))
"""


@pytest.fixture
def board_profile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A profile whose drivers come from another package, by their entry points: the arm and the camera above."""
    package = tmp_path / "site"
    (package / "board_lab-1.dist-info").mkdir(parents=True)
    (package / "board_lab-1.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: board-lab\nVersion: 1\n"
    )
    (package / "board_lab-1.dist-info" / "entry_points.txt").write_text(
        "[maniskill_tomato.drivers]\narm.still = board_lab:make_arm\ncamera.board = board_lab:make_camera\n"
    )
    (package / "board_lab.py").write_text(DRIVERS)
    monkeypatch.syspath_prepend(package)
    module = importlib.import_module("board_lab")
    monkeypatch.setattr(module, "HERE", sys.modules[__name__], raising=False)
    profile = tmp_path / "board.toml"
    profile.write_text(
        '[arm]\ndriver = "still"\n[camera]\ndriver = "board"\n[safety]\nspeed_fraction = 0.3\n'
    )
    return profile


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_the_prompt_ends_the_taking_of_views_and_names_those_that_stay(
    number: signal.Signals,
    tmp_path: Path,
    board_profile: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    master, slave = pty.openpty()
    monkeypatch.setattr(sys, "stdin", os.fdopen(slave))
    asked = threading.Semaphore(0)

    def ask() -> bool:
        asked.release()
        return goes()

    def operate() -> None:
        """Says yes once, and then presses Ctrl-C or ends the process."""
        assert asked.acquire(timeout=60)
        os.write(master, b"y\n")
        assert asked.acquire(timeout=60)
        time.sleep(0.2)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(calibrate_command, "goes", ask)
    operator = threading.Thread(target=operate, daemon=True)
    operator.start()
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as end:
        main(["deploy", "calibrate", "--profile", str(board_profile), "--confirm", "--out", str(out)])
    operator.join()
    os.close(master)
    assert end.value.code == 128 + number
    told = capsys.readouterr().out.splitlines()
    assert told[-2].endswith(f"stopped ({number.name}) after 2 views; the arm stands and holds its position")
    kept = "view_000.png, view_001.png"
    assert told[-1] == f"kept    {out / 'views'}: {kept}; --views {out / 'views'} calculates from them"
    again, _, serial = read_views(out / "views")
    assert [view.name for view in again] == kept.split(", ") and serial == "B7"
    assert all(view.taken for view in again)


def test_capture_poses_look_at_the_middle_of_the_board_from_its_front() -> None:
    plan = CapturePlan(views=10)
    poses = camera_poses(BOARD, Z, flange_pose(START) @ X, plan)
    middle = (Z @ np.array([BOARD.size[0] / 2, BOARD.size[1] / 2, 0.0, 1.0]))[:3]
    to_middle = middle - poses[:, :3, 3]
    distances = np.linalg.norm(to_middle, axis=1)
    assert distances.min() >= plan.distances[0] - 1e-9 and distances.max() <= plan.distances[1] + 1e-9
    np.testing.assert_allclose(poses[:, :3, 2], to_middle / distances[:, None], atol=1e-9)
    # The board's z goes into the print, away from whoever looks at it.
    tilts = np.arccos(poses[:, :3, 2] @ Z[:3, 2])
    assert tilts.max() <= plan.largest_tilt + 1e-9 and tilts.max() > 0.8 * plan.largest_tilt
