"""The viewer's page: a scene, the controls beside it, and one thread that does what they ask for."""

import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Final

import numpy as np
import viser
from viser import uplot

from maniskill_tomato import report_design as design
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.plants.kinds import PLANT_NAMES
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.view.episode_recording import EpisodeRecording, Float64
from maniskill_tomato.view.page_scene import LAYERS, LAYERS_OF_RUNS, EpisodeScene, pose, vector
from maniskill_tomato.view.page_server import close_server, open_server, stand_before
from maniskill_tomato.view.play_settings import PERCEPTIONS
from maniskill_tomato.view.player import Player

logger = logging.getLogger(__name__)

MOVE_SECONDS: Final = 0.6
"""How long the arm is seen on its way, in [s]."""

REST_SECONDS: Final = 0.5
"""How long a view is seen before the next move while an episode is played, in [s]."""

MOVE_FRAMES: Final = 15
"""Pictures of a move."""

LAST_MOVES: Final = 6
"""Moves that are told in words."""


OWN_PLANT: Final = "the task's own"


HAND_COLOUR: Final = (200, 60, 160)
"""Of the camera that is taken by hand."""


class PlayPage:
    """A server with the page of one player; all browsers that open it see and steer the same episode."""

    def __init__(self, player: Player, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Serves the page; `close` ends it.

        Args:
            player: What is shown.
            host: Address to listen at; only this machine by default.
            port: 0 takes a free one.

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
        self._build_controls()
        self.draw()
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
        self._problem.content = ""
        try:
            command()
        except TomatoError as error:
            self._problem.content = f"**Not possible:** {error}"
        self.draw()

    # ---------------------------------------------------------------- controls

    def _build_controls(self) -> None:
        gui, player = self.server.gui, self.player
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._title = gui.add_markdown("")
        self._problem = gui.add_markdown("")
        self._pictured = np.full((3, 4, 3), 128, dtype=np.uint8)
        self._picture = gui.add_image(self._pictured, label="Wrist camera")
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self._play.on_click(self._clicked(self._toggle))
        self._step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT)
        self._step.on_click(self._clicked(player.step))
        self._reset = gui.add_button("Reset", icon=viser.Icon.REFRESH)
        self._reset.on_click(self._clicked(player.reset))
        self._move: Any = gui.add_slider("Move", min=0, max=1, step=1, initial_value=0)
        self._move.on_update(self._by_hand(lambda value: player.show(int(value))))
        self._plot = gui.add_uplot(
            (np.zeros(1), np.zeros(1), np.zeros(1)),
            (
                uplot.Series(label="move"),
                uplot.Series(
                    label="V_f", stroke=design.TOMATO, width=2, points=uplot.Series_Points(show=True)
                ),
                uplot.Series(label="full", stroke=design.MUTED, width=1, dash=(4.0, 4.0)),
            ),
            title="V_f over the moves",
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=False, range=(0.0, 1.0))},
            height=170,
        )
        self._moves = gui.add_markdown("")
        if not player.is_stored:
            self._build_choices()
            self._build_hand()
        with gui.add_folder("Show"):
            for name, visible in self.scene.visible.items():
                if name not in (LAYERS_OF_RUNS if player.is_stored else LAYERS):
                    continue
                box = gui.add_checkbox(name, visible)
                box.on_update(self._layer(name))

    def _build_choices(self) -> None:
        gui, player = self.server.gui, self.player
        with gui.add_folder("Episode"):
            self._env_id: Any = gui.add_dropdown("Task", TASK_IDS, initial_value=player.settings.env_id)
            self._env_id.on_update(self._by_hand(lambda value: player.change(env_id=value)))
            self._policy: Any = gui.add_dropdown(
                "Policy", player.settings.policies(), initial_value=player.settings.policy
            )
            self._policy.on_update(self._by_hand(lambda value: player.change(policy=value)))
            self._perception: Any = gui.add_dropdown(
                "Senses", PERCEPTIONS, initial_value=player.settings.perception
            )
            self._perception.on_update(self._by_hand(lambda value: player.change(perception=value)))
            self._seed: Any = gui.add_number("Seed", player.settings.seed, min=0, step=1)
            self._seed.on_update(self._by_hand(lambda value: player.change(seed=int(value))))
            others = gui.add_button_group("Go to", ("previous", "next"))
            others.on_click(self._by_hand(self._next_seed))
        with gui.add_folder("Another plant", expand_by_default=False):
            preset = gui.add_dropdown("Preset", (OWN_PLANT, *PLANT_NAMES), initial_value=OWN_PLANT)
            seed = gui.add_number("Plant seed", 0, min=0, step=1)
            density = gui.add_slider("Leaf density", min=0.2, max=2.0, step=0.1, initial_value=1.0)

            def grow() -> None:
                options = {
                    "preset": preset.value,
                    "seed": int(seed.value),
                    "leaf_density": float(density.value),
                }
                player.change(plant_options={} if preset.value == OWN_PLANT else {"plant": options})

            gui.add_button("Grow", icon=viser.Icon.PLANT).on_click(self._clicked(grow))

    def _build_hand(self) -> None:
        """A camera that one drags, always turned to the target."""
        gui = self.server.gui
        self._hand: Any = None
        self._is_hand_asked = False
        with gui.add_folder("Camera in the hand", expand_by_default=False):
            box = gui.add_checkbox("Take it", False)
            self._hand_words = gui.add_markdown(
                "Drag it by its arrows: V_f from there is counted with rays at once."
            )
            self._hand_picture = gui.add_image(self._pictured, visible=False)

        def taken(event: Any) -> None:
            wanted = bool(event.target.value)
            self.ask(lambda: self.take_hand(wanted))

        box.on_update(taken)

    def take_hand(self, is_taken: bool) -> None:
        """Puts up the camera that one drags, where the wrist camera is now, or takes it away."""
        self._hand_picture.visible = is_taken
        if not is_taken:
            self.server.scene.remove_by_name("/hand")
            self.server.scene.remove_by_name("/hand_view")
            self._hand = None
        elif self._hand is None:
            snapshot = self.player.recording.snapshots[self.player.shown]
            self._hand = self.server.scene.add_transform_controls(
                "/hand",
                scale=0.15,
                disable_rotations=True,
                depth_test=False,
                position=vector(snapshot.T_w_camera[:3, 3]),
            )
            self._hand.on_update(lambda _: self._ask_hand())
            self._look_by_hand()

    def _ask_hand(self) -> None:
        """Looks from where the hand is when the thread comes to it; dragging asks more often than it can answer."""
        if not self._is_hand_asked:
            self._is_hand_asked = True
            self.ask(self._look_by_hand)

    def _look_by_hand(self) -> None:
        self._is_hand_asked = False
        if self._hand is None:
            return
        view = self.player.look_from(np.array(self._hand.position, dtype=np.float64))
        if view is None:
            return
        height, width = view.picture.shape[:2]
        wxyz, position = pose(view.T_w_camera)
        self.server.scene.add_camera_frustum(
            "/hand_view",
            fov=self.player.recording.fov_y,
            aspect=width / height,
            scale=0.08,
            thickness=0.003,
            color=HAND_COLOUR,
            cast_shadow=False,
            wxyz=wxyz,
            position=position,
        )
        self._hand_picture.image = view.picture
        reach = "the arm reaches this place" if view.is_reachable else "the arm does **not** reach this place"
        self._hand_words.content = f"V_f **{view.visible_fraction:.2f}** from here; {reach}"

    def _clicked(self, command: Callable[[], None]) -> Callable[[Any], None]:
        def clicked(_: Any) -> None:
            self.ask(command)

        return clicked

    def _by_hand(self, command: Callable[[Any], None]) -> Callable[[Any], None]:
        """A callback that does something with a control's value if somebody set it in a browser."""

        def changed(event: Any) -> None:
            value = event.target.value
            if event.client is not None:
                self.ask(lambda: command(value))

        return changed

    def _layer(self, name: str) -> Callable[[Any], None]:
        return lambda event: self.scene.show_layer(name, bool(event.target.value))

    def _toggle(self) -> None:
        (self.player.pause if self.player.is_playing else self.player.play)()

    def _next_seed(self, which: str) -> None:
        step = -1 if which == "previous" else 1
        self.player.change(seed=max(self.player.settings.seed + step, 0))

    # ----------------------------------------------------------------- drawing

    def draw(self) -> None:
        """Draws the shown snapshot; the arm is seen on its way if it is the one after the last that was drawn."""
        recording, shown = self.player.recording, self.player.shown
        if not recording.snapshots:
            self._title.content = f"{recording.title}\n\nThere was no look yet."
            return
        if self._drawn == (recording, shown - 1):
            before = recording.snapshots[shown - 1].joint_positions
            self._animate(recording, shown - 1, before, recording.snapshots[shown].joint_positions)
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
        settings, snapshot = self.player.settings, recording.snapshots[shown]
        self._title.content = headline(recording, shown)
        if snapshot.picture is not self._pictured:
            # A browser complains about a picture that is replaced while it loads.
            self._picture.image = self._pictured = snapshot.picture
        self._play.label = "Pause" if self.player.is_playing else "Play"
        self._move.max = max(recording.moves, 1)
        self._move.value = shown
        fractions = recording.visible_fractions
        self._plot.data = (
            np.arange(len(fractions), dtype=np.float64),
            fractions,
            np.full(len(fractions), recording.threshold),
        )
        self._moves.content = last_moves(recording, shown)
        if self.player.is_stored:
            return
        self._env_id.value = settings.env_id
        self._policy.options = settings.policies()
        self._policy.value = settings.policy
        self._perception.value = settings.perception
        self._seed.value = settings.seed


def way_of_joints(before: Float64, after: Float64) -> list[Float64]:
    """Joint positions on a straight way that begins and ends gently, without its ends. Shapes (7,)."""
    shares = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, MOVE_FRAMES) / MOVE_FRAMES)
    return [before + share * (after - before) for share in shares]


def headline(recording: EpisodeRecording, shown: int) -> str:
    """Which episode it is, V_f, and how it ended, as Markdown."""
    snapshot = recording.snapshots[shown]
    fraction = f"V_f **{snapshot.visible_fraction:.2f}** at move {shown}"
    if snapshot.true_visible_fraction is not None:
        fraction += f" (truly {snapshot.true_visible_fraction:.2f})"
    lines = [recording.title, fraction]
    if shown == recording.moves and recording.outcome:
        lines.append(f"**{recording.outcome}**")
    return "\n\n".join(lines)


def last_moves(recording: EpisodeRecording, shown: int) -> str:
    """The last moves in words, the latest first, as a Markdown list."""
    lines = []
    for k in range(shown, max(shown - LAST_MOVES, 0), -1):
        snapshot = recording.snapshots[k]
        event = f"**{snapshot.event}**" if snapshot.was_refused else snapshot.event
        lines.append(f"{k}. {event}, V_f {snapshot.visible_fraction:.2f}")
    return "\n".join(f"- move {line}" for line in lines)
