"""Ways to stop a run: Ctrl-C, SIGTERM, a terminal that closes, a key, a file, and a missing heartbeat of the loop."""

import math
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

from maniskill_tomato.deploy.deploy_errors import StoppedError

KEYS = ("q", "s", " ")
"""Followed by Enter, each of these stops a run in a terminal."""

SHORTEST_WATCH, LONGEST_WATCH = 0.01, 1.0
"""The heartbeat is looked at when it would be lost, within these bounds, in [s]."""


class Stops:
    """Says whether and why to stop; a context manager that puts signal handlers back."""

    def __init__(
        self,
        *,
        stop_file: Path | None = None,
        keyboard: bool = False,
        heartbeat_s: float = 60.0,
        on_lost_heartbeat: Callable[[], object] | None = None,
    ) -> None:
        """Prepares without listening yet.

        Args:
            stop_file: The run stops when this file appears.
            keyboard: Listen to `KEYS` on a terminal.
            heartbeat_s: Longest time between two `beat`s, in [s] of real time; it counts from the first one.
            on_lost_heartbeat: Called once from another thread when that passes.
        """
        self._stop_file = stop_file
        self._keyboard = keyboard and sys.stdin.isatty()
        self._heartbeat_s = heartbeat_s
        self._on_lost = on_lost_heartbeat
        self._reason: str | None = None
        self._last_beat = math.inf
        self._waiting = False
        self._ended = threading.Event()
        self._handlers: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                # What `nohup` starts goes on when its terminal closes.
                if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                    self._handlers[number] = signal.signal(number, self._on_signal)
        self._watch = threading.Thread(target=self._watch_heartbeat, name="heartbeat", daemon=True)
        self._watch.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()

    def request(self, reason: str) -> None:
        """Asks the run to stop; the first reason counts."""
        if self._reason is None:
            self._reason = reason

    def beat(self) -> str | None:
        """Says that the loop is alive; why it has to stop, or None."""
        self._last_beat = time.monotonic()
        return self.asked()

    def asked(self) -> str | None:
        """Why to stop, or None, without saying that the loop is alive."""
        if self._reason is None and self._stop_file is not None and _is_there(self._stop_file):
            self.request(f"stop file {self._stop_file}")
        if self._reason is None and self._keyboard and select.select([sys.stdin], [], [], 0)[0]:
            line = sys.stdin.readline()
            if line and (not line.strip() or line.strip().lower() in KEYS):
                self.request("key")
        return self._reason

    @contextmanager
    def interrupting(self) -> Iterator[None]:
        """While inside, nobody expects a beat, and a signal raises where it finds the program: for what waits without
        asking, such as a connection.

        Raises:
            StoppedError: A signal asked to stop, or something did before.
        """
        self._waiting = True
        try:
            # A signal that came before this line found nobody waiting.
            if self._reason is not None:
                raise StoppedError(self._reason)
            yield
        finally:
            self._waiting = False

    @contextmanager
    def waiting_for_a_person(self) -> Iterator[None]:
        """While inside, nobody expects a beat: people take their time. A signal ends the waiting.

        Raises:
            StoppedError: A signal asked to stop, or something did before.
        """
        with self.interrupting():
            try:
                yield
            finally:
                self._last_beat = time.monotonic()

    def rest(self) -> None:
        """No beat is expected any more: the loop is over. Signals are still taken."""
        self._last_beat = math.inf

    @property
    def reason(self) -> str | None:
        """Why to stop, without a beat."""
        return self._reason

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.request(signal.Signals(number).name)
        if self._waiting:
            # Python takes a read of the terminal up again after a signal, unless its handler raises.
            raise StoppedError(signal.Signals(number).name)

    def _watch_heartbeat(self) -> None:
        wait = self._heartbeat_s
        while not self._ended.wait(min(max(wait, SHORTEST_WATCH), LONGEST_WATCH)):
            # Read once: another thread beats.
            wait = self._last_beat + self._heartbeat_s - time.monotonic()
            if wait < 0.0 and not self._waiting:
                self.request("heartbeat")
                if self._on_lost is not None:
                    self._on_lost()
                return


def _is_there(path: Path) -> bool:
    """Whether somebody put a file, a folder or a link there, also a link that leads nowhere; a place that cannot be
    looked at counts as well, for no stop would be seen there."""
    try:
        os.lstat(path)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return True
