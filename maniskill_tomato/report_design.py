"""How every report looks: colours, the style of plots, a page that needs no other file, tables."""

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import maniskill_tomato
from maniskill_tomato.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, MUTED, GRID, PAPER = "#1f2a24", "#6b7770", "#e3e7e2", "#fafaf7"
TOMATO, LEAF, STRAW, SKY, PLUM = "#c8402c", "#3f7d4e", "#d9a441", "#3b6ea5", "#8a5aa5"
SERIES: Final = (TOMATO, SKY, LEAF, STRAW, PLUM, "#4a9a9a", "#8c6d4f", MUTED)
"""Colours of lines that stay apart."""
TEN: Final = (
    "#1f77b4",
    "#ff7f0e",
    "#2ca02c",
    "#d62728",
    "#9467bd",
    "#8c564b",
    "#e377c2",
    "#7f7f7f",
    "#bcbd22",
    "#17becf",
)
"""Matplotlib's ten, for more lines than `SERIES` has."""

PLOT_STYLE: Final[Any] = {
    "axes.edgecolor": "#b9c2bb",
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.labelsize": 9,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "savefig.dpi": 150,
    "figure.constrained_layout.use": True,
}
"""For `matplotlib.rc_context`."""

_STYLE: Final = """
:root {
  --ink: #1f2a24; --muted: #5f6b64; --paper: #fafaf7; --card: #ffffff; --line: #e1e6e0;
  --tomato: #b8392a; --leaf: #2f6b42;
}
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
}
header { background: var(--ink); color: #f4f6f2; border-bottom: 4px solid var(--tomato); }
header div, main, footer { max-width: 980px; margin: 0 auto; padding: 0 24px; }
header div { padding-top: 34px; padding-bottom: 28px; }
h1 { margin: 0; font-size: 30px; line-height: 1.2; letter-spacing: -0.01em; }
header p { margin: 8px 0 0; color: #c3cdc6; }
main { padding-bottom: 40px; }
section { margin-top: 38px; }
h2 { margin: 0 0 10px; font-size: 20px; }
p { margin: 0 0 14px; max-width: 70ch; }
a { color: var(--leaf); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(205px, 1fr)); gap: 14px; }
.tile {
  background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 16px 18px;
  display: flex; flex-direction: column;
}
.tile b { font-size: 34px; line-height: 1.1; font-variant-numeric: tabular-nums; }
.tile:first-child b { color: var(--leaf); }
.tile span { margin: 6px 0 8px; font-weight: 600; line-height: 1.35; }
.tile small { color: var(--muted); }
.notice {
  background: #fdf4e3; border: 1px solid #ecd9ae; border-left: 5px solid #d9a441; border-radius: 8px; padding:
  14px 18px;
}
figure {
  margin: 0 0 18px; background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding:
  14px;
}
img, video { display: block; width: 100%; height: auto; border-radius: 6px; }
figcaption, .caption { color: var(--muted); font-size: 14px; margin: 10px 2px 0; }
.pairs { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 380px), 1fr)); gap: 0 16px; }
.scroll { overflow-x: auto; }
table {
  width: 100%; border-collapse: collapse; background: var(--card); border: 1px solid var(--line);
  font-variant-numeric: tabular-nums;
}
th, td { padding: 9px 14px; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
tbody th { text-align: left; font-weight: 500; white-space: normal; }
thead th { color: var(--muted); font-weight: 600; font-size: 14px; }
tbody tr:last-child > * { border-bottom: 0; }
dl { display: grid; grid-template-columns: minmax(130px, max-content) 1fr; gap: 6px 22px; margin: 0; }
dt { color: var(--muted); }
dd { margin: 0; overflow-wrap: anywhere; }
footer { padding-top: 18px; padding-bottom: 34px; color: var(--muted); font-size: 14px; }
@media (max-width: 560px) {
  h1 { font-size: 24px; }
  th, td { padding: 8px 8px; }
  dl { grid-template-columns: 1fr; gap: 0; }
  dd { margin-bottom: 10px; }
}
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


def save_figure(figure: "Figure", path: Path, dpi: float | None = None) -> None:
    """Writes a figure in the format that the file's name says, whole or not at all.

    Raises:
        NotWrittenError: The file cannot be written.
    """
    content = io.BytesIO()
    options: dict[str, Any] = {} if dpi is None else {"dpi": dpi}
    figure.savefig(content, format=path.suffix[1:], **options)
    write_atomically(path, content.getvalue())


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue from 0 to 255 of a colour such as `#1f2a24`."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def page(title: str, subtitle: str, sections: Sequence[str]) -> str:
    """An HTML page.

    Args:
        title: As text.
        subtitle: As text.
        sections: HTML; empty ones are left out.
    """
    return _PAGE.format(
        style=_STYLE,
        title=html.escape(title),
        subtitle=html.escape(subtitle),
        body="\n".join(section for section in sections if section),
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
    """A PNG or JPEG file, copied into the page, with its caption below."""
    kind = "jpeg" if path.suffix.lower() in (".jpg", ".jpeg") else "png"
    data = base64.b64encode(path.read_bytes()).decode()
    text = html.escape(caption)
    image = f'<img alt="{text}" src="data:image/{kind};base64,{data}">'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of texts whose first column names the rows."""
    cells = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join(
        f"<tr><th scope='row'>{html.escape(first)}</th>{''.join(f'<td>{html.escape(c)}</td>' for c in rest)}</tr>"
        for first, *rest in rows
    )
    return f"<div class='scroll'><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>"


def tile(value: str, label: str, *notes: str) -> str:
    """A large figure with what it is and remarks below."""
    small = "".join(f"<small>{html.escape(note)}</small>" for note in notes)
    return f'<div class="tile"><b>{html.escape(value)}</b><span>{html.escape(label)}</span>{small}</div>'


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The same as Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def percent(value: float, decimals: int = 1) -> str:
    """A share as text, `97.5 %`."""
    return f"{100.0 * value:.{decimals}f} %"


def number(value: float | None, decimals: int) -> str:
    """A number as text, nothing where there is none."""
    return "" if value is None else f"{value:.{decimals}f}"
