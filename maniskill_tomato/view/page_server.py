"""viser's server for this machine: without its words on the terminal, and never on a port that was not asked for."""

import contextlib
import io
from collections.abc import Iterator
from typing import Final

import numpy as np
import viser

from maniskill_tomato.view.episode_recording import EpisodeRecording
from maniskill_tomato.view.page_address import check_port
from maniskill_tomato.view.page_scene import FIELD_OF_VIEW, first_view, vector

UPRIGHT: Final = 0.75
"""Width of a screen over its height; less is an upright one, on which the scene is wider than the picture."""

SHEET_SHIFT: Final = np.array([0.0, 0.0, 0.25])
"""How far down one looks there, in [m]."""


def open_server(host: str, port: int) -> viser.ViserServer:
    """A server; `close_server` ends it.

    Args:
        host: Address to listen at.
        port: 0 takes a free one.

    Raises:
        InvalidInputError: The port is taken, or the address is not this machine's.
    """
    check_port(host, port)
    # It prints its addresses whatever `verbose` says.
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=port, label="maniskill-tomato", verbose=False)


def close_server(server: viser.ViserServer) -> None:
    """Ends a server."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextlib.contextmanager
def passing_server() -> Iterator[viser.ViserServer]:
    """A server that nobody visits: what is drawn on it goes into a file."""
    server = open_server("127.0.0.1", 0)
    try:
        yield server
    finally:
        close_server(server)


def stand_before(server: viser.ViserServer, recording: EpisodeRecording) -> None:
    """Places the camera of whoever opens the page so that arm and plant fill the picture."""
    place, at = first_view(recording)
    camera = server.initial_camera
    camera.fov = FIELD_OF_VIEW
    camera.up, camera.position, camera.look_at = (0.0, 0.0, 1.0), vector(place), vector(at)


def step_back(server: viser.ViserServer, client: viser.ClientHandle) -> None:
    """Moves the camera of a browser with an upright screen back until the scene fits into its upper part.

    The lower part is under the sheet with the controls. A browser takes the place of `stand_before` some time after it
    has connected; only then it is moved.
    """
    is_done = False

    def moved(camera: viser.CameraHandle) -> None:
        nonlocal is_done
        place, at = (np.array(v) for v in (server.initial_camera.position, server.initial_camera.look_at))
        if is_done or camera.aspect >= UPRIGHT or not np.allclose(camera.position, place, atol=1e-3):
            return
        is_done = True
        # The other order would move what is looked at along with the camera.
        camera.position = vector(at - SHEET_SHIFT + (place - at) * UPRIGHT / camera.aspect)
        camera.look_at = vector(at - SHEET_SHIFT)

    client.camera.on_update(moved)
