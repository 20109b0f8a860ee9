"""How every plot looks: one style, lines that are told apart without colour, names at the ends of lines."""

import io
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from maniskill_tomato.files import write_atomically
from maniskill_tomato.report_design import AXIS, CARD, GRID, INK, MUTED, SERIES, SKY

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLOT_STYLE: Final[Any] = {
    "axes.edgecolor": AXIS,
    "axes.facecolor": CARD,
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
    "figure.facecolor": CARD,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.markersize": 4.5,
    "savefig.dpi": 150,
    "figure.constrained_layout.use": True,
}
"""For `matplotlib.rc_context`."""

PANEL: Final = (4.25, 3.2)
"""Width and height of a plot that a phone shows as a whole, in [in]."""

WIDE: Final = (9.0, 3.1)
"""Of one that fills the page and that a phone scrolls, in [in]."""

LABEL_SIZE: Final = 8.5
"""Of names at the ends of lines, in [pt]."""

LABEL_WIDTH: Final = 18
"""Characters of a line of such a name."""

MOST_LINES: Final = 8
"""Lines in a plot; where there are more, the best are drawn, and the table names all."""

_DASHES: Final[tuple[Any, ...]] = (
    "-",
    (0, (5, 2)),
    (0, (1.2, 1.4)),
    (0, (6, 2, 1.2, 2)),
    (0, (2.6, 1.4)),
    (0, (9, 2.5)),
    (0, (6, 1.5, 1.2, 1.5, 1.2, 1.5)),
    (0, (1.2, 3)),
)
_MARKERS: Final = "os^DvPX*"


def line_style(index: int, points: int = 0) -> dict[str, Any]:
    """Colour, dashes and marker of a line, none of them used twice among the first `MOST_LINES`.

    Args:
        index: Of the line.
        points: How many it has, so that about five of them are marked; 0 marks each.
    """
    style = {
        "color": SERIES[index % len(SERIES)],
        "linestyle": _DASHES[index % len(_DASHES)],
        "marker": _MARKERS[index % len(_MARKERS)],
        "linewidth": 1.6,
        "markeredgecolor": CARD,
        "markeredgewidth": 0.6,
    }
    if points > 8:
        every = max(points // 5, 1)
        style["markevery"] = (index * every // MOST_LINES, every)
    return style


def label_ends(
    axes: "Axes", ends: Mapping[str, tuple[float, float]], colours: Sequence[str] = SERIES
) -> None:
    """Writes the name of each line beside its last point, names kept apart, with a thin line to the point.

    Args:
        axes: With its final limits.
        ends: The last point of each line by its name, in the order of the lines.
        colours: Of the lines.
    """
    import matplotlib as mpl

    if not ends:
        return
    figure: Any = axes.figure
    # The layout says how high the axes are, and with that how far apart names must be.
    figure.draw_without_rendering()
    height = axes.get_window_extent().height / figure.dpi * 72.0
    low, high = axes.get_ylim()
    texts = {name: _wrapped(name) for name in ends}
    order = sorted(ends, key=lambda name: ends[name][1])
    sizes = [_label_height(texts[name]) for name in order]
    wanted = [(ends[name][1] - low) / (high - low) * height for name in order]
    places = dict(zip(order, _spread(wanted, sizes, height), strict=True))
    right = axes.get_xlim()[1]
    for index, (name, (x, y)) in enumerate(ends.items()):
        colour = colours[index % len(colours)]
        axes.annotate(
            texts[name],
            xy=(min(x, right), y),
            xytext=(1.0 + 12.0 / (axes.get_window_extent().width / figure.dpi * 72.0), places[name] / height),
            textcoords="axes fraction",
            va="center",
            ha="left",
            fontsize=LABEL_SIZE,
            color=mpl.rcParams["text.color"],
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": colour,
                "linewidth": 0.8,
                "shrinkA": 1.0,
                "shrinkB": 0.0,
                "relpos": (0.0, 0.5),
            },
        )


def panel_size(names: Iterable[str]) -> tuple[float, float]:
    """`PANEL`, or as high as the names at the ends of its lines need, in [in]."""
    return PANEL[0], max(PANEL[1], sum(_label_height(_wrapped(name)) for name in names) / 72.0 + 1.0)


def plot_intervals(
    values: Mapping[str, tuple[float, float, float] | float],
    title: str,
    label: str,
    path: Path,
    limits: tuple[float | None, float | None] = (None, None),
) -> None:
    """Values side by side, a line each: a point with its number, and its interval where there is one.

    Args:
        values: The value, or the value with both ends of its interval, by name.
        title: Above them.
        label: Of the axis, with its unit.
        path: The picture to write.
        limits: Of the axis; None fits the values.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    names = {name: textwrap.fill(name, 24, break_long_words=True) for name in values}
    heights = [max(_label_height(text), 22.0) for text in names.values()]
    middles = [sum(heights[:k]) + height / 2 for k, height in enumerate(heights)]
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(PANEL[0], sum(heights) / 72.0 + 1.0))
        axes = figure.subplots()
        for value, y in zip(values.values(), middles, strict=True):
            middle, low, high = value if isinstance(value, tuple) else (value, value, value)
            axes.plot([low, high], [y, y], color=SKY, linewidth=2.4, alpha=0.6, solid_capstyle="round")
            axes.plot([middle], [y], marker="o", color=SKY, markersize=6.0)
            axes.annotate(
                f"{middle:.3g}",
                (high, y),
                xytext=(6, 0),
                textcoords="offset points",
                va="center",
                fontsize=8.5,
            )
        axes.set_yticks(middles, list(names.values()))
        axes.tick_params(axis="y", labelcolor=INK, length=0)
        axes.set_ylim(sum(heights), 0.0)
        axes.set_xlim(*limits)
        low, high = axes.get_xlim()
        ticks = [tick for tick in axes.get_xticks() if low <= tick <= high]
        # Room for the numbers.
        axes.set_xlim(low, high + 0.16 * (high - low))
        axes.set_xticks(ticks)
        axes.grid(False, axis="y")
        axes.set_title(title, loc="left")
        axes.set_xlabel(label)
        save_figure(figure, path)


def _wrapped(name: str) -> str:
    return textwrap.fill(name, LABEL_WIDTH, break_long_words=True)


def _label_height(text: str) -> float:
    """Of a name with a little air, in [pt]."""
    return LABEL_SIZE * (1.3 * (text.count("\n") + 1) + 0.2)


def _spread(wanted: Sequence[float], sizes: Sequence[float], height: float) -> list[float]:
    """Centres as near to the wanted ones as they can be without overlap, rising; within 0 and `height` if they fit.

    Args:
        wanted: Rising, in [pt].
        sizes: Of each, in [pt].
        height: Of the axes, in [pt].
    """
    groups: list[tuple[list[int], float]] = []
    """Names that touch each other, with the lower edge of the stack."""
    for index in range(len(wanted)):
        members, bottom = [index], wanted[index] - sizes[index] / 2
        while groups:
            before, edge = groups[-1]
            top = edge + sum(sizes[i] for i in before)
            if top <= bottom:
                break
            groups.pop()
            members = before + members
            # The stack whose members are off their wanted places by nothing in the mean.
            offset, off = 0.0, []
            for i in members:
                off.append(wanted[i] - sizes[i] / 2 - offset)
                offset += sizes[i]
            bottom = sum(off) / len(off)
        groups.append((members, bottom))
    places = [0.0] * len(wanted)
    for members, bottom in groups:
        for i in members:
            places[i] = bottom
            bottom += sizes[i]
    # From the top down, then from the bottom up, so that too many names stick out above only.
    ceiling = height + LABEL_SIZE
    for i in reversed(range(len(places))):
        places[i] = min(places[i], ceiling - sizes[i])
        ceiling = places[i]
    floor = -LABEL_SIZE
    for i in range(len(places)):
        places[i] = max(places[i], floor)
        floor = places[i] + sizes[i]
    return [place + size / 2 for place, size in zip(places, sizes, strict=True)]


def clipped_texts(figure: "Figure") -> list[str]:
    """The texts of a figure that reach over its edges, which would be cut."""
    from matplotlib.text import Text

    figure.draw_without_rendering()
    width, height = figure.bbox.width, figure.bbox.height
    # Numbers of ticks beyond the limits exist, but are not drawn.
    undrawn = set()
    for axes in figure.axes:
        for axis in axes._axis_map.values():
            low, high = sorted(axis.get_view_interval())
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                if not low <= tick.get_loc() <= high:
                    undrawn |= {tick.label1, tick.label2}
    cut = []
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if not text.get_visible() or not text.get_text().strip() or text in undrawn:
            continue
        box = Text.get_window_extent(text)  # Of an annotation without its line.
        if box.x0 < -1 or box.y0 < -1 or box.x1 > width + 1 or box.y1 > height + 1:
            cut.append(text.get_text())
    return cut


def save_figure(figure: "Figure", path: Path, dpi: float | None = None) -> None:
    """Writes a figure in the format that the file's name says, whole or not at all.

    A plot, which is a PNG file without a resolution of its own, is written as SVG beside it, too: pages show that.

    Raises:
        NotWrittenError: A file cannot be written.
    """
    import matplotlib as mpl

    paths = [path, path.with_suffix(".svg")] if path.suffix == ".png" and dpi is None else [path]
    for each in paths:
        content = io.BytesIO()
        options: dict[str, Any] = {} if dpi is None else {"dpi": dpi}
        if each.suffix == ".svg":
            options["metadata"] = {"Date": None}
        # Names drawn at random and the date would make every file another one.
        with mpl.rc_context({"svg.hashsalt": each.stem}):
            figure.savefig(content, format=each.suffix[1:], **options)
        write_atomically(each, content.getvalue())
