"""A real arm moves only by a calibration that is good, young, possible, and of the camera that is connected."""

import json
import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from maniskill_tomato.cli import main
from maniskill_tomato.deploy import workcell as workcell_module
from maniskill_tomato.deploy.calibration.calibration_file import Calibration
from maniskill_tomato.deploy.calibration.calibration_limits import (
    CEILINGS,
    LEAST_VIEWS,
    OLD_DAYS,
    OLDEST_DAYS,
    age_warning,
    camera_problems,
    file_problems,
)
from maniskill_tomato.deploy.check import check
from maniskill_tomato.deploy.deploy_errors import ProfileError, RefusedError
from maniskill_tomato.deploy.drivers import make_camera
from maniskill_tomato.deploy.interface import Camera, Float64, Frame, JointMove
from maniskill_tomato.deploy.policy_run import RunConfig, run
from maniskill_tomato.deploy.profile import Profile, load_profile
from maniskill_tomato.deploy.rigid import transform
from maniskill_tomato.deploy.sunrise.loopback import LoopbackController
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.robot import d435
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import IIWA14, READY_QPOS

NOW = datetime(2026, 11, 29, 12, 0, tzinfo=UTC)
COLOR = d435.color_intrinsics(640, 480, "measured")
DRAWING = d435.T_flange_camera_color_optical
GOOD = Calibration(
    serial="0123",
    arm_model=IIWA14.name,
    taken=(NOW - timedelta(days=3)).isoformat(),
    intrinsics=COLOR,
    view_count=15,
    rms_px=0.4,
    board_position_rms=0.0007,
    board_turn_rms=math.radians(0.3),
    position_std=0.0002,
    rotation_std=math.radians(0.1),
    pictures=("a", "b"),
)


def moved(mm: float = 0.0, degrees: float = 0.0) -> Float64:
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    return DRAWING @ transform(Rotation.from_rotvec(np.radians(degrees) * direction), 1e-3 * mm * direction)


def days(count: float) -> str:
    return (NOW - timedelta(days=count)).isoformat()


def problems(change: dict[str, Any] | None = None, pose: Float64 = DRAWING) -> list[str]:
    return [*file_problems(pose, replace(GOOD, **(change or {})), DRAWING, IIWA14.name, NOW)]


def test_a_good_calibration_has_no_problems_and_neither_has_one_at_each_limit() -> None:
    assert problems() == []
    assert problems({c.key: c.most for c in CEILINGS}) == []
    assert problems({"view_count": LEAST_VIEWS, "taken": days(OLDEST_DAYS)}) == []
    assert problems(pose=moved(39.9, 14.9)) == []
    # The clocks of two computers.
    assert problems({"taken": (NOW + timedelta(minutes=4)).isoformat()}) == []
    # Another time zone is the same moment.
    assert problems({"taken": "2026-11-29T14:02:00+02:00"}) == []
    assert [*camera_problems(GOOD, "0123", COLOR)] == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rms_px": 500.0}, "rms_px is 500 px, 1 px at most is allowed"),
        ({"rms_px": 1.01}, "rms_px is 1.01 px, 1 px at most"),
        ({"rms_px": -1.0}, "rms_px is -1 px, 1 px at most"),
        ({"rms_px": math.nan}, "rms_px is nan px, 1 px at most"),
        ({"rms_px": None}, "does not say rms_px, which may be 1 px at most"),
        ({"board_position_rms": 0.0071}, "board_position_rms is 7.1 mm, 3 mm at most"),
        ({"board_turn_rms": math.radians(2.0)}, "board_turn_rms is 2 deg, 1.5 deg at most"),
        ({"position_std": 0.004}, "position_std is 4 mm, 1 mm at most"),
        ({"rotation_std": math.inf}, "rotation_std is inf deg, 0.5 deg at most"),
        ({"arm_model": "iiwa7"}, "it is of an arm iiwa7, this one is iiwa14"),
        ({"arm_model": ""}, "it is of an arm without a name"),
        ({"view_count": 9}, "it tells of 9 views, 10 are needed"),
        ({"view_count": None}, "it tells of no number of views"),
        ({"taken": days(OLDEST_DAYS + 1)}, "its views are 181 days old, 180 at most are allowed"),
        (
            {"taken": (NOW + timedelta(hours=1)).isoformat()},
            "2026-11-29T13:00:00+00:00, which is in the future",
        ),
        ({"taken": "9999-12-31T23:59:59+00:00"}, "which is in the future"),
        ({"taken": "0001-01-01T00:00:00+14:00"}, "no date with a time zone"),
        ({"taken": None}, "no date with a time zone when its views were taken, got None"),
        ({"taken": "2026-11-29T12:00:00"}, "no date with a time zone"),
        ({"taken": "last week"}, "got 'last week'"),
    ],
)
def test_each_bad_number_of_a_file_is_refused_with_value_limit_and_what_to_do(
    change: dict[str, Any], words: str
) -> None:
    found = problems(change)
    assert len(found) == 1 and words in found[0]
    assert "maniskill-tomato deploy calibrate" in found[0]


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (np.eye(4), "T_flange_camera is the identity"),
        (moved(mm=490.0), "it puts the camera 490 mm from where the mount's drawing has it, 40 mm at most"),
        (moved(mm=41.0), "it puts the camera 41 mm from"),
        (moved(degrees=16.0), "it turns the camera by 16 deg from the mount's drawing, 15 deg at most"),
        (moved(degrees=180.0), "it turns the camera by 180 deg"),
    ],
)
def test_a_camera_that_cannot_sit_there_is_refused(pose: Float64, words: str) -> None:
    found = problems(pose=pose)
    assert len(found) == 1 and words in found[0]


def test_all_that_is_wrong_is_told_at_once() -> None:
    assert len(problems({"rms_px": 9.0, "view_count": 5, "taken": None}, moved(50.0, 20.0))) == 5


@pytest.mark.parametrize(
    ("serial", "intrinsics", "words"),
    [
        ("9999", COLOR, "it is of camera 0123, the connected one is 9999"),
        ("", COLOR, "it is of camera 0123, the connected one is without a number"),
        (
            "0123",
            d435.color_intrinsics(1280, 720, "measured"),
            "its pictures are 640 x 480 px, those of the camera 1280",
        ),
        (
            "0123",
            replace(COLOR, fx=COLOR.fx + 3.0),
            "differ by 1.6 px at a corner of the picture, 1 px at most",
        ),
        ("0123", replace(COLOR, cy=COLOR.cy + 1.1), "differ by 1.1 px at a corner"),
    ],
)
def test_the_calibration_of_another_camera_or_of_other_pictures_is_refused(
    serial: str, intrinsics: CameraIntrinsics, words: str
) -> None:
    found = [*camera_problems(GOOD, serial, intrinsics)]
    assert len(found) == 1 and words in found[0]


def test_a_calibration_that_names_no_camera_is_that_of_none() -> None:
    nameless = replace(GOOD, serial="", intrinsics=None)
    for serial in ("", "0123"):
        found = [*camera_problems(nameless, serial, COLOR)]
        assert [text.split(";")[0].split(" of which")[0] for text in found] == [
            "it does not say",
            "it does not say the intrinsics of its pictures",
        ]


def test_an_old_calibration_is_warned_of_before_it_is_refused() -> None:
    def told(count: float) -> str | None:
        return age_warning(replace(GOOD, taken=days(count)), NOW)

    assert told(OLD_DAYS) is None and told(OLDEST_DAYS + 1) is None
    warning = told(OLD_DAYS + 1)
    assert warning is not None and "31 days old; after 180 it is refused" in warning


# ---------------------------------------------------------------------------------------------- the doors of a real arm


class NumberedCamera(Camera):
    """A camera with a number that looks at a grey wall."""

    name = "numbered"

    def __init__(self, clock: Any, serial: str) -> None:
        self._clock, self._serial, self.connected, self.reads = clock, serial, False, 0

    @property
    def is_connected(self) -> bool:
        return self.connected

    def connect(self) -> None:
        self.connected = True

    def disconnect(self) -> None:
        self.connected = False

    @property
    def serial(self) -> str:
        return self._serial if self.connected else ""

    @property
    def intrinsics(self) -> CameraIntrinsics:
        return COLOR

    def read(self, max_age_s: float = 0.5, after: float | None = None) -> Frame:
        self._clock.sleep(0.01)
        self.reads += 1
        color = np.full((480, 640, 3), 128, np.uint8)
        depth = np.full((480, 640), 0.6, np.float32)
        return Frame(color=color, depth=depth, intrinsics=COLOR, stamp=self._clock.now(), number=self.reads)


def written(path: Path, change: Callable[[dict[str, Any]], object] = lambda table: None) -> Path:
    """A calibration file of today that is good but for one change."""
    table = {
        "T_flange_camera": moved(5.0, 1.0).tolist(),
        **asdict(replace(GOOD, taken=datetime.now(UTC).isoformat())),
    }
    change(table)
    path.write_text(json.dumps(table))
    return path


@pytest.fixture
def controller() -> Iterator[LoopbackController]:
    with LoopbackController(qpos=READY_QPOS.tolist(), speedup=50.0, media_flange_m=0.0) as running:
        yield running


Lab = Callable[..., Profile]


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    """The profile of a real arm and a camera with a number."""

    def make(name: str, options: Any, context: Any) -> Camera:
        if name == "numbered":
            return NumberedCamera(context.clock, options["serial"])
        return make_camera(name, options, context)

    monkeypatch.setattr(workcell_module, "make_camera", make)

    def profile(
        change: Callable[[dict[str, Any]], object] = lambda table: None,
        serial: str = "0123",
        at: tuple[str, int] = ("127.0.0.1", 9),
    ) -> Profile:
        """With a calibration file that is good but for one change, and a controller at an address."""
        file = written(tmp_path / "calibration.json", change)
        path = tmp_path / "lab.toml"
        path.write_text(
            f'[arm]\ndriver = "sunrise"\nhost = "{at[0]}"\nport = {at[1]}\n[camera]\ndriver = "numbered"\n'
            f'serial = "{serial}"\n[calibration]\nfile = "{file.name}"\n[perception]\n'
            'segmenter = "ground_truth"\n[safety]\nmax_state_age = 2.0\n'
        )
        return load_profile(str(path))

    return profile


def cleared(key: str, value: Any) -> Callable[[dict[str, Any]], object]:
    return lambda table: table.update({key: value})


BAD: list[tuple[str, Callable[[dict[str, Any]], object], str]] = [
    ("500 px", cleared("rms_px", 500.0), "rms_px is 500 px, 1 px at most"),
    ("no date", cleared("taken", None), "no date with a time zone"),
    ("old", cleared("taken", "2020-01-01T00:00:00+00:00"), "days old, 180 at most"),
    ("future", cleared("taken", "2999-01-01T00:00:00+00:00"), "in the future"),
    ("few", cleared("view_count", 5), "it tells of 5 views"),
    ("identity", cleared("T_flange_camera", np.eye(4).tolist()), "is the identity"),
    ("49 cm", cleared("T_flange_camera", moved(440.0).tolist()), "puts the camera 440 mm"),
    ("earlier version", lambda table: [table.pop(c.key) for c in CEILINGS], "does not say rms_px"),
]


def moves_of(controller: LoopbackController) -> list[str]:
    return [line for line in controller.received if line.startswith(("doPTP", "jp_"))]


@pytest.mark.parametrize(("kind", "change", "words"), BAD, ids=[kind for kind, _, _ in BAD])
def test_a_real_arm_with_a_bad_calibration_is_refused_at_the_start_and_by_the_guard(
    kind: str, change: Callable[[dict[str, Any]], object], words: str, lab: Lab
) -> None:
    workcell = make_workcell(lab(change))
    with pytest.raises(ProfileError, match="the calibration is refused") as told:
        workcell.check_calibration()
    assert words in str(told.value)
    with pytest.raises(RefusedError) as refused:
        workcell.guarded_arm.command(JointMove(joint_positions=READY_QPOS, speed_fraction=0.1))
    assert words in str(refused.value)


def test_a_run_with_a_bad_calibration_ends_before_anything_connects(lab: Lab, tmp_path: Path) -> None:
    profile = lab(cleared("rms_px", 500.0))
    with pytest.raises(ProfileError, match="the calibration is refused: rms_px is 500 px"):
        run(RunConfig(profile=profile, out=tmp_path / "out", policy="nbv", mode="unattended"))


def test_a_run_with_the_calibration_of_another_camera_ends_before_its_first_look(
    lab: Lab, controller: LoopbackController, tmp_path: Path
) -> None:
    profile = lab(serial="77", at=controller.address)
    with pytest.raises(ProfileError, match="refused: it is of camera 0123, the connected one is 77"):
        run(RunConfig(profile=profile, out=tmp_path / "out", policy="nbv", mode="unattended"))
    assert moves_of(controller) == []


def test_the_guard_asks_for_the_camera_before_every_move(lab: Lab, controller: LoopbackController) -> None:
    workcell = make_workcell(lab(at=controller.address))
    guard = workcell.guarded_arm
    with workcell.arm:
        move = JointMove(joint_positions=guard.read().joint_positions + 0.02, speed_fraction=0.1)
        with pytest.raises(RefusedError, match="the camera is not connected"):
            guard.command(move)
        with workcell.camera:
            guard.command(move)
            while not guard.wait(0.2):
                pass
            assert len(moves_of(controller)) > 0
            sent = len(moves_of(controller))
            # Another one is plugged in.
            camera: Any = workcell.camera
            camera._serial = "78"
            back = JointMove(joint_positions=move.joint_positions - 0.02, speed_fraction=0.1)
            with pytest.raises(RefusedError, match="it is of camera 0123, the connected one is 78"):
                guard.command(back)
        assert len(moves_of(controller)) == sent


def test_check_tells_all_that_speaks_against_a_calibration_and_moves_nothing(
    lab: Lab, controller: LoopbackController
) -> None:
    def change(table: dict[str, Any]) -> None:
        table.update(rms_px=500.0, view_count=5)

    found = [
        f for f in check(lab(change, "77", controller.address), "nbv", 0, None) if f.what == "calibration"
    ]
    assert found[0].good and "measured on 2" in found[0].detail and "rms_px 500" in found[0].detail
    assert [f.good for f in found[1:]] == [False] * 3
    for finding, words in zip(
        found[1:], ("rms_px is 500 px", "5 views", "it is of camera 0123"), strict=True
    ):
        assert words in finding.detail
    assert moves_of(controller) == []


def test_a_dry_run_says_what_a_real_one_would_be_refused_for(
    lab: Lab,
    controller: LoopbackController,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING):
        run(
            RunConfig(
                profile=lab(cleared("rms_px", 500.0), at=controller.address),
                out=tmp_path / "out",
                policy="nbv",
                mode="dry_run",
            )
        )
    assert "only a dry run: rms_px is 500 px" in caplog.text
    assert moves_of(controller) == []


def test_an_old_calibration_is_told_at_the_start(lab: Lab, caplog: pytest.LogCaptureFixture) -> None:
    old = (datetime.now(UTC) - timedelta(days=40, hours=1)).isoformat()
    with caplog.at_level(logging.WARNING):
        workcell = make_workcell(lab(cleared("taken", old)))
    assert "the calibration is 40 days old; after 180 it is refused" in caplog.text
    assert workcell.calibration_problems() == []


def test_a_drawing_moves_no_real_arm_and_a_bracket_of_ones_own_is_what_the_file_is_compared_with(
    lab: Lab, tmp_path: Path
) -> None:
    lab(cleared("T_flange_camera", moved(100.0, 40.0).tolist()))
    path = tmp_path / "lab.toml"
    named = path.read_text()
    assert len(make_workcell(load_profile(str(path))).calibration_problems()) == 2
    drawing = f"T_flange_camera = {moved(95.0, 38.0).tolist()}"
    path.write_text(named.replace('file = "calibration.json"', f'file = "calibration.json"\n{drawing}'))
    profile = load_profile(str(path))
    np.testing.assert_allclose(profile.T_flange_camera, moved(100.0, 40.0))
    assert make_workcell(profile).calibration_problems() == []
    path.write_text(named.replace('file = "calibration.json"', drawing))
    (problem,) = make_workcell(load_profile(str(path))).calibration_problems()
    assert "not calibrated" in problem


def test_a_camera_is_not_calibrated_with_an_impossible_one_in_the_profile(
    lab: Lab,
    controller: LoopbackController,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The guard would take the camera to be there; a bad or old calibration is no hindrance to a new one."""
    lab(cleared("T_flange_camera", moved(440.0).tolist()), at=controller.address)
    command = ["deploy", "calibrate", "--profile", str(tmp_path / "lab.toml"), "--unattended"]
    with pytest.raises(SystemExit) as end:
        main([*command, "--out", str(tmp_path / "out")])
    assert end.value.code == 2 and "puts the camera 440 mm" in capsys.readouterr().err
    assert controller.received == []
    lab(cleared("rms_px", 500.0), at=controller.address)
    with pytest.raises(SystemExit):
        main([*command, "--out", str(tmp_path / "out")])
    assert "the board is not in the picture" in capsys.readouterr().err


def test_the_twin_asks_for_none_of_it(tmp_path: Path) -> None:
    file = written(tmp_path / "calibration.json", cleared("rms_px", 500.0))
    path = tmp_path / "twin.toml"
    path.write_text(
        f'[arm]\ndriver = "mock"\n[camera]\ndriver = "mock"\n[calibration]\nfile = "{file.name}"\n'
        '[perception]\nsegmenter = "ground_truth"\n'
    )
    workcell = make_workcell(load_profile(str(path)))
    assert workcell.simulated and workcell.calibration_problems() == []


def test_the_table_of_the_documentation_is_what_is_checked() -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "hardware.md").read_text(encoding="utf-8")
    for ceiling in CEILINGS:
        row = f"| `{ceiling.key}` | {ceiling.scale * ceiling.most:g} {ceiling.unit} | {ceiling.reason} |"
        assert row in text, row
