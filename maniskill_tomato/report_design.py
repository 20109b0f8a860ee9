"""How every report looks: one page in one file, light and dark, wide and narrow; tiles, tables, figures, films."""

import base64
import hashlib
import html
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

import maniskill_tomato
from maniskill_tomato.files import write_atomically

INK, MUTED, GRID, PAPER = "#1f2a24", "#6b7770", "#e3e7e2", "#fafaf7"
CARD, AXIS = "#ffffff", "#b9c2bb"
TOMATO, LEAF, STRAW, SKY, PLUM = "#c8402c", "#3f7d4e", "#c98a1b", "#3b6ea5", "#8a5aa5"
TEAL, BARK = "#3a8f8f", "#8c6d4f"
SERIES: Final = (TOMATO, SKY, LEAF, STRAW, PLUM, TEAL, BARK, MUTED)
"""Colours of lines that stay apart."""

LARGEST_PICTURE: Final = 160_000
"""A PNG file of more bytes is packed as JPEG where it is copied into a page and JPEG is smaller."""

LARGEST_FILM: Final = 6_000_000
"""A film of at most so many bytes is copied into the page; a larger one is linked."""

TEXT_PX_PER_PT: Final = 1.1
"""A plot is never shown smaller than so many pixels for each of its points: its texts of 8.5 pt have 9 px or more."""

LARGEST_PX_PER_PT: Final = 1.9
"""Nor larger than this, so that its title stays smaller than the page's headings."""

_THEMED: Final = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    CARD: "card",
    AXIS: "axis",
    TOMATO: "tomato",
    LEAF: "leaf",
    STRAW: "straw",
    SKY: "sky",
    PLUM: "plum",
    TEAL: "teal",
    BARK: "bark",
}
"""Colours of a plot that a page shows lighter on dark ground, with their variables."""

_STYLE: Final = """
:root {
  color-scheme: light dark;
  --ink: #1f2a24; --muted: #5f6b64; --paper: #fafaf7; --card: #ffffff; --line: #e1e6e0; --grid: #e3e7e2;
  --axis: #b9c2bb; --head: #1f2a24; --note: #fdf4e3; --note-line: #ecd9ae;
  --tomato: #c8402c; --leaf: #3f7d4e; --straw: #c98a1b; --sky: #3b6ea5; --plum: #8a5aa5; --teal: #3a8f8f;
  --bark: #8c6d4f; --link: #2f6b42; --shade: #1f2a2440;
}
@media (prefers-color-scheme: dark) {
  :root {
    --ink: #e4eae6; --muted: #9faba4; --paper: #141916; --card: #1c231f; --line: #313b35; --grid: #2b342f;
    --axis: #56625b; --head: #0d110f; --note: #2d2716; --note-line: #5b4c21;
    --tomato: #f0806b; --leaf: #7cc48e; --straw: #e6b75c; --sky: #7fb2e6; --plum: #c7a1de; --teal: #6cc4c4;
    --bark: #c9ab8c; --link: #8fd0a0; --shade: #000000b0;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
  overflow-wrap: break-word;
}
header { background: var(--head); color: #f4f6f2; border-bottom: 4px solid #c8402c; }
header div, main, footer { max-width: 1020px; margin: 0 auto; padding: 0 24px; }
header div { padding-top: 34px; padding-bottom: 28px; }
h1 { margin: 0; font-size: 30px; line-height: 1.2; letter-spacing: -0.01em; }
header p { margin: 8px 0 0; color: #c3cdc6; }
main { padding-bottom: 40px; }
section { margin-top: 38px; }
h2 { margin: 0 0 10px; font-size: 20px; }
p { margin: 0 0 14px; max-width: 72ch; }
main > p { margin-top: 26px; }
a { color: var(--link); }
code { font: 13px/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; user-select: all; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(205px, 1fr)); gap: 14px; }
.tile {
  background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 16px 18px;
  display: flex; flex-direction: column;
}
.tile b { font-size: 28px; line-height: 1.1; font-variant-numeric: tabular-nums; }
.tile:first-child b { color: var(--leaf); }
.tile span { margin: 6px 0 8px; font-weight: 600; line-height: 1.35; }
.tile small { color: var(--muted); }
.notice {
  background: var(--note); border: 1px solid var(--note-line); border-left: 5px solid #d9a441; border-radius: 8px;
  padding: 14px 18px;
}
figure {
  margin: 0 0 18px; background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 14px;
}
.scroll { overflow-x: auto; }
.card.scroll {
  background:
    linear-gradient(to right, var(--card) 40%, transparent) left / 36px 100% no-repeat local,
    linear-gradient(to left, var(--card) 40%, transparent) right / 36px 100% no-repeat local,
    linear-gradient(to right, var(--shade), transparent) left / 12px 100% no-repeat scroll,
    linear-gradient(to left, var(--shade), transparent) right / 12px 100% no-repeat scroll,
    var(--card);
}
.tall { max-height: 560px; overflow: auto; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 10px; margin-bottom: 14px; }
img, video, svg { display: block; width: 100%; height: auto; }
img, video { border-radius: 6px; }
figcaption, .caption { color: var(--muted); font-size: 14px; margin: 10px 2px 0; }
p.caption { margin-bottom: 16px; }
.pairs { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 380px), 1fr)); gap: 0 16px; }
.small { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(46%, 190px), 1fr)); gap: 0 12px; }
table { width: 100%; border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 9px 14px; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
tbody th { text-align: left; font-weight: 500; white-space: normal; min-width: 7em; }
thead th {
  color: var(--muted); font-weight: 600; font-size: 14px; min-width: 6.2em; vertical-align: bottom; white-space: normal;
}
thead th:first-child, .words { text-align: left; }
.dense th, .dense td { padding: 8px 7px; font-size: 14px; }
.dense thead th { font-size: 13px; min-width: 4em; }
.tall thead th { position: sticky; top: 0; background: var(--card); }
td.words, tbody th.words { white-space: normal; min-width: 15em; }
.listed th, .listed td { min-width: 0; }
.listed tr.above > * { border-bottom: 0; padding-bottom: 2px; }
tr.below td { padding-top: 0; text-align: left; white-space: normal; overflow-wrap: anywhere; }
tr.below span { display: inline-block; max-width: 100%; }
tr.below p { margin: 2px 0; max-width: none; }
tbody tr:last-child > * { border-bottom: 0; }
.bad { color: var(--tomato); font-weight: 600; }
.good { color: var(--leaf); font-weight: 600; }
details { margin-bottom: 12px; }
summary { cursor: pointer; font-weight: 600; padding: 6px 0; }
dl { display: grid; grid-template-columns: minmax(130px, max-content) 1fr; gap: 6px 22px; margin: 0; }
dt { color: var(--muted); }
dd { margin: 0; overflow-wrap: anywhere; }
footer { padding-top: 18px; padding-bottom: 34px; color: var(--muted); font-size: 14px; }
@media (max-width: 560px) {
  header div, main, footer { padding-left: 14px; padding-right: 14px; }
  h1 { font-size: 24px; }
  .tiles { grid-template-columns: 1fr; }
  figure { padding: 10px; }
  th, td { padding: 8px 8px; font-size: 15px; }
  thead th { min-width: 4.6em; }
  dl { grid-template-columns: 1fr; gap: 0; }
  dd { margin-bottom: 10px; }
}
@media print { .tall { max-height: none; } section { break-inside: avoid; } }
"""

_PAGE: Final = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<header><div><h1>{title}</h1><p>{subtitle}</p></div></header>
<main>
{body}
</main>
<footer>Written by maniskill-tomato {version}.</footer>
</body>
</html>
"""


@dataclass(frozen=True, kw_only=True)
class RowNotes:
    """What stands under a row of a table."""

    text: str = ""
    """A sentence."""
    command: str = ""
    """A command to copy."""


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue from 0 to 255 of a colour such as `#1f2a24`."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def page(title: str, subtitle: str, sections: Sequence[str], facts: Mapping[str, str]) -> str:
    """An HTML page that needs no other file.

    Args:
        title: As text.
        subtitle: As text.
        sections: HTML; empty ones are left out.
        facts: What the reader should know about the run, in order; see `run_facts.run_facts`.
    """
    about = "".join(
        f"<dt>{html.escape(name)}</dt><dd>{_fact(name, value)}</dd>" for name, value in facts.items()
    )
    every = [*sections, section("About this run", f"<dl>{about}</dl>")]
    return _PAGE.format(
        style=_STYLE,
        title=html.escape(title),
        subtitle=html.escape(subtitle),
        body="\n".join(part for part in every if part),
        version=html.escape(maniskill_tomato.__version__),
    )


def section(title: str, *parts: str) -> str:
    """A part of the page.

    Args:
        title: As text.
        parts: HTML.
    """
    return f"<section><h2>{html.escape(title)}</h2>{''.join(parts)}</section>"


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of text; `kind` may be `caption`."""
    attribute = f' class="{kind}"' if kind else ""
    return f"<p{attribute}>{html.escape(text)}</p>"


def notice(text: str | None) -> str:
    """A framed remark, or nothing."""
    return f'<section class="notice">{html.escape(text)}</section>' if text else ""


def figure(path: Path, caption: str) -> str:
    """A picture, copied into the page, with its caption below.

    A plot (SVG, or PNG with an SVG file beside it) takes the page's colours and keeps a size at which it can be read;
    on a phone it is scrolled where it is wider. Photos (PNG, JPEG) are as wide as the page.

    Args:
        path: The file.
        caption: As text: what is shown, its units, and of how many.
    """
    text = html.escape(caption)
    plot = path.with_suffix(".svg")
    if plot.is_file():
        return f"<figure>{_plot(plot, text)}<figcaption>{text}</figcaption></figure>"
    return photo(path.read_bytes(), caption)


def photo(content: bytes, caption: str, least_px: int = 0) -> str:
    """A picture that is no file, with its caption below.

    Args:
        content: Of a PNG or JPEG file.
        caption: As text.
        least_px: Width at which it can still be read, in [px]; where the page is narrower it is scrolled.
    """
    text = html.escape(caption)
    width = f' style="min-width: {least_px}px"' if least_px else ""
    shown = f'<img alt="{text}" src="{_picture_data(content)}"{width}>'
    if least_px:
        shown = f'<div class="scroll">{shown}</div>'
    return f"<figure>{shown}<figcaption>{text}</figcaption></figure>"


def pixels(picture: NDArray[np.uint8], caption: str, widest: int | None = None, least_px: int = 0) -> str:
    """A picture in memory, packed as JPEG, with its caption below.

    Args:
        picture: Red, green, blue. Shape (H, W, 3).
        caption: As text.
        widest: Pixels in a line from which on it is made smaller; None keeps its size.
        least_px: As for `photo`.
    """
    import cv2

    height, width = picture.shape[:2]
    if widest is not None and width > widest:
        size = widest, max(round(widest * height / width), 1)
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, packed = cv2.imencode(".jpg", picture[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 88))
    return photo(packed.tobytes(), caption, least_px)


def film(path: Path, poster: Path | None, caption: str, folder: Path) -> str:
    """A film with the picture that is shown before it plays.

    Args:
        path: MP4 file. It is copied into the page if it has at most `LARGEST_FILM` bytes, else linked.
        poster: A PNG or JPEG file.
        caption: As text.
        folder: Of the page.
    """
    link = html.escape(relative_path(path, folder))
    size = path.stat().st_size
    if size <= LARGEST_FILM:
        source = f"data:video/mp4;base64,{base64.b64encode(path.read_bytes()).decode()}"
        where = f"It is in this page, {size / 1e6:.1f} MB, and beside it as "
    else:
        source = link
        limit = LARGEST_FILM / 1e6
        where = f"It has {size / 1e6:.1f} MB; above {limit:.0f} MB it is not in this page but beside it: "
    shown = "" if poster is None else f' poster="{_picture_data(poster.read_bytes())}"'
    return (
        f'<figure><video controls preload="metadata"{shown} src="{source}"></video>'
        f'<figcaption>{html.escape(caption)} {html.escape(where)}<a href="{link}">{link}</a>.</figcaption></figure>'
    )


def relative_path(path: Path, folder: Path) -> str:
    """The way to a file from a page's folder, as text."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    words: Sequence[int] = (),
    below: Sequence[RowNotes] = (),
    tall: bool = False,
) -> str:
    """A table of texts whose first column names the rows; it is scrolled within its card where it is wide.

    Args:
        head: Names of the columns.
        rows: As many texts each.
        words: Columns with sentences, which may take several lines.
        below: What stands under each row, as wide as the table, in lines that wrap; empty if nothing does.
        tall: Whether a long table is scrolled within its card, too.
    """
    cells = "".join(
        f'<th scope="col"{" class=words" if column in words else ""}>{html.escape(text)}</th>'
        for column, text in enumerate(head)
    )
    notes = below or (RowNotes(),) * len(rows)
    body = "".join(_row(row, words, note) for row, note in zip(rows, notes, strict=True))
    kind = "card scroll" + " tall" * tall + " dense" * (len(head) >= 8) + " listed" * bool(below)
    return f'<div class="{kind}"><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>'


def _row(row: Sequence[str], words: Sequence[int], note: RowNotes) -> str:
    """A row of a table, and a second one where something stands under it."""

    def kind(column: int) -> str:
        return ' class="words"' if column in words else ""

    cells = "".join(
        f"<td{kind(column) if text else ''}>{html.escape(text)}</td>"
        for column, text in enumerate(row[1:], start=1)
    )
    text = f"<p>{html.escape(note.text)}</p>" if note.text else ""
    command = f"<p>{_wrapped_code(note.command)}</p>" if note.command else ""
    under = text + command
    more = f'<tr class="below"><td colspan="{len(row)}">{under}</td></tr>' if under else ""
    above = ' class="above"' if under else ""
    return f'<tr{above}><th scope="row"{kind(0)}>{html.escape(row[0])}</th>{cells}</tr>{more}'


def _wrapped_code(command: str) -> str:
    """A command whose lines end between words: browsers would also end them at the hyphens of options."""
    words = (
        f"<span>{html.escape(word)}</span>" if "-" in word else html.escape(word)
        for word in command.split(" ")
    )
    return f"<code>{' '.join(words)}</code>"


def folded(title: str, *parts: str, is_open: bool = False) -> str:
    """Parts that the reader unfolds; the title is text."""
    state = " open" if is_open else ""
    return f"<details{state}><summary>{html.escape(title)}</summary>{''.join(parts)}</details>"


def tiles(*cells: str) -> str:
    """A row of `tile`s, one below the other on a phone."""
    return f'<section class="tiles">{"".join(cells)}</section>'


def tile(value: str, label: str, *notes: str) -> str:
    """A large figure with its unit, what it is, and remarks below: of how many, and its interval."""
    small = "".join(f"<small>{html.escape(note)}</small>" for note in notes if note)
    return f'<div class="tile"><b>{html.escape(value)}</b><span>{html.escape(label)}</span>{small}</div>'


def side_by_side(*figures: str) -> str:
    """Figures two in a row, one below the other on a phone."""
    return f'<div class="pairs">{"".join(figures)}</div>' if figures else ""


def many_small(*figures: str) -> str:
    """Many small pictures, five in a row, two on a phone."""
    return f'<div class="small">{"".join(figures)}</div>' if figures else ""


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown, for the terminal and for files that people paste."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def report(out: Path, title: str, subtitle: str, sections: Sequence[str], facts: Mapping[str, str]) -> Path:
    """Writes `report.html` into a folder; arguments as for `page`.

    Raises:
        NotWrittenError: The file cannot be written.
    """
    path = out / "report.html"
    write_atomically(path, page(title, subtitle, sections, facts).encode())
    return path


def percent(value: float, decimals: int = 1) -> str:
    """A share as text, `97.5 %`."""
    return f"{100.0 * value:.{decimals}f} %"


def number(value: float | None, decimals: int) -> str:
    """A number as text, nothing where there is none."""
    return "" if value is None else f"{value:.{decimals}f}"


def _fact(name: str, value: str) -> str:
    escaped = html.escape(value)
    return f"<code>{escaped}</code>" if name == "command" else escaped


def _plot(path: Path, alt: str) -> str:
    """An SVG file as a part of the page: in its colours, with names of its own."""
    text = path.read_text(encoding="utf-8")
    text = text[text.index("<svg") :]
    # Names that the browser must not mix up with those of another plot of the page.
    own = f"p{hashlib.sha256(str(path).encode()).hexdigest()[:8]}-"
    text = re.sub(r'\bid="', f'id="{own}', text)
    text = re.sub(r'(href="#|url\(#)', rf"\g<1>{own}", text)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for colour, name in _THEMED.items():
        text = text.replace(f": {colour}", f": var(--{name})")
    match = re.search(r'width="([0-9.]+)pt"', text)
    assert match is not None
    least, most = (float(match[1]) * factor for factor in (TEXT_PX_PER_PT, LARGEST_PX_PER_PT))
    # The size comes from the page; what is left is the picture's shape.
    text = re.sub(r'(width|height)="[0-9.]+pt" ?', "", text, count=2)
    size = f"min-width: {least:.0f}px; max-width: {most:.0f}px"
    text = text.replace("<svg ", f'<svg role="img" aria-label="{alt}" style="{size}" ', 1)
    text = text.replace(' xmlns="http://www.w3.org/2000/svg"', "")
    text = re.sub(r' xmlns:xlink="[^"]*"', "", text).replace("xlink:href", "href")
    return f'<div class="scroll">{text}</div>'


def _picture_data(content: bytes) -> str:
    """A picture's file as the source of an image; large PNG files are packed as JPEG."""
    kind = "png" if content.startswith(b"\x89PNG") else "jpeg"
    if kind == "png" and len(content) > LARGEST_PICTURE:
        import cv2

        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        if picture is not None:
            ok, packed = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, 88))
            if ok and len(packed) < len(content):
                kind, content = "jpeg", packed.tobytes()
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
