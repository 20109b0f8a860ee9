"""A camera that one drags through the scene, always turned to the target, and to which the arm's camera can follow."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import viser

from maniskill_tomato.view.page_choices import by_hand
from maniskill_tomato.view.page_head import picture_tag
from maniskill_tomato.view.page_scene import Rgb, pose, vector
from maniskill_tomato.view.player import Player

HAND_COLOUR: Final[Rgb] = (200, 60, 160)
"""Of the camera that is taken by hand."""


class HandCamera:
    """Its controls, and what stands in the scene while it is taken."""

    def __init__(
        self, server: viser.ViserServer, player: Player, ask: Callable[[Callable[[], None]], object]
    ) -> None:
        """Adds the controls to the container that is open.

        Args:
            server: viser's.
            player: Whose plant is looked at.
            ask: Has something done by the page's thread.
        """
        self._scene = server.scene
        self._player = player
        self._ask = ask
        self._handle: Any = None
        self._is_asked = False
        self._demonstrated = server.gui.add_markdown("", visible=False)
        self.tell()
        box = server.gui.add_checkbox("Take a camera in the hand", False)
        box.on_update(self._taken)
        self._words = server.gui.add_markdown(
            "Drag it by its arrows: V_f from there is counted with rays at once."
        )
        self._move = server.gui.add_button("Move the arm there", visible=False)
        self._move.on_click(by_hand(ask, lambda _: self.move()))
        self._picture = server.gui.add_html("", visible=False)

    def take(self, is_taken: bool) -> None:
        """Puts up the camera, where the wrist camera is now, or takes it away."""
        self._picture.visible = self._move.visible = is_taken
        if not is_taken:
            self._scene.remove_by_name("/hand")
            self._scene.remove_by_name("/hand_view")
            self._handle = None
        elif self._handle is None:
            snapshot = self._player.recording.snapshots[self._player.shown]
            self._handle = self._scene.add_transform_controls(
                "/hand",
                scale=0.15,
                disable_rotations=True,
                depth_test=False,
                position=vector(snapshot.T_w_camera[:3, 3]),
            )
            self._handle.on_update(lambda _: self._ask_look())
            self.look()

    def tell(self) -> None:
        """Says what becomes of the episode as a demonstration."""
        words = self._player.demonstrated
        self._demonstrated.content, self._demonstrated.visible = words or "", words is not None

    def move(self) -> None:
        """Moves the arm's camera to where this one is held, or as far as one move goes.

        Raises:
            InvalidInputError: The episode is over, or no move leads there.
            NotWrittenError: A demonstration that the move completes cannot be saved.
        """
        if self._handle is not None:
            self._player.move_camera(np.array(self._handle.position, dtype=np.float64))
            self.look()

    def look(self) -> None:
        """Tells V_f from where the camera is held, if it is."""
        self._is_asked = False
        if self._handle is None:
            return
        view = self._player.look_from(np.array(self._handle.position, dtype=np.float64))
        if view is None:
            return
        height, width = view.picture.shape[:2]
        wxyz, position = pose(view.T_w_camera)
        self._scene.add_camera_frustum(
            "/hand_view",
            fov=self._player.recording.fov_y,
            aspect=width / height,
            scale=0.08,
            thickness=0.003,
            color=HAND_COLOUR,
            cast_shadow=False,
            wxyz=wxyz,
            position=position,
        )
        self._picture.content = picture_tag(view.picture, "What the camera in the hand sees")
        reach = "the arm reaches this place" if view.is_reachable else "the arm does **not** reach this place"
        self._words.content = f"V_f **{view.visible_fraction:.2f}** from here; {reach}"

    def _taken(self, event: Any) -> None:
        wanted = bool(event.target.value)
        self._ask(lambda: self.take(wanted))

    def _ask_look(self) -> None:
        """Looks from where the hand is when the thread comes to it; dragging asks more often than it can answer."""
        if not self._is_asked:
            self._is_asked = True
            self._ask(self.look)
