"""Measures how long a stop of a real run takes to halt the arm of the driver `libiiwa`, over the loopback robot.

    .venv/bin/python scripts/stop_latency.py --runs 20

Every run is the whole loop over a real socket in real time: the arm is stopped in the middle of its first move. The
times are those from the request on: until the robot has the stop, and until its arm stands. The loopback brakes with
the acceleration that the driver has set; how a real arm brakes is for the lab to measure. Episodes whose first move is
over before the stop are left out.
"""

import os
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
import tyro

from maniskill_tomato.deploy.decision import TASK
from maniskill_tomato.deploy.libiiwa.loopback import LoopbackRobot
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.mock.episode import load_episode
from maniskill_tomato.deploy.mock.rehearsal import rehearsal
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.warp_runtime import load_kernels

HEARTBEAT_S: Final = 1.0
WAYS: Final = ("SIGTERM", "SIGINT", "STOP file", "heartbeat")


@dataclass(frozen=True, kw_only=True)
class StopLatency:
    """Prints a table: milliseconds until the stop arrives and until the arm stands, and how far a joint turns."""

    runs: int = 20
    """Of each way to stop."""

    def run(self) -> None:
        """Measures."""
        load_kernels()
        print(
            "| stopped by | arrives [ms]: median, largest | stands [ms]: median, largest | largest turn [deg] |"
        )
        print("|---|---|---|---|")
        for way in WAYS:
            measured = (found for seed in range(100) if (found := _stopped(way, seed)) is not None)
            arrives, stands, turns = np.array(list(islice(measured, self.runs))).T
            times = [f"{np.median(t):.0f}, {t.max():.0f}" for t in (arrives, stands)]
            print(f"| {way} | {times[0]} | {times[1]} | {turns.max():.2f} |", flush=True)


def _stopped(way: str, seed: int) -> tuple[float, float, float] | None:
    """One run: both times, in [ms], and how far a joint still turned, in degrees; None if the move was over before."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    start = load_episode("held_out", seed).start_joints
    options = {"controller": "127.0.0.1", "host": "127.0.0.1", "port": port}
    asked: list[tuple[float, np.ndarray]] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        LoopbackRobot(port=port, qpos=start.tolist(), tries_for_s=60.0) as robot,
    ):
        stop_file = Path(folder) / "STOP"
        workcell = rehearsal("libiiwa", options, lambda: robot.arm.qpos, seed, 3)
        stops = Stops(
            stop_file=stop_file, heartbeat_s=HEARTBEAT_S, on_lost_heartbeat=workcell.guarded_arm.stop
        )

        def ask() -> None:
            asked.append((time.monotonic(), robot.arm.qpos))
            if way == "STOP file":
                stop_file.touch()
            elif way != "heartbeat":
                os.kill(os.getpid(), signal.Signals[way])

        rng = np.random.default_rng(seed)
        stood: list[float] = []
        if way == "heartbeat":
            # The loop hangs at its first look at the move; the heartbeat is lost so long after its last beat.
            wait = workcell.guarded_arm.wait

            def hang(timeout_s: float) -> bool:
                if not asked:
                    stops.beat()
                    time.sleep(HEARTBEAT_S)
                    ask()
                    time.sleep(1.0)
                return wait(timeout_s)

            workcell.guarded_arm.wait = hang  # type: ignore[method-assign]
        watch = threading.Thread(
            target=_watch, args=(robot, ask, way, float(rng.uniform(0.1, 0.3)), asked, stood)
        )
        with workcell.arm, workcell.camera, stops:
            watch.start()
            Loop(workcell, open_policy("nbv", env_id=TASK), stops, "unattended").run()
            watch.join()
    when, where = asked[0]
    if robot.stopped_at is None:
        return None
    turn = float(np.rad2deg(np.abs(robot.arm.qpos - where).max()))
    return 1e3 * (robot.stopped_at - when), 1e3 * (stood[0] - when), turn


def _watch(
    robot: LoopbackRobot,
    ask: Callable[[], None],
    way: str,
    after_s: float,
    asked: list[tuple[float, np.ndarray]],
    stood: list[float],
) -> None:
    """Asks for the stop in the middle of the first move, and notes when the arm stands."""
    while not robot.arm.moves:
        time.sleep(0.001)
    if way != "heartbeat":
        time.sleep(after_s)
        ask()
    while robot.arm.moves:
        time.sleep(0.0005)
    stood.append(time.monotonic())


if __name__ == "__main__":
    tyro.cli(StopLatency).run()
