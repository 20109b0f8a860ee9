"""The controls that choose a stored episode, and what each policy made of it, side by side."""

import html
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

import viser

from maniskill_tomato.view.episode_recording import EpisodeRecording
from maniskill_tomato.view.page_choices import by_hand
from maniskill_tomato.view.page_head import picture_tag
from maniskill_tomato.view.player import Player

if TYPE_CHECKING:
    from maniskill_tomato.view.record_session import RecordSession

STYLE: Final = """<style>
.tomato-ways { display: grid; grid-template-columns: 1fr 1fr; gap: 0.6em; padding: 0.3em 0.7em; font-size: 0.9em;
  line-height: 1.3; }
.tomato-ways figure { margin: 0; border-top: 0.35em solid; padding-top: 0.2em; overflow-wrap: anywhere; }
.tomato-ways figcaption { color: var(--mantine-color-text); }
.tomato-ways img { display: block; }
</style>"""


class RecordChoices:
    """Dropdowns that show another episode of a record."""

    def __init__(
        self,
        gui: viser.GuiApi,
        record: "RecordSession",
        player: Player,
        ask: Callable[[Callable[[], None]], object],
    ) -> None:
        """Adds them to the container that is open.

        Args:
            gui: Of the server.
            record: What is chosen from.
            player: Shows what is chosen.
            ask: Has something done by the page's thread.
        """
        self._record = record
        self._player = player
        self._policies: dict[str, str] = {}
        self._episodes: dict[str, int] = {}
        self._told: tuple[str, str] | None = None
        self._condition: Any = None
        if len(record.conditions) > 1:
            self._condition = gui.add_dropdown("Condition", tuple(record.conditions))
            self._condition.on_update(by_hand(ask, lambda value: self._choose(condition=value)))
        self._policy: Any = gui.add_dropdown("Policy", ("",))
        self._policy.on_update(by_hand(ask, lambda value: self._choose(policy=self._policies[value])))
        self._episode: Any = gui.add_dropdown("Episode", ("",))
        self._episode.on_update(by_hand(ask, lambda value: self._choose(seed=self._episodes[value])))
        failures = gui.add_button_group("Failures", ("previous", "next"))
        failures.on_click(by_hand(ask, self._next_failure))
        self._ways = gui.add_html("")

    def tell(self, recording: EpisodeRecording, shown: int) -> None:
        """Brings the controls up to date."""
        record = self._record
        if self._told != (record.condition, record.policy):
            self._told = record.condition, record.policy
            counts = {p: (len(record.failures(p)), len(record.listed(p))) for p in record.policies}
            self._policies = {f"{p}: {n - failed} of {n} solved": p for p, (failed, n) in counts.items()}
            self._episodes = {
                f"{e.seed}: solved, {e.moves} moves" if e.success else f"{e.seed}: failed, {e.reason}": e.seed
                for e in record.listed(record.policy)
            }
            self._policy.options = tuple(self._policies)
            self._episode.options = tuple(self._episodes)
        if self._condition is not None:
            self._condition.value = record.condition
        self._policy.value = next(text for text, p in self._policies.items() if p == record.policy)
        self._episode.value = next(text for text, seed in self._episodes.items() if seed == record.seed)
        self._ways.content = ways_side_by_side(recording, shown)

    def _choose(self, **changes: Any) -> None:
        self._record.choose(**changes)
        self._player.show(0)

    def _next_failure(self, which: str) -> None:
        """Shows the failure before or after the shown episode."""
        seed = failure_beside(self._record.failures(self._record.policy), self._record.seed, which)
        if seed is not None:
            self._choose(seed=seed)


def failure_beside(failures: Sequence[int], shown: int, which: str) -> int | None:
    """The failure before or after an episode; from the ends it goes on at the other one.

    Args:
        failures: Seeds, in the order in which they are gone through.
        shown: Seed of the shown episode; from one that is no failure, `next` leads to the first and `previous` to the
            last.
        which: `previous` or `next`.

    Returns:
        A seed; None if nothing failed.
    """
    if not failures:
        return None
    if shown not in failures:
        return failures[-1 if which == "previous" else 0]
    step = -1 if which == "previous" else 1
    return failures[(failures.index(shown) + step) % len(failures)]


def ways_side_by_side(recording: EpisodeRecording, shown: int) -> str:
    """What the cameras of all policies see after as many moves, each in its colour, with how it ended, as HTML."""
    if len(recording.ways) < 2:
        return ""
    cells = []
    for way in recording.ways:
        own = way.recording
        snapshot, move = own.at(shown), min(shown, own.moves)
        ended = f", <b>{html.escape(own.outcome)}</b>" if move == own.moves else ""
        red, green, blue = way.colour
        cells.append(
            f'<figure style="border-color: rgb({red}, {green}, {blue})">'
            f"{picture_tag(own.picture(shown), f'What the camera of {way.label} sees', 80)}"
            f"<figcaption><b>{html.escape(way.label)}</b>, move {move}, V_f {snapshot.visible_fraction:.2f}{ended}"
            "</figcaption></figure>"
        )
    return f'{STYLE}<div class="tomato-ways">{"".join(cells)}</div>'
