"""`maniskill-tomato deploy calibrate`: where the camera sits on the flange, and how good a calibration is."""

import math
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

from maniskill_tomato.cli.early_checks import check_counts, check_file, check_folder, check_profile
from maniskill_tomato.cli.operator_prompt import FAULT_STATUS, end_by_signal, goes, one_mode, stopped_early
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.folder_lock import only_writer

if TYPE_CHECKING:
    from maniskill_tomato.deploy.calibration.board import CharucoBoard
    from maniskill_tomato.deploy.calibration.view_folder import RecordedView
    from maniskill_tomato.robot.d435 import CameraIntrinsics

EVALUATION: Final = "evaluation.json"
"""What an evaluation writes into its folder."""

EVALUATION_TURN: Final = 1.2
"""So far the pattern of views is turned for an evaluation, in [rad], that it looks from other places."""


@dataclass(frozen=True, kw_only=True)
class DeployCalibrate:
    """Measure where the camera sits on the flange, with a printed ChArUco board that stands still.

    Print the board (--print-board board.pdf), measure a square, fix the board in front of the arm, bring the camera
    to about 0.35 m from it, and start with --profile FILE --confirm: the arm goes round the board and takes pictures.
    Without --confirm or --unattended nothing moves: it takes one picture and shows the first move. --views FOLDER
    calculates from pictures taken before. --evaluate calibration.json measures a calibration instead, on views that it
    was not made from. Ctrl-C, SIGTERM, the key q with Enter and the file STOP in the output folder stop it; the
    pictures taken so far stay. Exit status: 0 done, 2 could not begin, 3 a fault ended it, a real arm would not move by
    this calibration, or it did not pass, 130 or 143 stopped by a signal.
    """

    profile: str | None = None
    """A TOML file with the arm and the camera."""
    views: Path | None = None
    """A folder with views.json and the pictures that it names, instead of devices."""
    evaluate: Path | None = None
    """Measure this calibration file, on new views from --profile or --views."""
    out: Path = Path("runs/calibration")
    """Folder of calibration.json, calibration.png and views/; with --evaluate of evaluation.json, evaluation.png and
    evaluation_views/."""
    count: int = 15
    """Pictures to take."""
    confirm: bool = False
    """Ask before every move."""
    unattended: bool = False
    """Move without asking."""
    columns: int = 8
    """Squares of the board side by side."""
    rows: int = 6
    """Squares one above the other."""
    square: float = 0.030
    """Edge of a square as measured on the print, in metres."""
    marker: float = 0.022
    """Edge of a marker, in metres."""
    dictionary: str = "DICT_5X5_100"
    """Set of markers."""
    print_board: Path | None = None
    """Write the board as .pdf or .png, to be printed at 100 %, and end."""

    def run(self) -> None:
        """Takes or reads the views, calculates or measures, and says where the file is."""
        self._check()

        from maniskill_tomato.deploy.calibration.picture import print_board
        from maniskill_tomato.deploy.calibration.view_folder import read_views

        board = self._board()
        if self.print_board is not None:
            print_board(self.print_board, board)
            print(f"board   {self.print_board}: print it at 100 % and measure a square")
            return
        folder = self.views or self.out / ("views" if self.evaluate is None else "evaluation_views")
        with only_writer(self.out, "calibrates"):
            if self.profile is not None and not self._take(self.profile, folder):
                return
            views, intrinsics, serial = read_views(folder)
            if self.evaluate is None:
                self._calculate(board, views, intrinsics, serial)
            else:
                self._measure(self.evaluate, board, views, intrinsics, serial)

    def _calculate(
        self,
        board: "CharucoBoard",
        views: "Sequence[RecordedView]",
        intrinsics: "CameraIntrinsics",
        serial: str,
    ) -> None:
        from maniskill_tomato.deploy.calibration.calibration_file import write_calibration
        from maniskill_tomato.deploy.calibration.calibration_limits import file_problems
        from maniskill_tomato.deploy.calibration.hand_eye import calibrate_hand_eye
        from maniskill_tomato.deploy.calibration.picture import draw_calibration
        from maniskill_tomato.deploy.calibration.view_folder import board_view
        from maniskill_tomato.deploy.profile import load_profile
        from maniskill_tomato.robot.d435 import T_flange_camera_color_optical

        result = calibrate_hand_eye(board, [board_view(board, view) for view in views], intrinsics)
        file, picture = self.out / "calibration.json", self.out / "calibration.png"
        calibration = write_calibration(file, result, views, intrinsics, serial)
        draw_calibration(picture, result, intrinsics)
        for text in result.left_out:
            print(f"left out {text}")
        print(
            f"{len(result.views)} views, {result.rms_px:.2f} px off, camera known to "
            f"{1000 * result.position_std:.2f} mm and {math.degrees(result.rotation_std):.3f} deg (standard deviation)"
        )
        print(f"picture {picture}")
        print(f"file    {file}: name it in the profile's [calibration] as file = ...")
        drawing = (
            T_flange_camera_color_optical if self.profile is None else load_profile(self.profile).T_drawing
        )
        _end_with(
            [*file_problems(result.T_flange_camera, calibration, drawing, calibration.arm_model)],
            "a real arm would not move by it",
        )

    def _measure(
        self,
        file: Path,
        board: "CharucoBoard",
        views: "Sequence[RecordedView]",
        intrinsics: "CameraIntrinsics",
        serial: str,
    ) -> None:
        from maniskill_tomato.deploy.calibration.calibration_file import read_calibration
        from maniskill_tomato.deploy.calibration.evaluation import evaluate, write_evaluation
        from maniskill_tomato.deploy.calibration.picture import draw_calibration

        pose, calibration = read_calibration(file)
        found = evaluate(board, pose, calibration, views, intrinsics, serial)
        write_evaluation(self.out / EVALUATION, file, found)
        draw_calibration(self.out / "evaluation.png", found.agreement, intrinsics)
        for text in found.agreement.left_out:
            print(f"left out {text}")
        print(
            f"{len(found.agreement.views)} new views, {found.agreement.rms_px:.2f} px off; the board by one view alone "
            f"lies {1000 * found.agreement.board_position_rms:.2f} mm and "
            f"{math.degrees(found.agreement.board_turn_rms):.3f} deg from that by all"
        )
        print(f"numbers {self.out / EVALUATION}")
        print(f"picture {self.out / 'evaluation.png'}")
        _end_with(found.problems, f"{file} does not pass")
        print("passed")

    def _check(self) -> None:
        """Accepts options that fit together, and files that are there."""
        check_counts(count=self.count, columns=self.columns, rows=self.rows)
        if self.print_board is not None:
            return
        if (self.profile is None) == (self.views is None):
            raise InvalidInputError("give either --profile (takes pictures) or --views (a folder of them)")
        check_file("--evaluate", self.evaluate)
        if self.evaluate is not None and self.evaluate.resolve() == (self.out / EVALUATION).resolve():
            raise InvalidInputError(
                f"--evaluate {self.evaluate} would be replaced by what is measured; choose another --out"
            )
        check_folder("--views", self.views)
        if self.profile is not None:
            check_profile("--profile", self.profile)
        one_mode(confirm=self.confirm, unattended=self.unattended)

    def _board(self) -> "CharucoBoard":
        from maniskill_tomato.deploy.calibration.board import CharucoBoard

        return CharucoBoard(
            columns=self.columns,
            rows=self.rows,
            square_length=self.square,
            marker_length=self.marker,
            dictionary=self.dictionary,
        )

    def _take(self, name: str, folder: Path) -> bool:
        """Takes pictures with the devices of a profile; whether there are enough to calculate."""
        from maniskill_tomato.deploy.calibration.hand_eye import MIN_VIEWS, CalibrationError
        from maniskill_tomato.deploy.calibration.view_capture import CapturePlan, capture_views
        from maniskill_tomato.deploy.deploy_errors import DeployError, StoppedError
        from maniskill_tomato.deploy.profile import load_profile
        from maniskill_tomato.deploy.rest import come_to_rest
        from maniskill_tomato.deploy.workcell import make_workcell

        moves = self.confirm or self.unattended
        if moves and (folder / "views.json").exists():
            raise InvalidInputError(
                f"{folder} holds views already; calculate from them with --views, or choose another --out"
            )
        profile = load_profile(name)
        workcell = make_workcell(profile, calibrates=True)
        workcell.check_calibration()
        plan = CapturePlan(views=self.count, turn=0.0 if self.evaluate is None else EVALUATION_TURN)
        stops = workcell.listen(self.out, keyboard=not self.confirm)
        with ExitStack() as stack:
            if not moves:
                folder = Path(stack.enter_context(TemporaryDirectory()))
            # The first to be entered is the last to be left: no signal ends the program before the devices are let go.
            stack.enter_context(stops)
            with stopped_early(), stops.interrupting():
                stack.enter_context(workcell.arm)
                camera = stack.enter_context(workcell.camera)
            try:
                taken = capture_views(
                    workcell.guarded_arm,
                    camera,
                    self._board(),
                    folder,
                    workcell.clock,
                    _Operator(asks=self.confirm, moves=self.unattended),
                    plan,
                    profile.T_flange_camera,
                    camera.serial,
                    stops,
                )
            except StoppedError as error:
                print(str(error))
                if moves:
                    _tell_kept(folder)
                end_by_signal(stops.reason)
                return False
            except DeployError as error:
                if isinstance(error, CalibrationError):
                    raise
                print(f"error: {error}; {come_to_rest(workcell.guarded_arm)}", file=sys.stderr)
                if moves:
                    _tell_kept(folder)
                raise SystemExit(FAULT_STATUS) from error
            finally:
                stops.rest()
        if not moves:
            print("dry run: the board is in the picture; nothing moved; --confirm asks before every move")
            return False
        if len(taken) < MIN_VIEWS:
            print(f"{len(taken)} views in {folder}; {MIN_VIEWS} are needed to calculate")
            return False
        return True


class _Operator:
    """Answers for the operator, or asks; a dry run shows the first move only."""

    def __init__(self, asks: bool, moves: bool) -> None:
        self._asks, self._moves, self._shown = asks, moves, False

    def __call__(self, question: str) -> bool:
        if self._asks or self._moves or not self._shown:
            print(question)
        self._shown = True
        return goes() if self._asks else self._moves


def _tell_kept(folder: Path) -> None:
    """Names the views that a capture took before it was stopped."""
    from maniskill_tomato.deploy.calibration.view_folder import INDEX_NAME, read_views

    if (folder / INDEX_NAME).exists():
        names = [view.name for view in read_views(folder)[0]]
        print(f"kept    {folder}: {', '.join(names)}; --views {folder} calculates from them")


def _end_with(problems: "Sequence[str]", what: str) -> None:
    """Tells what is wrong, and ends with the exit status of a fault if something is."""
    for problem in problems:
        print(f"FAIL    {problem}")
    if problems:
        print(what)
        raise SystemExit(FAULT_STATUS)
