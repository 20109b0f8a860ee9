"""The target fruit on a handle by which one drags it through the plant."""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.view.page_scene import vector
from maniskill_tomato.view.player import NO_DRAG, Player

HANDLE = "/target_handle"


class TargetDrag:
    """Its controls, and the handle in the scene."""

    def __init__(
        self, server: viser.ViserServer, player: Player, ask: Callable[[Callable[[], None]], object]
    ) -> None:
        """Adds the controls to the container that is open.

        Args:
            server: viser's.
            player: Whose target is dragged.
            ask: Has something done by the page's thread.
        """
        self._scene = server.scene
        self._player = player
        self._ask = ask
        self._handle: Any = None
        self._is_asked = False
        self._is_held = False
        box = server.gui.add_checkbox("Drag the target", False)
        box.on_update(self._taken)
        server.gui.add_markdown(
            "V_f, rays and the wrist picture answer while you drag the tomato; where you leave it the policy decides "
            "anew. *Reset* hangs it back."
        )

    def take(self, is_taken: bool) -> None:
        """Puts up the handle, where the target is, or takes it away.

        Raises:
            InvalidInputError: The target cannot be moved.
        """
        if not is_taken:
            self._scene.remove_by_name(HANDLE)
            self._handle = None
        elif self._handle is None:
            place = self._player.target_place()
            if place is None:
                raise InvalidInputError(NO_DRAG)
            self._handle = self._scene.add_transform_controls(
                HANDLE, scale=0.15, disable_rotations=True, depth_test=False, position=vector(place)
            )
            self._handle.on_update(self._dragged)

    def tell(self) -> None:
        """Moves the handle to a target that became another one; takes it away where there is none to move."""
        if self._handle is None or self._is_held:
            return
        place = self._player.target_place()
        if place is None:
            self.take(False)
        else:
            self._handle.position = vector(place)

    def move(self) -> None:
        """Hangs the target where the handle is."""
        self._is_asked = False
        if self._handle is not None:
            self._player.move_target(np.array(self._handle.position, dtype=np.float64))

    def _taken(self, event: Any) -> None:
        wanted = bool(event.target.value)
        self._ask(lambda: self.take(wanted))

    def _dragged(self, event: Any) -> None:
        """Dragging asks more often than it can be answered; the end of it is always answered."""
        self._is_held = event.phase != "end"
        if event.phase == "end":
            self._ask(self._dropped)
        elif event.phase == "update" and not self._is_asked:
            self._is_asked = True
            self._ask(self.move)

    def _dropped(self) -> None:
        self.move()
        self._player.drop_target()
