"""The page in a real browser: a click changes the scene, and nothing goes wrong in the console."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import ConsoleMessage, Page, sync_playwright
from scipy.spatial.transform import Rotation
from viser import ClientHandle

from maniskill_tomato.view.page import PlayPage
from maniskill_tomato.view.page_export import page_of
from maniskill_tomato.view.page_scene import first_view
from maniskill_tomato.view.play_session import PlaySession
from maniskill_tomato.view.play_settings import PlaySettings
from maniskill_tomato.view.player import Player
from maniskill_tomato.view.record_session import RecordSession

pytestmark = pytest.mark.browser

FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
"""Without a graphics card Chromium draws WebGL only if it is told to."""

PATIENCE_MS = 120_000

ATTEMPTS = 6
"""Times that a handle is grasped for."""


@pytest.fixture
def browser_page(chromium: str) -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport={"width": 480, "height": 400})
        page.set_default_timeout(PATIENCE_MS)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.append(line.text) if is_fault(line) else None)
        yield page
        browser.close()
        assert errors == []


def is_fault(line: ConsoleMessage) -> bool:
    """Whether a line of the console tells of a fault; viser replaces the addresses of pictures while they load."""
    return line.type == "error" and not line.location["url"].startswith("blob:")


def wait_for(page: Page, condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_MS / 1000.0
    while not condition():
        assert time.monotonic() < end
        page.wait_for_timeout(50)


def test_a_click_on_step_makes_a_move_and_reset_takes_it_back(browser_page: Page) -> None:
    player = Player(PlaySession, PlaySettings(env_id="TomatoViewpointGuided-v1", policy="random", seed=2))
    served = PlayPage(player, port=0)
    try:
        browser_page.goto(served.url)
        browser_page.get_by_text("at move 0").wait_for()
        wait_for(browser_page, lambda: len(served.server.get_clients()) == 1)
        (client,) = served.server.get_clients().values()
        before = client.get_render(120, 160)
        assert np.std(before) > 5.0
        browser_page.get_by_role("button", name="Step").click()
        browser_page.get_by_text("at move 1").wait_for()
        assert player.recording.moves == player.shown == 1
        after = client.get_render(120, 160)
        assert np.mean(np.abs(after.astype(float) - before)) > 0.5
        browser_page.get_by_role("button", name="Reset").click()
        browser_page.get_by_text("at move 0").wait_for()
        assert player.recording.moves == player.shown == 0
    finally:
        served.close()


def test_an_exported_page_runs_by_itself(browser_page: Page) -> None:
    session = PlaySession(PlaySettings(env_id="TomatoViewpointGuided-v1", policy="random", seed=2))
    session.step()
    requests: list[str] = []
    browser_page.on("request", lambda request: requests.append(request.url))
    browser_page.set_content(page_of(session.recording))
    wait_for(browser_page, lambda: browser_page.locator("canvas").count() > 0)
    first = browser_page.screenshot()
    wait_for(browser_page, lambda: browser_page.screenshot() != first)
    assert [url for url in requests if url.startswith("http")] == []


def test_on_a_phone_most_of_the_page_is_scene_and_the_panel_can_be_worked(browser_page: Page) -> None:
    player = Player(PlaySession, PlaySettings(env_id="TomatoViewpointGuided-v1", policy="random", seed=2))
    served = PlayPage(player, port=0)
    try:
        width, height = 390, 844
        browser_page.set_viewport_size({"width": width, "height": height})
        browser_page.goto(served.url)
        browser_page.get_by_text("at move 0").wait_for()
        # The sheet's own title is its upper end; the sheet slides down to it.
        title = browser_page.get_by_text("maniskill-tomato", exact=True)
        wait_for(browser_page, lambda: (box := title.bounding_box()) is not None and box["y"] > 0.65 * height)
        for name in ("Play", "Step", "Reset"):
            button = browser_page.get_by_role("button", name=name, exact=True).bounding_box()
            assert button is not None and button["y"] + button["height"] < height
            assert 0 <= button["x"] and button["x"] + button["width"] <= width
        browser_page.get_by_role("button", name="Step").click()
        browser_page.get_by_text("at move 1").wait_for()
        browser_page.get_by_role("button", name="Expand panel Moves").click()
        browser_page.get_by_role("tab", name="Episode").click()
        browser_page.get_by_role("button", name="next").click()
        browser_page.get_by_text("seed 3").wait_for()
        assert player.settings.seed == 3
        (client,) = served.server.get_clients().values()
        place, at = first_view(player.recording)
        wait_for(browser_page, lambda: distance(client.camera.position, at) > 1.2 * distance(place, at))
    finally:
        served.close()


def test_dragging_the_target_by_its_handle_changes_the_fraction(
    browser_page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    player = Player(PlaySession, PlaySettings(env_id="TomatoViewpointGuided-v1", policy="random", seed=2))
    left: list[NDArray[np.float64] | None] = []
    drop = player.drop_target

    def told() -> None:
        left.append(player.target_place())
        drop()

    monkeypatch.setattr(player, "drop_target", told)
    served = PlayPage(player, port=0)
    try:
        browser_page.set_viewport_size({"width": 900, "height": 700})
        browser_page.goto(served.url)
        browser_page.get_by_text("at move 0").wait_for()
        browser_page.get_by_role("tab", name="Hand").click()
        browser_page.get_by_text("Drag the target").click()
        wait_for(browser_page, lambda: served.server.scene.get_handle_by_name("/target_handle") is not None)
        before, fraction = player.target_place(), player.recording.snapshots[0].visible_fraction
        assert before is not None
        (client,) = served.server.get_clients().values()
        # A browser tells of its own place before it takes that of the page, and of its width before it has the panel.
        stand, _ = first_view(player.recording)
        wait_for(browser_page, lambda: distance(client.camera.position, stand) < 0.01)
        wait_for(browser_page, lambda: client.camera.image_width < 900)
        for _ in range(ATTEMPTS):
            # A slow browser draws the handle late, and who misses it turns the scene.
            browser_page.wait_for_timeout(5000)
            grip, further = (on_screen(client, before + [0.0, 0.0, up]) for up in (0.06, 0.21))
            browser_page.mouse.move(grip[0] - 3, grip[1])
            browser_page.wait_for_timeout(500)
            browser_page.mouse.move(*grip)
            browser_page.wait_for_timeout(1500)
            browser_page.mouse.down()
            browser_page.wait_for_timeout(500)
            browser_page.mouse.move(*further, steps=5)
            browser_page.wait_for_timeout(1500)
            browser_page.mouse.up()
            browser_page.wait_for_timeout(1500)
            place = player.target_place()
            assert place is not None
            if place[2] > before[2] + 0.05:
                break
        place = player.target_place()
        assert place is not None and place[2] > before[2] + 0.05
        assert abs(player.recording.snapshots[0].visible_fraction - fraction) > 0.02
        np.testing.assert_allclose(place[:2], before[:2], atol=1e-3)
        # Where the target is left, the policy decides anew.
        wait_for(browser_page, lambda: bool(left))
        np.testing.assert_allclose(np.array(left[-1]), place)
    finally:
        served.close()


def on_screen(client: ClientHandle, place: NDArray[np.float64]) -> tuple[float, float]:
    """Where a place of the world is seen in a browser, in [px]."""
    camera = client.camera
    rotation = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix()
    x, y, z = rotation.T @ (place - camera.position)
    focal = 0.5 * camera.image_height / np.tan(0.5 * camera.fov)
    return float(0.5 * camera.image_width + focal * x / z), float(0.5 * camera.image_height + focal * y / z)


def test_a_click_on_next_shows_the_next_failure_of_a_record(browser_page: Page, record_folder: Path) -> None:
    session = RecordSession(record_folder)
    first, second = session.failures("random_step")
    served = PlayPage(Player.over(session), port=0, record=session)
    try:
        browser_page.set_viewport_size({"width": 800, "height": 700})
        browser_page.goto(served.url)
        browser_page.get_by_text(f"episode {first}, random_step").wait_for()
        assert browser_page.get_by_role("img", name="What the camera of nbv sees").is_visible()
        browser_page.get_by_role("button", name="next").click()
        browser_page.get_by_text(f"episode {second}, random_step").wait_for()
        assert session.seed == second
    finally:
        served.close()


def distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(a - b))
