"""The page and its file, asked on the server's side; without a browser."""

import base64
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zstandard

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.row import generate_row
from maniskill_tomato.view.page import PlayPage
from maniskill_tomato.view.page_export import export_page
from maniskill_tomato.view.page_head import headline, last_moves
from maniskill_tomato.view.page_plot import FractionPlot
from maniskill_tomato.view.page_scene import score_colours
from maniskill_tomato.view.plant_meshes import organ_colours, plant_layers
from maniskill_tomato.view.play_session import PlaySession
from maniskill_tomato.view.play_settings import PlaySettings
from maniskill_tomato.view.player import Player
from maniskill_tomato.view.record_session import RecordSession

PATIENCE_S = 60.0


@pytest.fixture
def page() -> Iterator[PlayPage]:
    opened = PlayPage(Player(PlaySession, PlaySettings(policy="nbv")), port=0)
    try:
        yield opened
    finally:
        opened.close()


def node(page: PlayPage, name: str) -> Any:
    handle = page.server.scene.get_handle_by_name(name)
    assert handle is not None, name
    return handle


def test_the_scene_holds_plant_arm_camera_and_candidates_where_they_are(page: PlayPage) -> None:
    snapshot = page.player.recording.snapshots[0]
    for name in ("/plant/leaves", "/plant/fruits", "/plant/neighbours", "/arm/link_0", "/candidates/best"):
        node(page, name)
    np.testing.assert_allclose(node(page, "/camera").position, snapshot.T_w_camera[:3, 3], atol=1e-6)
    np.testing.assert_allclose(node(page, "/target").position, snapshot.target_position, atol=1e-6)
    np.testing.assert_allclose(
        node(page, "/plant").position, page.player.recording.T_w_plant[:3, 3], atol=1e-6
    )
    flange, camera = node(page, "/arm/link_ee").position, snapshot.T_w_camera[:3, 3]
    assert np.linalg.norm(flange - camera) < 0.15


def test_a_step_that_is_asked_for_moves_the_camera_in_the_scene(page: PlayPage) -> None:
    first = np.array(node(page, "/camera").position)
    page.ask(page.player.step).result(PATIENCE_S)
    assert np.linalg.norm(node(page, "/camera").position - first) > 0.01
    snapshot = page.player.recording.snapshots[1]
    np.testing.assert_allclose(node(page, "/camera").position, snapshot.T_w_camera[:3, 3], atol=1e-6)
    page.ask(lambda: page.player.show(0)).result(PATIENCE_S)
    np.testing.assert_allclose(node(page, "/camera").position, first)


def test_another_seed_shows_another_plant(page: PlayPage) -> None:
    before = node(page, "/plant/leaves").glb_data
    page.ask(lambda: page.player.change(seed=1)).result(PATIENCE_S)
    assert node(page, "/plant/leaves").glb_data != before
    page.ask(lambda: page.player.change(seed=0)).result(PATIENCE_S)
    assert node(page, "/plant/leaves").glb_data == before


def test_an_episode_plays_to_its_end_by_itself(page: PlayPage) -> None:
    page.ask(page.player.play).result(PATIENCE_S)
    for _ in range(600):
        if page.player.is_at_end:
            break
        time.sleep(0.1)
    assert page.player.is_at_end and page.player.recording.moves > 1


def test_what_cannot_be_done_leaves_the_page_as_it_was(page: PlayPage) -> None:
    page.ask(lambda: page.player.change(policy="no_such_policy")).result(PATIENCE_S)
    assert page.player.settings.policy == "nbv"
    page.ask(page.player.step).result(PATIENCE_S)
    assert page.player.shown == 1


def test_a_layer_can_be_hidden_and_stays_so_at_the_next_view(page: PlayPage) -> None:
    page.scene.show_layer("candidates", False)
    page.scene.show_layer("blocked", True)
    assert not node(page, "/candidates/best").visible and node(page, "/memory/blocked").visible
    page.ask(page.player.step).result(PATIENCE_S)
    assert not node(page, "/candidates/best").visible and node(page, "/memory/blocked").visible


def test_the_camera_in_the_hand_stands_in_the_scene_while_it_is_taken(page: PlayPage) -> None:
    page.ask(lambda: page.hand.take(True)).result(PATIENCE_S)
    camera = page.player.recording.snapshots[0].T_w_camera[:3, 3]
    np.testing.assert_allclose(node(page, "/hand").position, camera, atol=1e-6)
    np.testing.assert_allclose(node(page, "/hand_view").position, camera, atol=1e-6)
    page.ask(lambda: page.hand.take(False)).result(PATIENCE_S)
    assert page.server.scene.get_handle_by_name("/hand") is None


def test_the_arm_goes_to_where_the_camera_is_held_when_it_is_told_to(page: PlayPage) -> None:
    page.ask(lambda: page.hand.take(True)).result(PATIENCE_S)
    handle = node(page, "/hand")
    first = np.array(handle.position)
    held = first + [0.0, 0.0, 0.05]
    handle.position = tuple(held)
    page.ask(page.hand.look).result(PATIENCE_S)
    np.testing.assert_allclose(node(page, "/camera").position, first, atol=1e-6)
    page.ask(page.hand.move).result(PATIENCE_S)
    assert page.player.shown == page.player.recording.moves == 1
    np.testing.assert_allclose(node(page, "/camera").position, held, atol=1e-3)


def test_a_target_that_is_dragged_moves_its_fruit_and_nothing_else(page: PlayPage) -> None:
    page.ask(lambda: page.target.take(True)).result(PATIENCE_S)
    place = page.player.target_place()
    assert place is not None
    handle = node(page, "/target_handle")
    np.testing.assert_allclose(handle.position, place, atol=1e-5)
    before = {name: node(page, f"/plant/{name}") for name in ("leaves", "fruits", "stems", "neighbours")}
    handle.position = tuple(place + [0.0, 0.0, 0.1])
    page.ask(page.target.move).result(PATIENCE_S)
    np.testing.assert_allclose(node(page, "/target").position, place + [0.0, 0.0, 0.1], atol=1e-5)
    changed = [name for name, drawn in before.items() if node(page, f"/plant/{name}") is not drawn]
    assert changed == ["fruits"]
    page.ask(page.player.reset).result(PATIENCE_S)
    np.testing.assert_allclose(node(page, "/target_handle").position, place, atol=1e-5)
    page.ask(lambda: page.target.take(False)).result(PATIENCE_S)
    assert page.server.scene.get_handle_by_name("/target_handle") is None


def test_a_record_shows_the_other_policies_ways_in_their_colours(record_folder: Path) -> None:
    session = RecordSession(record_folder)
    opened = PlayPage(Player.over(session), port=0, record=session)
    try:
        opened.ask(lambda: opened.player.show(1)).result(PATIENCE_S)
        nbv = session.recording.ways[0]
        assert session.policy == "random_step" and nbv.label == "nbv"
        camera = node(opened, "/others/0/camera")
        np.testing.assert_allclose(camera.position, nbv.recording.snapshots[1].T_w_camera[:3, 3], atol=1e-6)
        assert tuple(camera.color) == nbv.colour
        assert tuple(node(opened, "/camera").color) == session.recording.ways[1].colour
        opened.scene.show_layer("other policies", False)
        assert not node(opened, "/others/0/camera").visible
        opened.ask(lambda: session.choose(policy="nbv")).result(PATIENCE_S)
        assert opened.server.scene.get_handle_by_name("/others/0/camera") is None
        assert not node(opened, "/others/1/camera").visible
    finally:
        opened.close()


def test_a_port_that_is_taken_is_refused_in_words() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InvalidInputError, match=f"127.0.0.1:{port} .*choose another --port"):
            PlayPage(Player(PlaySession, PlaySettings(policy="nbv")), port=port)


class Gui:
    """Stands for viser's: keeps the plot that is added to it."""

    def __init__(self) -> None:
        self.plot = SimpleNamespace(bands=None)

    def add_uplot(self, data: Any, series: Any, **options: Any) -> SimpleNamespace:
        return self.plot


def test_the_plot_fills_the_band_in_which_a_measured_fraction_may_lie_and_no_other() -> None:
    gui = Gui()
    plot = FractionPlot(gui)  # type: ignore[arg-type]
    exact = PlaySession(PlaySettings(policy="nbv")).recording
    measured = PlaySession(PlaySettings(perception="occlusion_model", policy="nbv", target="any")).recording
    band = measured.snapshots[0].measured
    assert band is not None
    plot.tell(measured)
    (filled,) = gui.plot.bands
    edges = [float(gui.plot.data[index][0]) for index in filled["series"]]
    assert edges == pytest.approx([band.band[2], band.band[0]]) and edges[0] > edges[1]
    assert [gui.plot.series[index]["label"] for index in filled["series"]] == ["at most", "at least"]
    plot.tell(exact)
    assert gui.plot.bands is None and len(gui.plot.data) == len(gui.plot.series)


def test_the_words_tell_what_came_of_each_move() -> None:
    session = PlaySession(PlaySettings(policy="random_step", seed=1))
    while session.step():
        pass
    recording = session.recording
    refused = next(k for k, s in enumerate(recording.snapshots) if s.was_refused)
    assert f"move {refused}. **refused" in last_moves(recording, refused)
    assert f"move {refused + 1}." not in last_moves(recording, refused)
    assert recording.outcome in headline(recording, recording.moves)
    assert recording.outcome not in headline(recording, 0)


def test_an_exported_page_is_one_small_file_with_the_scene_and_every_move(tmp_path: Path) -> None:
    session = PlaySession(PlaySettings(policy="nbv"))
    while session.step():
        pass
    path = tmp_path / "page.html"
    size = export_page(session.recording, path)
    text = path.read_text(encoding="utf-8")
    assert len(text.encode()) == size < 2_500_000 and list(tmp_path.iterdir()) == [path]
    assert not re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="https?:', text)
    data = re.search(r'window\.__VISER_EMBED_DATA__="([^"]+)"', text)
    assert data is not None
    packed = base64.b64decode(data.group(1))
    scene = zstandard.ZstdDecompressor().decompressobj().decompress(packed[8:])
    for name in (b"/plant/leaves", b"/plant/neighbours", b"/arm/link_7", b"/camera", b"/target"):
        assert name in scene
    # Every view has a picture, the first one too.
    assert scene.count(b"CameraFrustumMessage") >= session.recording.moves + 1


def test_layers_hold_every_triangle_of_a_row_once_and_a_small_one_fewer() -> None:
    row = generate_row("full", 3)
    layers = plant_layers(row)
    assert set(layers) == {"leaves", "fruits", "stems", "neighbours"}
    assert sum(len(mesh.faces) for mesh in layers.values()) == len(row.faces)
    small = plant_layers(row, 0.3)
    assert len(small["neighbours"].faces) <= 0.3 * len(layers["neighbours"].faces)
    assert len(small["leaves"].faces) == len(layers["leaves"].faces)
    whole, few = (mesh["neighbours"].vertices for mesh in (layers, small))
    np.testing.assert_allclose(few.max(0) - few.min(0), whole.max(0) - whole.min(0), atol=0.03)
    assert set(plant_layers(generate_plant("one_tomato"))) == {"leaves", "fruits", "stems"}


def test_colours_are_those_of_the_materials() -> None:
    plant = generate_plant("three_tomatoes")
    colours = organ_colours(plant)
    assert colours.shape == (len(plant.organs), 3)
    for fruit in plant.fruits:
        red, green, _ = colours[fruit.organ_index]
        assert (red > 2.0 * green) == (fruit.ripeness == "ripe")
    for organ, (red, green, blue) in zip(plant.organs, colours, strict=True):
        assert organ.name.startswith("fruit") or green > max(red, blue)


def test_scores_have_colours_from_dark_to_yellow() -> None:
    colours = score_colours(np.array([0.0, 0.5, 1.0], np.float32))
    assert colours.tolist() == [[68, 1, 84], [33, 145, 140], [253, 231, 37]]
    assert score_colours(np.array([2.0], np.float32)).shape == (1, 3)
    assert score_colours(np.zeros(0, np.float32)).shape == (0, 3)
