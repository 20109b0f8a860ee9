"""The design that every report uses: one file, light and dark, readable on a phone and without colour."""

import math
import re
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import imageio.v2 as imageio
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from playwright.sync_api import sync_playwright

import maniskill_tomato
from maniskill_tomato import report_design
from maniskill_tomato.experiments.episode_listing import ListedEpisode, episode_list
from maniskill_tomato.report_design import figure, film, page, photo, section, table, tile, tiles
from maniskill_tomato.report_plots import (
    MOST_LINES,
    PANEL,
    PLOT_STYLE,
    clipped_texts,
    label_ends,
    line_style,
    save_figure,
)
from maniskill_tomato.run_facts import commit, duration, run_facts, running_command

LONG = "view quality trained on varied plants, without the memory's free space"


class Elements(HTMLParser):
    """Every element with the classes of those around it."""

    VOID = frozenset({"meta", "img", "br", "link", "input", "use", "path", "image", "rect"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str], list[str]]] = []
        self._open: list[tuple[str, str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.found.append((tag, values, [kind for _, kinds in self._open for kind in kinds.split()]))
        if tag not in self.VOID:
            self._open.append((tag, values.get("class", "")))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append(
            (tag, {n: v or "" for n, v in attrs}, [k for _, ks in self._open for k in ks.split()])
        )

    def handle_endtag(self, tag: str) -> None:
        if any(name == tag for name, _ in self._open):
            while self._open.pop()[0] != tag:
                pass

    def all(self, tag: str) -> list[tuple[dict[str, str], list[str]]]:
        """Attributes of each element of a kind, and the classes around it."""
        return [(values, around) for name, values, around in self.found if name == tag]


def plot(path: Path, title: str = "Line", names: tuple[str, ...] = ("a", "b")) -> Path:
    with mpl.rc_context(PLOT_STYLE):
        canvas = Figure(figsize=PANEL)
        axes = canvas.subplots()
        for k in range(len(names)):
            axes.plot([0, 1, 2], [0, k, 2 * k], **line_style(k))
        axes.set(title=title, xlabel="moves", ylabel="V_f")
        label_ends(axes, {name: (2.0, 2.0 * k) for k, name in enumerate(names)})
        save_figure(canvas, path)
    return path


@pytest.fixture
def whole_page(tmp_path: Path) -> str:
    """A page with one of everything."""
    imageio.imwrite(
        tmp_path / "photo.png", np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    )
    (tmp_path / "film.mp4").write_bytes(b"film")
    head = ["row", *(f"column {k}" for k in range(12))]
    return page(
        "A <title>",
        "of & much",
        [
            tiles(tile("1.0 m", "way", "n = 3")),
            section(
                "Figures",
                figure(plot(tmp_path / "one.png"), "First & <plain>, n = 2"),
                figure(plot(tmp_path / "two.png"), "Second, n = 2"),
                figure(tmp_path / "photo.png", "A photo"),
                film(tmp_path / "film.mp4", tmp_path / "photo.png", "A film.", tmp_path),
                table(head, [["first", *("1" * 9 for _ in range(12))]]),
            ),
        ],
        {"command": "maniskill-tomato eval X --out 'a b'", "machine": "one"},
    )


def test_a_page_loads_no_other_file(whole_page: str) -> None:
    elements = Elements(whole_page)
    for _, values, _ in elements.found:
        for name in ("src", "poster", "data", "srcset", "xlink:href"):
            assert values.get(name, "data:").startswith("data:")
    assert not [1 for tag in ("link", "script", "iframe", "object", "embed") if elements.all(tag)]
    assert not re.search(r"@import|url\((?!#)", whole_page)
    assert "http://" not in whole_page.replace("http://www.w3.org/", "") and "https://" not in whole_page
    assert len(elements.all("img")) == 1 and len(elements.all("video")) == 1 and len(elements.all("svg")) == 2


def test_names_within_plots_are_unique_and_all_found(whole_page: str) -> None:
    names = [values["id"] for _, values, _ in Elements(whole_page).found if "id" in values]
    assert len(names) == len(set(names)) and len(names) > 20
    used = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', whole_page))
    assert {a or b for a, b in used} <= set(names)


def test_a_plot_takes_the_page_s_colours_so_that_it_is_seen_on_dark_ground(whole_page: str) -> None:
    drawn = "".join(re.findall(r"<svg.*?</svg>", whole_page, flags=re.DOTALL))
    assert not re.search(r"(fill|stroke): ?#", drawn)
    used = set(re.findall(r"var\(--([a-z-]+)\)", drawn))
    assert {"ink", "card", "tomato", "sky"} <= used
    light, dark = re.findall(r":root \{(.*?)\}", whole_page, flags=re.DOTALL)
    for theme in (light, dark):
        values = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6})", theme))
        assert used <= set(values)
        for name in used - {"card", "grid", "axis"}:
            assert contrast(values[name], values["card"]) >= 3.0 - 0.35 * (name == "straw"), name


def contrast(one: str, other: str) -> float:
    """The contrast of two colours after WCAG 2."""

    def luminance(colour: str) -> float:
        parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_nothing_is_wider_than_a_phone_unless_it_scrolls_by_itself(whole_page: str, tmp_path: Path) -> None:
    elements = Elements(whole_page)
    assert ("viewport", "width=device-width, initial-scale=1") in [
        (values.get("name"), values.get("content")) for values, _ in elements.all("meta")
    ]
    for tag in ("svg", "table"):
        assert elements.all(tag) and all("scroll" in around for _, around in elements.all(tag))
    assert re.search(r"\.scroll \{ overflow-x: auto; \}", whole_page)
    assert re.search(r"img, video, svg \{[^}]*width: 100%", whole_page)
    for values, _ in elements.all("svg"):
        match = re.fullmatch(r"min-width: (\d+)px; max-width: (\d+)px", values["style"])
        assert match is not None
        least, most = float(match[1]), float(match[2])
        # Texts of 8.5 pt; a phone of 390 px leaves 340 px to what is in a figure.
        assert least / (PANEL[0] * 72.0) * 8.5 >= 9.0 and least <= 340
        # Titles of 10.5 pt; the page's own headings have 20 px.
        assert most / (PANEL[0] * 72.0) * 10.5 <= 20.0


@pytest.mark.browser
@pytest.mark.parametrize("width", [390, 1400])
def test_a_list_of_episodes_is_whole_on_a_phone_and_its_commands_can_be_copied(
    chromium: str, width: int, tmp_path: Path
) -> None:
    command = (
        "maniskill-tomato eval TomatoViewpoint-v1 --policy runs/a-long-name-of-a-folder/training/policy.pt --seed 1 "
        "--episodes 1 --no-baseline --out 'runs/again & again-1' --plant-pose 0.8 0.1 0.5"
    )
    listed = [
        ListedEpisode(
            seed=k,
            success=bool(k),
            reason="" if k else "the camera never detected the target, 11 moves with the arm in the plant",
            moves=20,
            start=0.25,
            best=0.75,
            command=command,
        )
        for k in range(3)
    ]
    (tmp_path / "report.html").write_text(page("A list", "", [episode_list(listed)], {}))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=("--no-sandbox",))
        view = browser.new_page(viewport={"width": width, "height": 900})
        view.goto((tmp_path / "report.html").as_uri())
        assert view.evaluate("document.documentElement.scrollWidth") == width
        card = view.locator(".card")
        assert card.evaluate("card => card.scrollWidth - card.clientWidth") == 0
        box = card.bounding_box()
        assert box is not None
        for cell in view.locator(".card th, .card td, .card p, .card code").all():
            part = cell.bounding_box()
            assert part is not None and part["width"] > 0.0
            assert box["x"] <= part["x"] and part["x"] + part["width"] <= box["x"] + box["width"]
        copied = view.locator("code").first.evaluate(
            "code => { const s = getSelection(); s.selectAllChildren(code); return s.toString(); }"
        )
        browser.close()
    assert copied == command


def test_texts_are_shown_as_they_are(whole_page: str) -> None:
    assert (
        "A &lt;title&gt;" in whole_page
        and "of &amp; much" in whole_page
        and "First &amp; &lt;plain&gt;" in whole_page
    )
    assert "<code>maniskill-tomato eval X --out &#x27;a b&#x27;</code>" in whole_page


def test_a_large_film_is_linked_and_the_page_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(b"x" * 1000)
    monkeypatch.setattr(report_design, "LARGEST_FILM", 1000)
    assert 'src="data:video/mp4;base64,' in film(path, None, "A film.", tmp_path)
    monkeypatch.setattr(report_design, "LARGEST_FILM", 999)
    linked = film(path, None, "A film.", tmp_path)
    assert 'src="film.mp4"' in linked and "not in this page but beside it" in linked


def test_large_photos_are_packed_and_small_pictures_are_kept(tmp_path: Path) -> None:
    y, x = np.mgrid[0:480, 0:640]
    noise = np.random.default_rng(0).normal(0, 6, (480, 640, 3))
    pixels = np.clip(np.stack([x / 3, y / 2, (x + y) / 5], axis=-1) + noise, 0, 255).astype(np.uint8)
    imageio.imwrite(tmp_path / "photo.png", pixels)
    imageio.imwrite(tmp_path / "small.png", pixels[:40, :40])
    large = (tmp_path / "photo.png").stat().st_size
    packed = figure(tmp_path / "photo.png", "")
    assert "data:image/jpeg" in packed and len(packed) < large / 2
    assert "data:image/png" in figure(tmp_path / "small.png", "")
    ((drawing, around),) = Elements(photo((tmp_path / "small.png").read_bytes(), "A drawing", 760)).all("img")
    assert drawing["style"] == "min-width: 760px" and "scroll" in around


def test_lines_are_told_apart_without_colour() -> None:
    looks = {(str(line_style(k)["linestyle"]), line_style(k)["marker"]) for k in range(MOST_LINES)}
    dashes, markers = zip(*looks, strict=True)
    assert len(set(dashes)) == len(set(markers)) == MOST_LINES
    assert len({line_style(k)["color"] for k in range(MOST_LINES)}) == MOST_LINES


def test_names_at_the_ends_of_lines_are_whole_and_apart() -> None:
    names = [f"{LONG} {k}" for k in range(5)] + ["nbv", "a_name_of_one_long_word_without_any_break"]
    with mpl.rc_context(PLOT_STYLE):
        canvas = Figure(figsize=(4.4, 6.0))
        axes = canvas.subplots()
        axes.set(xlim=(0, 10), ylim=(0, 1.04), title="T", xlabel="x", ylabel="y")
        # All ends at nearly the same place, at the top.
        label_ends(axes, {name: (10.0, 0.97 + 0.001 * k) for k, name in enumerate(names)})
        assert clipped_texts(canvas) == []
        canvas.draw_without_rendering()
        boxes = sorted((Text.get_window_extent(text) for text in axes.texts), key=lambda box: box.y0)
    assert len(boxes) == len(names)
    assert all(low.y1 <= high.y0 + 1.0 for low, high in zip(boxes[:-1], boxes[1:], strict=True))
    assert {re.sub(r"\s", "", t.get_text()) for t in axes.texts} == {re.sub(r"\s", "", n) for n in names}


def test_a_text_over_the_edge_is_found() -> None:
    canvas = Figure(figsize=(2.0, 1.0))
    canvas.text(0.5, 0.5, "much too long for a figure this small, by far")
    canvas.text(0.1, 0.1, "ok")
    assert clipped_texts(canvas) == ["much too long for a figure this small, by far"]


def test_a_report_says_how_it_came_about() -> None:
    with running_command(["maniskill-tomato", "eval", "Task", "--out", "my runs"]):
        facts = run_facts()
    assert facts["command"] == "maniskill-tomato eval Task --out 'my runs'"
    assert maniskill_tomato.__version__ in facts["package"]
    assert re.search(r"cores.*GB of memory.*GPU", facts["machine"])
    assert "Python 3." in facts["software"] and "torch 2" in facts["software"]
    assert re.match(r"20\d\d-\d\d-\d\d \d\d:\d\d", facts["date"])
    assert facts["duration"].startswith("0.")
    assert "duration" not in run_facts() and run_facts(3725.0)["duration"].startswith("1 h 02 min")
    assert run_facts()["command"] != facts["command"]


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.04, "0.0 s"), (59.94, "59.9 s"), (125.4, "2 min 05 s"), (7380.0, "2 h 03 min")]
)
def test_times_are_told_in_words(seconds: float, text: str) -> None:
    assert duration(seconds) == text and math.isfinite(seconds)


def test_the_commit_is_that_of_the_checkout_and_says_whether_it_is_clean(tmp_path: Path) -> None:
    inside = tmp_path / "checkout" / "package"
    inside.mkdir(parents=True)

    def git(*words: str) -> str:
        identity = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
        done = subprocess.run(
            ("git", "-C", str(inside), *identity, *words), check=True, capture_output=True, text=True
        )
        return done.stdout.strip()

    assert commit(inside) is None
    git("init", "-q")
    (inside / "code.py").write_text("1\n")
    assert commit(inside) is None  # Installed into someone's checkout, not a part of it.
    git("add", ".")
    git("commit", "-q", "-m", "first")
    head = git("rev-parse", "--short=12", "HEAD")
    (inside / "untracked.txt").write_text("notes")
    assert commit(inside) == f"{head}, clean"
    (inside / "code.py").write_text("2\n")
    assert commit(inside) == f"{head}, with changes in 1 file"


def test_a_plot_that_is_drawn_again_is_the_same_file(tmp_path: Path) -> None:
    contents = []
    for folder in (tmp_path / "first", tmp_path / "second"):
        folder.mkdir()
        figure = Figure()
        figure.subplots().plot([1, 2, 3], marker="o", label="line")
        save_figure(figure, folder / "plot.png")
        contents.append((folder / "plot.svg").read_bytes())
    assert contents[0] == contents[1] and b"<dc:date>" not in contents[0]
