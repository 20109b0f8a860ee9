"""`maniskill-tomato deploy`: the policy on an arm and a camera, or on their digital twin."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from maniskill_tomato.cli.calibrate_command import end_by_signal
from maniskill_tomato.cli.early_checks import check_file, check_policy, check_profile
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.layout import GENERAL_IDS

if TYPE_CHECKING:
    from maniskill_tomato.deploy.run_records import Proposal

FAULT_STATUS = 3
"""Exit status of a run that a fault ended."""


@dataclass(frozen=True, kw_only=True)
class DeployRun:
    """Look at a tomato with the devices of a profile until it is fully visible.

    On hardware nothing moves unless --confirm or --unattended is given. Ctrl-C, SIGTERM, the key q with Enter, and the
    file STOP in the output folder end a run; only the smartPAD or the emergency stop halts a move of the iiwa that is
    under way. Exit status: 0 finished, 2 could not begin, 3 a fault ended it, 130 or 143 stopped by a signal.
    """

    profile: str = "mock"
    """Name of a profile (see `deploy profiles`), or a TOML file."""
    policy: str | None = None
    """A planner's name, or the file of a policy (.pt, .onnx); by default the one that ships."""
    seed: int = 0
    """On the twin: which of the fixed episodes."""
    out: Path = Path("runs/deploy")
    """Folder of result.json, report.png and run.mcap."""
    confirm: bool = False
    """Ask before every move."""
    unattended: bool = False
    """Move without asking; the default on the twin only."""
    dry_run: bool = False
    """Show the first move and end; the default on hardware."""
    record: bool = True
    """Write run.mcap."""

    def run(self) -> None:
        """Runs, and says how it ended."""
        check_profile("--profile", self.profile)
        _check_policy(self.policy)
        if self.confirm + self.unattended + self.dry_run > 1:
            raise InvalidInputError("give one of --confirm, --unattended and --dry-run, not several")
        if self.confirm and not sys.stdin.isatty():
            raise InvalidInputError("--confirm asks before every move and needs a terminal")

        from maniskill_tomato.deploy.policy_run import RunConfig, run
        from maniskill_tomato.deploy.profile import load_profile
        from maniskill_tomato.deploy.run_records import Mode

        modes: list[Mode] = []
        if self.confirm:
            modes.append("confirm")
        if self.unattended:
            modes.append("unattended")
        if self.dry_run:
            modes.append("dry_run")
        config = RunConfig(
            profile=load_profile(self.profile),
            out=self.out,
            policy=self.policy,
            seed=self.seed,
            mode=modes[0] if modes else None,
            record=self.record,
        )
        result = run(config, confirm=_ask, keyboard=not self.confirm)
        print(
            f"{result.reason}: {result.detail}; {result.moves} moves, V_f {result.visible_fraction:.2f}, "
            f"{result.seconds:.1f} s; {result.end_state}"
        )
        print(f"result  {self.out / 'result.json'}")
        print(f"report  {self.out / 'report.png'}")
        if result.is_fault:
            print(f"error: {result.detail}", file=sys.stderr)
            raise SystemExit(FAULT_STATUS)
        if result.reason == "stopped":
            end_by_signal(result.detail)


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


def _check_policy(policy: str | None) -> None:
    if policy is not None:
        check_policy("--policy", policy, GENERAL_IDS[0], on_robot=True)


def _ask(proposal: "Proposal") -> bool:
    """Shows a move and waits for a yes."""
    turns = ", ".join(f"{v * 57.29578:+.1f}" for v in proposal.turn)
    print(
        f"move {proposal.number + 1}: V_f is {proposal.visible_fraction:.2f}; the camera goes "
        f"{proposal.camera_step:.3f} m, the joints turn by ({turns}) deg"
    )
    try:
        return input("go? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False
