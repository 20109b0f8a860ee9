"""`python -m maniskill_tomato.deploy.sunrise`: a controller without an arm, to rehearse with.

Example:
    python -m maniskill_tomato.deploy.sunrise --port 30001 --fault nak@doPTP#3
"""

import math
from dataclasses import dataclass
from typing import Annotated

import tyro

from maniskill_tomato.deploy.loopback_faults import Fault
from maniskill_tomato.deploy.rehearsal_command import run_rehearsal
from maniskill_tomato.deploy.sunrise.loopback import LoopbackController


@dataclass(frozen=True, kw_only=True)
class Rehearse:
    """Answers like the Sunrise Toolbox server, for one client after the other, until Ctrl-C."""

    host: str = "127.0.0.1"
    """Address to listen at."""
    port: int = 30001
    """Port to listen at."""
    joints: tuple[float, float, float, float, float, float, float] = (0.0, -50.0, 0.0, -97.5, 0.0, 42.4, 0.0)
    """Joint angles at the start, in degrees."""
    speedup: float = 1.0
    """How much faster than a real arm it moves."""
    media_flange: float = 0.0
    """How much farther out the flange lies than the plain one, in metres."""
    fault: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What goes wrong: KIND, KIND@COMMAND or KIND@COMMAND#COUNT; again for more."""

    def run(self) -> None:
        """Serves."""
        faults = [Fault.parse(text) for text in self.fault]
        joints = [math.radians(q) for q in self.joints]
        while True:
            with LoopbackController(
                host=self.host,
                port=self.port,
                qpos=joints,
                speedup=self.speedup,
                media_flange_m=self.media_flange,
                faults=faults,
            ) as controller:
                print(f"waiting for a client at {controller.address[0]}:{controller.address[1]}", flush=True)
                controller.wait()
            joints = controller.arm.qpos


def main() -> None:
    """Runs the command; errors made on purpose end with one line and exit status 2."""
    run_rehearsal(Rehearse, "sunrise")


if __name__ == "__main__":
    main()
