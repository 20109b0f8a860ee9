"""`maniskill-tomato deploy`: the policy on an arm and a camera, or on their digital twin."""

import contextlib
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from maniskill_tomato.cli.early_checks import (
    check_counts,
    check_file,
    check_policy,
    check_profile,
)
from maniskill_tomato.cli.operator_prompt import FAULT_STATUS, end_by_signal, goes, one_mode, stopped_early
from maniskill_tomato.cli.shared_options import say
from maniskill_tomato.task_registry import GENERAL_IDS
from maniskill_tomato.view.page_address import check_port

if TYPE_CHECKING:
    from maniskill_tomato.deploy.policy_run import RunConfig
    from maniskill_tomato.deploy.run_records import Proposal, Recorder, RunResult


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
    view: bool = False
    """Show every look in a browser while the run goes on; afterwards `play --record` opens the recording."""
    view_port: int = 8080
    """Port of that page, which is for this machine alone; 0 takes a free one."""

    def _check_view(self) -> None:
        """Accepts a port at which nobody listens, before anything slow is imported."""
        if self.view:
            check_port("127.0.0.1", self.view_port)

    @contextlib.contextmanager
    def _watched(self, config: "RunConfig") -> Iterator[Sequence["Recorder"]]:
        """The page, if one is wanted, as a recorder of the run."""
        if not self.view:
            yield ()
            return

        from maniskill_tomato.view.live_run import LiveView

        with LiveView(config.profile, self.view_port) as live:
            say(f"page    {live.url}")
            yield (live,)

    def _config(self, out: Path) -> "RunConfig":
        """What to run, checked as far as that goes without a device."""
        check_profile("--profile", self.profile)
        _check_policy(self.policy)
        mode = one_mode(confirm=self.confirm, unattended=self.unattended, dry_run=self.dry_run)

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
    """Folder of result.json, report.html, report.png and run.mcap."""

    def run(self) -> None:
        """Runs, and says how it ended."""
        self._check_view()
        config = self._config(self.out)

        from maniskill_tomato.deploy.policy_run import run

        with self._watched(config) as watching, stopped_early():
            result = run(config, confirm=_ask, keyboard=not self.confirm, recorders=watching)
        print(
            f"{result.reason}: {result.detail}; {result.moves} moves, V_f {result.visible_fraction:.2f}, "
            f"{result.seconds:.1f} s; {result.end_state}"
        )
        if not result.report_error:
            print(f"result  {self.out / 'result.json'}")
            print(f"report  {self.out / 'report.html'}")
        _tell_fault(result, self.out)
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
        self._check_view()
        config = self._config(self.out)

        from maniskill_tomato.deploy.inspection_run import inspect_row

        with self._watched(config) as watching, stopped_early():
            done = inspect_row(
                config, self.max_moves, confirm=_ask, keyboard=not self.confirm, recorders=watching
            )
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
        _tell_fault(result, self.out)
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
    """Run a recording through today's code, and say where it decides otherwise (exit status 1).

    Of a run that a fault ended it first tells what was known then: the arm's last readings, the move under way, what
    was refused, and where in the code it was noticed.
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """The run.mcap of a run, or its fault.mcap."""
    policy: str | None = None
    """Another policy than the recorded one."""

    def run(self) -> None:
        """Compares."""
        check_file("RECORDING", self.recording)
        _check_policy(self.policy)

        from maniskill_tomato.deploy.fault_state import explained
        from maniskill_tomato.deploy.run_replay import each_difference, load_recording, replay

        recorded = load_recording(self.recording)
        if recorded.is_cut_off:
            print(f"the recording is cut off; its first {len(recorded.steps)} looks are whole")
        if recorded.fault is not None:
            for line in explained(recorded.fault, recorded.profile.name):
                print(line)
            if not recorded.steps:
                print("no look was taken; there is nothing to replay")
                return
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


def _tell_fault(result: "RunResult", out: Path) -> None:
    if result.fault_file:
        print(f"fault   {out / result.fault_file}: `maniskill-tomato deploy replay` shows what was known")


def _end(result: "RunResult") -> None:
    """Ends with the exit status of a fault or a signal, if one ended the run."""
    if result.is_fault:
        print(f"error: {result.detail}", file=sys.stderr)
        if result.report_error not in ("", result.detail):
            print(f"error: {result.report_error}", file=sys.stderr)
        raise SystemExit(FAULT_STATUS)
    if result.reason == "stopped":
        end_by_signal(result.detail)


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
    return goes()
