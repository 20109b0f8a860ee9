"""The viewer's page: a scene, the controls beside it, and one thread that does what they ask for."""

import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.view.episode_recording import EpisodeRecording, Float64
from maniskill_tomato.view.page_choices import EpisodeChoices, by_hand
from maniskill_tomato.view.page_fruits import fruit_list
from maniskill_tomato.view.page_hand import HandCamera
from maniskill_tomato.view.page_head import head, last_moves
from maniskill_tomato.view.page_plot import FractionPlot
from maniskill_tomato.view.page_record import RecordChoices
from maniskill_tomato.view.page_scene import LAYERS_OF_PLAY, LAYERS_OF_RECORDS, LAYERS_OF_RUNS, EpisodeScene
from maniskill_tomato.view.page_server import close_server, open_server, stand_before, step_back
from maniskill_tomato.view.page_target import TargetDrag
from maniskill_tomato.view.player import Player

if TYPE_CHECKING:
    from maniskill_tomato.view.record_session import RecordSession

logger = logging.getLogger(__name__)

MOVE_SECONDS: Final = 0.6
"""How long the arm is seen on its way, in [s]."""

REST_SECONDS: Final = 0.5
"""How long a view is seen before the next move while an episode is played, in [s]."""

MOVE_FRAMES: Final = 15
"""Pictures of a move."""

STEERING: Final = ("Play", "Step", "Reset")
"""Buttons; the first one is Pause while an episode is played."""


class PlayPage:
    """A server with the page of one player; all browsers that open it see and steer the same episode."""

    def __init__(
        self,
        player: Player,
        host: str = "127.0.0.1",
        port: int = 8080,
        record: "RecordSession | None" = None,
    ) -> None:
        """Serves the page; `close` ends it.

        Args:
            player: What is shown.
            host: Address to listen at; only this machine by default.
            port: 0 takes a free one.
            record: Where the player's episodes come from, if they are stored ones that can be chosen.

        Raises:
            InvalidInputError: The port is taken, or the address is not this machine's.
        """
        self.player = player
        self.server = open_server(host, port)
        """viser's."""
        self._commands: queue.Queue[tuple[Callable[[], None], Future[None]] | None] = queue.Queue()
        self._drawn: tuple[EpisodeRecording, int] | None = None
        self.scene = EpisodeScene(self.server.scene, player.recording.model)
        """What is drawn."""
        self._record = record
        self._build_controls()
        self.draw()
        self.server.on_client_connect(lambda client: step_back(self.server, client))
        self._worker = threading.Thread(target=self._work, name="play", daemon=True)
        self._worker.start()

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def close(self) -> None:
        """Ends the thread and the server."""
        self._commands.put(None)
        self._worker.join()
        close_server(self.server)

    def ask(self, command: Callable[[], None]) -> "Future[None]":
        """Has something done by the page's thread, which then draws what has become of it.

        Args:
            command: A `TomatoError` that it raises is told on the page.

        Returns:
            Done when it is drawn.
        """
        done: Future[None] = Future()
        self._commands.put((command, done))
        return done

    # ------------------------------------------------------------------ thread

    def _work(self) -> None:
        while True:
            try:
                asked = self._commands.get(timeout=REST_SECONDS if self.player.is_playing else None)
            except queue.Empty:
                asked = self.player.step, Future()
            if asked is None:
                return
            command, done = asked
            try:
                self._do(command)
            except Exception as error:
                logger.exception("the page could not be drawn")
                done.set_exception(error)
            else:
                done.set_result(None)

    def _do(self, command: Callable[[], None]) -> None:
        problem = ""
        try:
            command()
        except TomatoError as error:
            problem = f"**Not possible:** {error}"
        self._problem.content, self._problem.visible = problem, bool(problem)
        self.draw()

    # ---------------------------------------------------------------- controls

    def _build_controls(self) -> None:
        """The panel: what one always needs, and below it the rest in tabs.

        On a wide page both parts are docked at the right; on a narrow one viser makes a sheet at the bottom of them, in
        which the tabs are folded at first.
        """
        gui, player = self.server.gui, self.player
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._problem = gui.add_markdown("", visible=False)
        self._steer: Any = gui.add_button_group("", STEERING)
        self._steer.on_click(by_hand(self.ask, self._steered))
        self._move: Any = gui.add_slider("Move", min=0, max=1, step=1, initial_value=0)
        self._move.on_update(by_hand(self.ask, lambda value: player.show(int(value))))
        self._head = gui.add_html("")
        tabs = gui.add_panel()
        if self._record is not None:
            with tabs.add_tab("Record"):
                self._records = RecordChoices(gui, self._record, player, self.ask)
        with tabs.add_tab("Moves"):
            self._plot = FractionPlot(gui)
            self._moves = gui.add_markdown("")
        if not player.is_stored:
            with tabs.add_tab("Episode"):
                self._choices = EpisodeChoices(gui, player, self.ask)
            with tabs.add_tab("Fruits"):
                self._fruits = gui.add_html("")
            with tabs.add_tab("Hand"):
                self.target = TargetDrag(self.server, player, self.ask)
                self.hand = HandCamera(self.server, player, self.ask)
        with tabs.add_tab("Show"):
            for name in self._layers():
                box = gui.add_checkbox(name, self.scene.visible[name])
                box.on_update(self._layer(name))
        tabs.dock_below(gui.main_panel)

    def _layers(self) -> tuple[str, ...]:
        """What there is to show or hide."""
        if self._record is not None:
            return LAYERS_OF_RECORDS
        return LAYERS_OF_RUNS if self.player.is_stored else LAYERS_OF_PLAY

    def _steered(self, what: str) -> None:
        """Does what one of `STEERING` says."""
        player = self.player
        if what == "Step":
            player.step()
        elif what == "Reset":
            player.reset()
        else:
            (player.pause if player.is_playing else player.play)()

    def _layer(self, name: str) -> Callable[[Any], None]:
        return lambda event: self.scene.show_layer(name, bool(event.target.value))

    # ----------------------------------------------------------------- drawing

    def draw(self) -> None:
        """Draws the shown snapshot; the arm is seen on its way if it is the one after the last that was drawn."""
        recording, shown = self.player.recording, self.player.shown
        if not recording.snapshots:
            self._head.content = head(recording, shown)
            return
        if self._drawn == (recording, shown - 1):
            before, after = recording.at(shown - 1).joint_positions, recording.at(shown).joint_positions
            self._animate(recording, shown - 1, before, after)
        if self._drawn is None or self._drawn[0] is not recording:
            stand_before(self.server, recording)
        with self.server.atomic():
            self.scene.draw(recording, shown)
            self._tell(recording, shown)
        self.server.flush()
        self._drawn = recording, shown

    def _animate(self, recording: EpisodeRecording, index: int, before: Float64, after: Float64) -> None:
        for joints in way_of_joints(before, after):
            self.scene.draw(recording, index, joints)
            self.server.flush()
            time.sleep(MOVE_SECONDS / MOVE_FRAMES)

    def _tell(self, recording: EpisodeRecording, shown: int) -> None:
        """Brings the controls up to date."""
        self._head.content = head(recording, shown)
        self._steer.options = ("Pause" if self.player.is_playing else "Play", *STEERING[1:])
        self._move.max = max(recording.length, 1)
        self._move.value = shown
        self._plot.tell(recording)
        self._moves.content = last_moves(recording, shown)
        if self._record is not None:
            self._records.tell(recording, shown)
        elif not self.player.is_stored:
            self._choices.tell()
            self.target.tell()
            self.hand.tell()
            snapshot = recording.at(shown)
            self._fruits.content = fruit_list(snapshot, has_map=snapshot.measured is not None)


def way_of_joints(before: Float64, after: Float64) -> list[Float64]:
    """Joint positions on a straight way that begins and ends gently, without its ends. Shapes (7,)."""
    shares = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, MOVE_FRAMES) / MOVE_FRAMES)
    return [before + share * (after - before) for share in shares]
