"""Draws the diagrams of docs/how_it_works.md as SVG: boxes, arrows and words, on a light ground in any theme."""

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).resolve().parent.parent / "docs" / "images"

INK, SOFT, LINE = "#1f2933", "#52606d", "#9aa5b1"
GREEN, RED, BLUE, SAND, GREY = "#d8efd3", "#f9d9d0", "#d6e6f7", "#fbf1d3", "#eef1f4"


class Drawing:
    """An SVG of a fixed size; coordinates in px, y down."""

    def __init__(self, width: int, height: int, title: str) -> None:
        """Begins with a white panel.

        Args:
            width: In [px].
            height: In [px].
            title: What the picture shows, for those who do not see it.
        """
        self._parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
            'role="img" font-family="system-ui, sans-serif">',
            f"<title>{escape(title)}</title>",
            '<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
            f'orient="auto-start-reverse"><path d="M0 0L10 5L0 10z" fill="{SOFT}"/></marker></defs>',
            f'<rect width="{width}" height="{height}" rx="10" fill="#ffffff"/>',
        ]

    def box(
        self, x: float, y: float, width: float, height: float, fill: str, words: str, below: str = ""
    ) -> None:
        """A box with a bold line and smaller ones under it, split at `|`."""
        self.shape(
            f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="7" fill="{fill}" stroke="{LINE}"/>'
        )
        lines = below.split("|") if below else []
        top = y + height / 2 - 8.5 * len(lines)
        self.text(x + width / 2, top + 5, words, size=15, weight=600)
        for k, line in enumerate(lines):
            self.text(x + width / 2, top + 24 + 17 * k, line, size=12.5, fill=SOFT)

    def text(
        self,
        x: float,
        y: float,
        words: str,
        *,
        size: float = 13,
        weight: int = 400,
        fill: str = INK,
        anchor: str = "middle",
    ) -> None:
        """A line of text on its base line."""
        self.shape(
            f'<text x="{x:g}" y="{y:g}" font-size="{size:g}" font-weight="{weight}" fill="{fill}" '
            f'text-anchor="{anchor}">{escape(words)}</text>'
        )

    def arrow(self, *points: tuple[float, float], dashed: bool = False) -> None:
        """A line through points with a tip at its end."""
        way = " ".join(f"{x:g},{y:g}" for x, y in points)
        dash = ' stroke-dasharray="5 4"' if dashed else ""
        self.shape(
            f'<polyline points="{way}" fill="none" stroke="{SOFT}" stroke-width="1.6"{dash} marker-end="url(#tip)"/>'
        )

    def shape(self, markup: str) -> None:
        """Anything else."""
        self._parts.append(markup)

    def __str__(self) -> str:
        return "\n".join([*self._parts, "</svg>", ""])


def visible_fraction() -> Drawing:
    """What V_f is: the share of the tomato's silhouette that the camera sees."""
    d = Drawing(
        880, 300, "A camera sees half of a tomato because a leaf hides the rest; from above it sees all of it"
    )
    for left, camera, share, words in (
        (0, (70, 190), "V_f = 0.5", "before the move: a leaf hides half"),
        (440, (110, 62), "V_f = 1", "after the move: fully visible, done"),
    ):
        x, y = left + camera[0], camera[1]
        fruit_x, fruit_y = left + 285, 150
        d.shape(
            f'<path d="M{x} {y}L{fruit_x} {fruit_y - 44}L{fruit_x} {fruit_y + 44}z" fill="{BLUE}" opacity="0.8"/>'
        )
        d.shape(f'<circle cx="{fruit_x}" cy="{fruit_y}" r="44" fill="#d64933" stroke="#8f2d1f"/>')
        leaf_x = left + 175
        d.shape(
            f'<path d="M{leaf_x - 8} 265C{leaf_x - 46} 222 {leaf_x - 26} 182 {leaf_x + 16} 162'
            f'C{leaf_x + 34} 206 {leaf_x + 26} 246 {leaf_x - 8} 265z" fill="#5f9e54" stroke="#3d6b35"/>'
        )
        d.shape(f'<rect x="{x - 34}" y="{y - 13}" width="30" height="26" rx="4" fill="{INK}"/>')
        d.shape(f'<path d="M{x - 4} {y - 8}L{x + 7} {y - 13}V{y + 13}L{x - 4} {y + 8}z" fill="{INK}"/>')
        d.text(left + 385, 146, share, size=17, weight=600)
        d.text(left + 385, 168, "visible area", size=12.5, fill=SOFT)
        d.text(left + 385, 184, "over whole area", size=12.5, fill=SOFT)
        d.text(left + 215, 290, words, size=14)
    d.shape(f'<path d="M440 24V276" stroke="{LINE}" stroke-dasharray="4 4"/>')
    return d


def one_step() -> Drawing:
    """One step of a task: plan, move, look, and what a policy decides from."""
    d = Drawing(
        880, 345, "One step: the policy decides from what is known, the arm plans and moves, the camera looks"
    )
    d.box(30, 40, 180, 86, GREEN, "policy", "chooses a move of|the camera")
    d.box(250, 40, 180, 86, BLUE, "plan", "inverse kinematics:|can the arm get there?")
    d.box(470, 40, 180, 86, SAND, "move", "set, simulated, or a|guarded real arm")
    d.box(690, 40, 160, 86, SAND, "look", "cast rays, or a|camera's frame")
    for x in (210, 430, 650):
        d.arrow((x, 83), (x + 40, 83))
    d.box(
        470,
        190,
        380,
        86,
        BLUE,
        "sensing",
        "fruits, map of fruits, V_f, memory of the leaves;|the same code in training and on the robot",
    )
    d.box(190, 190, 220, 86, GREY, "belief", "what is known: target, views,|leaves, reach")
    d.arrow((770, 126), (770, 190))
    d.arrow((470, 233), (410, 233))
    d.arrow((190, 233), (120, 233), (120, 126))
    for y, words in (
        (303, "in training the gain of V_f, less the cost of the move, is the reward"),
        (323, "yellow: what differs between simulation and robot"),
    ):
        d.text(190, y, words, fill=SOFT, anchor="start")
    d.text(
        30,
        24,
        "the policy is told no secret: only what a wrist camera could know",
        size=13,
        fill=SOFT,
        anchor="start",
    )
    return d


def rooms() -> Drawing:
    """The rooms of the package: each imports only what stands below it."""
    d = Drawing(880, 470, "The packages in layers; imports point down")
    rows: tuple[tuple[tuple[str, str, str], ...], ...] = (
        (("cli", GREY, "the commands"),),
        (
            ("experiments", GREEN, "evaluation, benchmarks,|statistics, reports"),
            ("learning", GREEN, "TD3, DDPG, imitation,|view quality"),
        ),
        (
            ("tasks", SAND, "the four tasks: N games at once;|shells for ManiSkill and learners"),
            ("deploy", SAND, "arm, camera, guard, loop,|calibration, digital twin"),
        ),
        (("policies", GREEN, "planners, learned view quality, trained actors, ONNX"),),
        (
            ("sensing", BLUE, "frame to belief: fruit map,|memory, observation, V_f"),
            ("segmentation", BLUE, "detectors, data sets,|metrics, training"),
        ),
        (
            ("rendering", BLUE, "SAPIEN's pictures"),
            ("raycast", BLUE, "V_f, depth, clearance"),
        ),
        (("robot", GREY, "iiwa 14, D435, kinematics"), ("plants", GREY, "procedural plants, rows, meshes")),
    )
    heights = [36, 66, 66, 40, 66, 40, 40]
    y = 26
    for row, height in zip(rows, heights, strict=True):
        width = (820 - 16 * (len(row) - 1)) / len(row)
        for k, (name, fill, what) in enumerate(row):
            x = 30 + k * (width + 16)
            if "|" in what:
                d.box(x, y, width, height, fill, name, what)
            else:
                d.box(x, y, width, height, fill, f"{name}: {what}")
        y += height + 11
    d.text(
        440,
        y + 8,
        "a room imports what is below it or to its right; tasks and deploy do not know each other",
        size=13,
        fill=SOFT,
    )
    return d


def photos_to_robot() -> Drawing:
    """The way from photos of a greenhouse to a robot that looks at its tomatoes."""
    d = Drawing(880, 250, "Photos, segmenter, judged, calibrated arm, checks, dry run, first move in T1")
    steps = (
        ("photos", GREY, "boxes or masks,|COCO or VOC"),
        ("train-segmenter", GREEN, "from the weights|that ship"),
        ("judge segmenter", GREEN, "AP, recall on|photos set aside"),
        ("twin", BLUE, "deploy inspect on|simulated rows"),
    )
    more = (
        ("calibrate", BLUE, "where the camera|sits on the flange"),
        ("check", SAND, "everything, and|nothing moves"),
        ("dry run", SAND, "a look, and the|move it would make"),
        ("T1, --confirm", RED, "a hand on the|enabling switch"),
    )
    for row, y in ((steps, 24), (more, 140)):
        for k, (name, fill, what) in enumerate(row):
            x = 30 + 211 * k
            d.box(x, y, 187, 86, fill, name, what)
            if k:
                d.arrow((x - 24, y + 43), (x, y + 43))
    d.arrow((757, 110), (757, 125), (124, 125), (124, 140))
    return d


DIAGRAMS: Final[dict[str, Callable[[], Drawing]]] = {
    "visible_fraction": visible_fraction,
    "one_step": one_step,
    "rooms": rooms,
    "photos_to_robot": photos_to_robot,
}
"""Every diagram by the name of its file."""


def main() -> None:
    """Writes all of them."""
    for name, draw in DIAGRAMS.items():
        (FOLDER / f"{name}.svg").write_text(str(draw()), encoding="utf-8")


if __name__ == "__main__":
    main()
