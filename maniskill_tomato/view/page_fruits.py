"""The list of fruits that a camera's map holds, as HTML for a page's panel."""

from typing import Final

from maniskill_tomato.view.episode_recording import MappedFruit, Snapshot

NO_MAP: Final = (
    "The exact senses need no map. With a camera as senses, the fruits that it has found are listed here."
)
NO_FRUIT: Final = "The map holds no fruit yet."
ABOUT: Final = (
    "V_f is that of the view shown, with the range in which it may lie; a dash stands for a fruit that the view does "
    "not show. Place is the standard deviation along the least certain direction."
)

STYLE: Final = """<style>
.tomato-fruits { padding: 0.3em 0.7em; font-size: 0.9em; line-height: 1.35; }
.tomato-fruits table { width: 100%; border-collapse: collapse; font-variant-numeric: tabular-nums; }
.tomato-fruits th, .tomato-fruits td { padding: 0.15em 0.3em; text-align: right; font-weight: normal; }
.tomato-fruits th:first-child { text-align: left; }
.tomato-fruits tr.target > * { font-weight: bold; }
</style>"""


def fruit_list(snapshot: Snapshot, has_map: bool) -> str:
    """The fruits of a view's map, the target first, then by their numbers.

    Args:
        snapshot: The view.
        has_map: Whether a camera keeps a map at all.
    """
    if not snapshot.fruits:
        return f'{STYLE}<div class="tomato-fruits">{NO_FRUIT if has_map else NO_MAP}</div>'
    ordered = sorted(snapshot.fruits, key=lambda fruit: (not fruit.is_target, fruit.number))
    head = "".join(f'<th scope="col">{name}</th>' for name in ("Fruit", "V_f", "range", "place"))
    rows = "".join(_row(fruit) for fruit in ordered)
    return (
        f'{STYLE}<div class="tomato-fruits"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'
        f"<p>{ABOUT}</p></div>"
    )


def _row(fruit: MappedFruit) -> str:
    name = f"{fruit.number}, {'ripe' if fruit.is_ripe else 'unripe'}{', target' if fruit.is_target else ''}"
    value = between = "-"
    if fruit.fraction is not None:
        low, middle, high = fruit.fraction.band
        value, between = f"{middle:.2f}", f"{low:.2f} to {high:.2f}"
    cells = "".join(f"<td>{text}</td>" for text in (value, between, f"{1000.0 * fruit.spread:.0f} mm"))
    return f'<tr{" class=target" if fruit.is_target else ""}><th scope="row">{name}</th>{cells}</tr>'
