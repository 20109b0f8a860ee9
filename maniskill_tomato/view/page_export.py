"""An episode as one HTML file that needs no server: the scene of the viewer, move after move."""

from pathlib import Path

from maniskill_tomato.files import write_atomically
from maniskill_tomato.view.episode_recording import EpisodeRecording
from maniskill_tomato.view.page import (
    MOVE_FRAMES,
    MOVE_SECONDS,
    REST_SECONDS,
    way_of_joints,
)
from maniskill_tomato.view.page_scene import EpisodeScene
from maniskill_tomato.view.page_server import passing_server, stand_before

HOLD_SECONDS = 2.0 * REST_SECONDS
"""How long each view is seen, in [s]."""


def export_page(recording: EpisodeRecording, path: Path) -> int:
    """Writes a film of an episode that one can turn and zoom while it runs.

    Args:
        recording: The whole episode.
        path: The HTML file; it is written whole or not at all.

    Returns:
        Its size, in [bytes].

    Raises:
        NotWrittenError: The file cannot be written.
    """
    content = page_of(recording).encode()
    write_atomically(path, content)
    return len(content)


def page_of(recording: EpisodeRecording) -> str:
    """The HTML of `export_page`."""
    with passing_server() as server:
        stand_before(server, recording)
        scene = EpisodeScene(server.scene, recording.model, small=True)
        scene.draw(recording, 0)
        film = server.get_scene_serializer()
        film.insert_sleep(HOLD_SECONDS)
        for k in range(1, recording.length + 1):
            before, after = (recording.at(i).joint_positions for i in (k - 1, k))
            for joints in way_of_joints(before, after):
                scene.draw(recording, k - 1, joints)
                film.insert_sleep(MOVE_SECONDS / MOVE_FRAMES)
            scene.draw(recording, k)
            film.insert_sleep(HOLD_SECONDS)
        film.insert_sleep(HOLD_SECONDS)
        return film.as_html()
