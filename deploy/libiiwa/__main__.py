"""`python -m maniskill_tomato.deploy.libiiwa`: a robot without an arm, to rehearse with.

Example:
    python -m maniskill_tomato.deploy.libiiwa --port 12225 --fault contact@102#3
"""

import math
from dataclasses import dataclass
from typing import Annotated, Final

import tyro

from maniskill_tomato.deploy.libiiwa.loopback import LoopbackRobot
from maniskill_tomato.deploy.loopback_faults import Fault
from maniskill_tomato.deploy.rehearsal_command import run_rehearsal

TRIES_FOR_S: Final = 3600.0
"""It tries to connect for so long, in [s]."""

MOVE_CODE: Final = 102
"""Requests with this code are for a move, taken or not."""


@dataclass(frozen=True, kw_only=True)
class Rehearse:
    """Connects like the LibIiwa application, again and again, until Ctrl-C."""

    host: str = "127.0.0.1"
    """Address of the PC."""
    port: int = 12225
    """Port at which the PC listens."""
    joints: tuple[float, float, float, float, float, float, float] = (0.0, -50.0, 0.0, -97.5, 0.0, 42.4, 0.0)
    """Joint angles at the start, in degrees."""
    double_precision: bool = False
    """Whether numbers have 8 bytes instead of 4."""
    speedup: float = 1.0
    """How much faster than a real arm it moves."""
    media_flange: float = 0.0
    """How much farther out the flange lies than the plain one, in metres."""
    fault: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What goes wrong: KIND, KIND@CODE or KIND@CODE#COUNT; again for more."""

    def run(self) -> None:
        """Connects."""
        faults = [Fault.parse(text) for text in self.fault]
        joints = [math.radians(q) for q in self.joints]
        while True:
            print(f"connecting to {self.host}:{self.port}", flush=True)
            with LoopbackRobot(
                host=self.host,
                port=self.port,
                qpos=joints,
                double_precision=self.double_precision,
                speedup=self.speedup,
                media_flange_m=self.media_flange,
                tries_for_s=TRIES_FOR_S,
                faults=faults,
            ) as robot:
                robot.wait()
            # NaN, which a code may be, is near to nothing.
            moves = sum(abs(request[0] - MOVE_CODE) < 0.5 for request in robot.received)
            told = f"ended after {len(robot.received)} requests, {moves} of them for a move"
            print(f"{told}: {robot.ended_because}", flush=True)
            joints = robot.arm.qpos.tolist()


def main() -> None:
    """Runs the command; errors made on purpose end with one line and exit status 2."""
    run_rehearsal(Rehearse, "libiiwa")


if __name__ == "__main__":
    main()
