"""`maniskill-tomato deploy`: the policy on an arm and a camera, or on their digital twin."""

import math
import signal
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, cast

import tyro

from maniskill_tomato.cli.early_checks import (
    check_counts,
    check_file,
    check_folder,
    check_policy,
    check_profile,
)
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.layout import GENERAL_IDS

if TYPE_CHECKING:
    from maniskill_tomato.deploy.policy_run import RunConfig
    from maniskill_tomato.deploy.run_records import Mode, Proposal, RunResult

FAULT_STATUS = 3
"""Exit status of a run that a fault ended."""


@dataclass(frozen=True, kw_only=True)
class _Moving:
    """What the commands that move an arm have in common."""

    profile: str = "mock"
    """Name of a profile (see `deploy profiles`), or a TOML file."""
    policy: str | None = None
    """A planner's name, or the file of a policy (.pt, .onnx); by default the one that ships."""
    seed: int = 0
    """On the twin: which of the fixed episodes."""
    confirm: bool = False
    """Ask before every move."""
    unattended: bool = False
    """Move without asking; the default on the twin only."""
    dry_run: bool = False
    """Show the first move and end; the default on hardware."""
    record: bool = True
    """Write run.mcap."""

    def _config(self, out: Path) -> "RunConfig":
        """What to run, checked as far as that goes without a device."""
        check_profile("--profile", self.profile)
        _check_policy(self.policy)
        mode = _one_mode(confirm=self.confirm, unattended=self.unattended, dry_run=self.dry_run)

        from maniskill_tomato.deploy.policy_run import RunConfig
        from maniskill_tomato.deploy.profile import load_profile

        return RunConfig(
            profile=load_profile(self.profile),
            out=out,
            policy=self.policy,
            seed=self.seed,
            mode=mode,
            record=self.record,
        )


@dataclass(frozen=True, kw_only=True)
class DeployRun(_Moving):
    """Look at a tomato with the devices of a profile until it is fully visible.

    On hardware nothing moves unless --confirm or --unattended is given. Ctrl-C, SIGTERM, the key q with Enter, and the
    file STOP in the output folder end a run; only the smartPAD or the emergency stop halts a move of the iiwa that is
    under way. Exit status: 0 finished, 2 could not begin, 3 a fault ended it, 130 or 143 stopped by a signal.
    """

    out: Path = Path("runs/deploy")
    """Folder of result.json, report.png and run.mcap."""

    def run(self) -> None:
        """Runs, and says how it ended."""
        config = self._config(self.out)

        from maniskill_tomato.deploy.policy_run import run

        result = run(config, confirm=_ask, keyboard=not self.confirm)
        print(
            f"{result.reason}: {result.detail}; {result.moves} moves, V_f {result.visible_fraction:.2f}, "
            f"{result.seconds:.1f} s; {result.end_state}"
        )
        if not result.report_error:
            print(f"result  {self.out / 'result.json'}")
            print(f"report  {self.out / 'report.png'}")
        _end(result)


@dataclass(frozen=True, kw_only=True)
class DeployInspect(_Moving):
    """Inspect a row with the devices of a profile: find every ripe tomato and look at it until it is fully visible.

    The camera alone finds the fruits; the profile's [target] is not used. Ends when nothing is worth another move.
    On hardware nothing moves unless --confirm or --unattended is given. Ways to stop and exit status as for
    `deploy run`; a run that was stopped still writes the list so far.
    """

    out: Path = Path("runs/inspect")
    """Folder of inspection.json, fruits/, report.png, report.html and run.mcap."""
    max_moves: int = 120
    """The most moves for the row; the profile's loop.max_moves says how many for a fruit."""

    def run(self) -> None:
        """Inspects, and says what was found."""
        check_counts(max_moves=self.max_moves)
        config = self._config(self.out)

        from maniskill_tomato.deploy.inspection_run import inspect_row

        done = inspect_row(config, self.max_moves, confirm=_ask, keyboard=not self.confirm)
        result, ripe = done.run, [fruit for fruit in done.fruits if fruit["ripeness"] == "ripe"]
        full = sum(fruit["fully_seen"] for fruit in ripe)
        print(
            f"{result.reason}: {result.detail}; {len(ripe)} ripe fruits, {full} fully seen, {result.moves} moves, "
            f"{result.seconds:.1f} s; {result.end_state}"
        )
        if done.totals:
            t = done.totals
            print(
                f"truth   {t['true_fully_seen']} of {t['true_ripe_in_reach']} ripe fruits in reach fully seen, "
                f"precision {t['true_precision']}, place {t['true_position_error_median_m']} m off in the median"
            )
        if not result.report_error:
            print(f"list    {self.out / 'inspection.json'}")
            print(f"report  {self.out / 'report.html'}")
        _end(result)


@dataclass(frozen=True, kw_only=True)
class DeployCheck:
    """Look at profile, devices, limits, calibration, policy and one picture; nothing moves."""

    profile: str = "mock"
    """Name of a profile, or a TOML file."""
    policy: str | None = None
    """As for `deploy run`."""
    seed: int = 0
    """As for `deploy run`."""
    out: Path | None = None
    """Folder for the picture; by default none is kept."""

    def run(self) -> None:
        """Prints the findings."""
        check_profile("--profile", self.profile)
        _check_policy(self.policy)

        from maniskill_tomato.deploy.check import check, print_findings
        from maniskill_tomato.deploy.profile import load_profile

        if not print_findings(check(load_profile(self.profile), self.policy, self.seed, self.out)):
            raise SystemExit(FAULT_STATUS)


@dataclass(frozen=True, kw_only=True)
class DeployReplay:
    """Run a recording through today's code, and say where it decides otherwise (exit status 1)."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """The run.mcap of a run."""
    policy: str | None = None
    """Another policy than the recorded one."""

    def run(self) -> None:
        """Compares."""
        check_file("RECORDING", self.recording)
        _check_policy(self.policy)

        from maniskill_tomato.deploy.run_replay import each_difference, load_recording, replay

        recorded = load_recording(self.recording)
        if recorded.is_cut_off:
            print(f"the recording is cut off; its first {len(recorded.steps)} looks are whole")
        found = replay(recorded, self.policy)
        for line in each_difference(found):
            print(line)
        if found.differences:
            print(f"{len(found.differences)} differences in {found.steps} looks")
            raise SystemExit(1)
        print(f"the same in all {found.steps} looks")


@dataclass(frozen=True, kw_only=True)
class DeployProfiles:
    """List the profiles of the package, or print one to begin your own with."""

    show: str | None = None
    """Print this one."""

    def run(self) -> None:
        """Prints."""
        if self.show is not None:
            check_profile("--show", self.show)

        from maniskill_tomato.deploy.profile import load_profile
        from maniskill_tomato.deploy.profile_files import profile_names

        if self.show is not None:
            print(load_profile(self.show).text, end="")
            return
        for name in profile_names():
            print(f"{name:<16}{load_profile(name).description}")


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
            f"{1000 * result.position_std:.2f} mm and {math.degrees(result.rotation_std):.3f} deg (standard deviation)"
        )
        print(f"picture {picture}")
        print(f"file    {file}: name it in the profile's [calibration] as file = ...")

    def _check(self) -> None:
        """Accepts options that fit together, and files that are there."""
        check_counts(count=self.count, columns=self.columns, rows=self.rows)
        if self.print_board is not None:
            return
        if (self.profile is None) == (self.views is None):
            raise InvalidInputError("give either --profile (takes pictures) or --views (a folder of them)")
        check_folder("--views", self.views)
        if self.profile is not None:
            check_profile("--profile", self.profile)
        _one_mode(confirm=self.confirm, unattended=self.unattended)

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
        workcell = make_workcell(profile, calibrates=True)
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
                    _Operator(asks=self.confirm, moves=self.unattended),
                    plan,
                    profile.T_flange_camera,
                    str(camera.describe().get("serial", "")),
                    stops,
                )
            except StoppedError as error:
                print(str(error))
                _end_by_signal(stops.reason)
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

    def __init__(self, asks: bool, moves: bool) -> None:
        self._asks, self._moves, self._shown = asks, moves, False

    def __call__(self, question: str) -> bool:
        if self._asks or self._moves or not self._shown:
            print(question)
        self._shown = True
        return _goes() if self._asks else self._moves


def _end(result: "RunResult") -> None:
    """Ends with the exit status of a fault or a signal, if one ended the run."""
    if result.is_fault:
        print(f"error: {result.detail}", file=sys.stderr)
        if result.report_error not in ("", result.detail):
            print(f"error: {result.report_error}", file=sys.stderr)
        raise SystemExit(FAULT_STATUS)
    if result.reason == "stopped":
        _end_by_signal(result.detail)


def _check_policy(policy: str | None) -> None:
    if policy is not None:
        check_policy("--policy", policy, GENERAL_IDS[0], on_robot=True)


def _ask(proposal: "Proposal") -> bool:
    """Shows a move and waits for a yes."""
    turns = ", ".join(f"{math.degrees(v):+.1f}" for v in proposal.turn)
    print(
        f"move {proposal.number + 1}: V_f is {proposal.visible_fraction:.2f}; the camera goes "
        f"{proposal.camera_step:.3f} m, the joints turn by ({turns}) deg"
    )
    return _goes()


if TYPE_CHECKING:
    from maniskill_tomato.deploy.calibration.board import CharucoBoard


def _one_mode(**asked: bool) -> "Mode | None":
    """The one flag that was given, or none."""
    given = [name for name, wanted in asked.items() if wanted]
    if len(given) > 1:
        flags = " and ".join(f"--{name.replace('_', '-')}" for name in given)
        raise InvalidInputError(f"{flags} exclude each other; give one")
    if "confirm" in given and not sys.stdin.isatty():
        raise InvalidInputError("--confirm asks before every move and needs a terminal")
    return cast("Mode", given[0]) if given else None


def _goes() -> bool:
    """Waits for a yes or a no; without a terminal it is a no."""
    try:
        return input("go? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def _end_by_signal(reason: str | None) -> None:
    """Ends with the exit status of a signal if that is what stopped a run; `reason` is its name."""
    if reason is not None and reason in signal.Signals.__members__:
        raise SystemExit(128 + signal.Signals[reason])
