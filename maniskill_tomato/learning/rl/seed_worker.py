"""One seed's training in a process of its own: a description on standard input, progress as JSON lines on standard
output.

The process that started it keeps its standard input open; when that closes, this one stops as for SIGTERM.
"""

import contextlib
import dataclasses
import json
import logging
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.learning.rl.progress import Progress
from maniskill_tomato.learning.rl.run import train


def main() -> None:
    """Trains and ends with status 0, or with 2 after an error that was told in words."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    channel = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    # Whatever else prints goes to the log, so that it cannot mix with the messages.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    spec: dict[str, Any] = json.loads(_read_line())
    threading.Thread(target=_stop_with_parent, daemon=True).start()

    def send(kind: str, values: dict[str, Any]) -> None:
        with contextlib.suppress(BrokenPipeError):  # The closed standard input stops the run.
            channel.write(json.dumps({"kind": kind, **values}) + "\n")

    def report(progress: Progress) -> None:
        send("progress", dataclasses.asdict(progress))

    try:
        result = train(
            spec["env_id"],
            TrainConfig.from_dict(spec["config"]),
            Path(spec["run_dir"]),
            spec["seed"],
            spec["env_options"],
            resume=spec["resume"],
            show_progress=False,
            report=report,
        )
    except TomatoError as error:
        logging.getLogger("maniskill_tomato").error("error: %s", error)
        send("error", {"message": str(error)})
        raise SystemExit(2) from None
    send(
        "end",
        {
            "steps": result.steps,
            "episodes": result.episodes,
            "seconds": result.seconds,
            "stop_reason": result.stop_reason,
        },
    )


def _read_line() -> bytes:
    line = b""
    while not line.endswith(b"\n"):
        piece = os.read(0, 1)
        if not piece:
            break
        line += piece
    return line


def _stop_with_parent() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
