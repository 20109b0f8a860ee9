"""`maniskill-tomato deploy calibrate`: where the camera sits on the flange."""

import signal
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from maniskill_tomato.cli.early_checks import check_count, check_folder, check_profile
from maniskill_tomato.errors import InvalidInputError

if TYPE_CHECKING:
    from maniskill_tomato.deploy.calibration.board import CharucoBoard


def end_by_signal(reason: str | None) -> None:
    """Ends with the exit status of a signal if that is what stopped a run; `reason` is its name."""
    if reason is not None and reason in signal.Signals.__members__:
        raise SystemExit(128 + signal.Signals[reason])


@dataclass(frozen=True, kw_only=True)
class DeployCalibrate:
    """Measure where the camera sits on the flange, with a printed ChArUco board that stands still.

    Print the board (--print-board board.pdf), measure a square, fix the board in front of the arm, bring the camera
    to about 0.35 m from it, and start with --profile FILE --confirm: the arm goes round the board and takes pictures.
    Without --confirm or --unattended nothing moves: it takes one picture and shows the first move. --views FOLDER
    calculates from pictures taken before. Ctrl-C, SIGTERM, the key q with Enter and the file STOP in the output folder
    stop it; the pictures taken so far stay.
    """

    profile: str | None = None
    """A TOML file with the arm and the camera."""
    views: Path | None = None
    """A folder with views.json and the pictures that it names, instead of devices."""
    out: Path = Path("runs/calibration")
    """Folder of calibration.json, calibration.png and views/."""
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
        """Takes or reads the views, calculates, and says where the file is."""
        self._check()

        from maniskill_tomato.deploy.calibration.hand_eye import calibrate_hand_eye, write_calibration
        from maniskill_tomato.deploy.calibration.picture import draw_calibration, print_board
        from maniskill_tomato.deploy.calibration.view_folder import board_view, read_views

        board = self._board()
        if self.print_board is not None:
            print_board(self.print_board, board)
            print(f"board   {self.print_board}: print it at 100 % and measure a square")
            return
        folder = self.views or self.out / "views"
        if self.profile is not None and not self._take(self.profile, folder):
            return
        recorded, intrinsics, serial = read_views(folder)
        result = calibrate_hand_eye(board, [board_view(board, view) for view in recorded], intrinsics)
        file, picture = self.out / "calibration.json", self.out / "calibration.png"
        write_calibration(file, result, intrinsics, serial)
        draw_calibration(picture, result, intrinsics)
        for text in result.left_out:
            print(f"left out {text}")
        print(
            f"{len(result.views)} views, {result.rms_px:.2f} px off, camera known to "
            f"{1000 * result.position_std:.2f} mm and {57.29578 * result.rotation_std:.3f} deg (standard deviation)"
        )
        print(f"picture {picture}")
        print(f"file    {file}: name it in the profile's [calibration] as file = ...")

    def _check(self) -> None:
        """Accepts options that fit together, and files that are there."""
        for flag, value in (("--count", self.count), ("--columns", self.columns), ("--rows", self.rows)):
            check_count(flag, value)
        if self.print_board is not None:
            return
        if (self.profile is None) == (self.views is None):
            raise InvalidInputError("give either --profile (takes pictures) or --views (a folder of them)")
        check_folder("--views", self.views)
        if self.profile is not None:
            check_profile("--profile", self.profile)
        if self.confirm and self.unattended:
            raise InvalidInputError("give --confirm or --unattended, not both")
        if self.confirm and not sys.stdin.isatty():
            raise InvalidInputError("--confirm asks before every move and needs a terminal")

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
        from maniskill_tomato.deploy.calibration.hand_eye import MIN_VIEWS
        from maniskill_tomato.deploy.calibration.view_capture import CapturePlan, capture_views
        from maniskill_tomato.deploy.deploy_errors import StoppedError
        from maniskill_tomato.deploy.profile import load_profile
        from maniskill_tomato.deploy.workcell import make_workcell

        moves = self.confirm or self.unattended
        if moves and (folder / "views.json").exists():
            raise InvalidInputError(
                f"{folder} holds views already; calculate from them with --views, or choose another --out"
            )
        profile = load_profile(name)
        workcell = make_workcell(profile)
        plan = CapturePlan(views=self.count)
        stops = workcell.listen(self.out, keyboard=not self.confirm)
        with ExitStack() as stack:
            if not moves:
                folder = Path(stack.enter_context(TemporaryDirectory()))
            stack.enter_context(workcell.arm)
            camera = stack.enter_context(workcell.camera)
            stack.enter_context(stops)
            try:
                taken = capture_views(
                    workcell.guarded_arm,
                    camera,
                    self._board(),
                    folder,
                    workcell.clock,
                    _Operator(asks=self.confirm, goes=self.unattended),
                    plan,
                    profile.T_flange_camera,
                    str(camera.describe().get("serial", "")),
                    stops,
                )
            except StoppedError as error:
                print(str(error))
                end_by_signal(stops.reason)
                return False
        if not moves:
            print("dry run: the board is in the picture; nothing moved; --confirm asks before every move")
            return False
        if len(taken) < MIN_VIEWS:
            print(f"{len(taken)} views in {folder}; {MIN_VIEWS} are needed to calculate")
            return False
        return True


class _Operator:
    """Answers for the operator, or asks; a dry run shows the first move only."""

    def __init__(self, asks: bool, goes: bool) -> None:
        self._asks, self._goes, self._shown = asks, goes, False

    def __call__(self, question: str) -> bool:
        if self._asks or self._goes or not self._shown:
            print(question)
        self._shown = True
        if not self._asks:
            return self._goes
        try:
            return input("go? [y/N] ").strip().lower() in ("y", "yes")
        except EOFError:
            return False
