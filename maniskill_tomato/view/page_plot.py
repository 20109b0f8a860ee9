"""V_f over the moves as a plot: of the episode, of the truth behind a camera, and of other policies."""

from typing import Final

import numpy as np
import viser
from viser import uplot

from maniskill_tomato import report_design as design
from maniskill_tomato.view.episode_recording import EpisodeRecording, Float64

BAND: Final = "rgba(200, 64, 44, 0.18)"
"""Colour of where V_f may lie, by a camera's own estimate of its error."""

Line = tuple[uplot.Series, Float64]


class FractionPlot:
    """The plot in a page's panel."""

    def __init__(self, gui: viser.GuiApi) -> None:
        """Adds it to the container that is open."""
        self._names: tuple[str, ...] = ("move", "V_f")
        self._plot = gui.add_uplot(
            (np.zeros(1), np.zeros(1)),
            (uplot.Series(label="move"), _line("V_f", design.TOMATO)),
            title="V_f over the moves",
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=False, range=(0.0, 1.0))},
            height=170,
        )

    def tell(self, recording: EpisodeRecording) -> None:
        """Draws a recording."""
        moves = max(recording.length, 1) + 1
        lines = curves(recording)
        names = ("move", *(str(series.get("label")) for series, _ in lines))
        if names != self._names:
            # A plot whose lines change is built anew in the browser.
            self._names = names
            self._plot.bands = None
            self._plot.data = (np.zeros(1),) * len(names)
            self._plot.series = (uplot.Series(label="move"), *(series for series, _ in lines))
            band = tuple(names.index(name) for name in ("at most", "at least") if name in names)
            self._plot.bands = (uplot.Band(series=(band[0], band[1]), fill=BAND),) if len(band) == 2 else None
        self._plot.data = (
            np.arange(moves, dtype=np.float64),
            *(np.pad(values, (0, moves - len(values)), constant_values=np.nan) for _, values in lines),
        )


def curves(recording: EpisodeRecording) -> list[Line]:
    """What is drawn over the moves, the last line being the threshold.

    Where a camera measures, V_f is its estimate; the task goes by the lower edge of the band about it.
    """
    lines: list[Line] = []
    snapshots = recording.snapshots
    if recording.ways:
        for way in recording.ways:
            red, green, blue = way.colour
            width = 3 if way.recording is recording else 1.5
            lines.append(
                (_line(way.label, f"rgb({red}, {green}, {blue})", width), way.recording.visible_fractions)
            )
    elif any(s.measured is not None for s in snapshots):
        bands = [(s.visible_fraction,) * 3 if s.measured is None else s.measured.band for s in snapshots]
        low, middle, high = (np.array(values) for values in zip(*bands, strict=True))
        lines += [
            (_edge("at most"), high),
            (_edge("at least"), low),
            (_line("V_f", design.TOMATO), middle),
        ]
    else:
        lines.append((_line("V_f", design.TOMATO), recording.visible_fractions))
    if any(s.true_visible_fraction is not None for s in snapshots):
        true = [np.nan if s.true_visible_fraction is None else s.true_visible_fraction for s in snapshots]
        lines.append((_line("truly", design.LEAF), np.array(true)))
    full = uplot.Series(
        label="full", stroke=design.MUTED, width=1, dash=(4.0, 4.0), points=uplot.Series_Points(show=False)
    )
    return [*lines, (full, np.full(max(recording.length, 1) + 1, recording.threshold))]


def _line(label: str, colour: str, width: float = 2) -> uplot.Series:
    return uplot.Series(label=label, stroke=colour, width=width, points=uplot.Series_Points(show=True))


def _edge(label: str) -> uplot.Series:
    """A line that only bounds a band."""
    return uplot.Series(label=label, width=0, stroke="transparent", points=uplot.Series_Points(show=False))
