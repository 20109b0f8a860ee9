"""The controls that choose an episode: task, policy, senses, seed, another plant."""

from collections.abc import Callable
from typing import Any, Final

import viser

from maniskill_tomato.plants.kinds import PLANT_NAMES
from maniskill_tomato.task_registry import task_ids
from maniskill_tomato.view.play_settings import PERCEPTIONS
from maniskill_tomato.view.player import Player

OWN_PLANT: Final = "the task's own"


class EpisodeChoices:
    """Dropdowns and numbers that begin another episode."""

    def __init__(
        self, gui: viser.GuiApi, player: Player, ask: Callable[[Callable[[], None]], object]
    ) -> None:
        """Adds them to the container that is open.

        Args:
            gui: Of the server.
            player: Whose episode is chosen.
            ask: Has something done by the page's thread.
        """
        self._player = player
        change = player.change
        self._env_id: Any = gui.add_dropdown(
            "Task",
            tuple(dict.fromkeys((*task_ids(), player.settings.env_id))),
            initial_value=player.settings.env_id,
        )
        self._env_id.on_update(by_hand(ask, lambda value: change(env_id=value)))
        self._policy: Any = gui.add_dropdown(
            "Policy", player.settings.policies(), initial_value=player.settings.policy
        )
        self._policy.on_update(by_hand(ask, lambda value: change(policy=value)))
        self._perception: Any = gui.add_dropdown(
            "Senses", PERCEPTIONS, initial_value=player.settings.perception
        )
        self._perception.on_update(by_hand(ask, lambda value: change(perception=value)))
        self._seed: Any = gui.add_number("Seed", player.settings.seed, min=0, step=1)
        self._seed.on_update(by_hand(ask, lambda value: change(seed=int(value))))
        others = gui.add_button_group("Go to", ("previous", "next"))
        others.on_click(by_hand(ask, self._next_seed))
        with gui.add_folder("Another plant", expand_by_default=False):
            preset = gui.add_dropdown("Preset", (OWN_PLANT, *PLANT_NAMES), initial_value=OWN_PLANT)
            seed = gui.add_number("Plant seed", 0, min=0, step=1)
            density = gui.add_slider("Leaf density", min=0.2, max=2.0, step=0.1, initial_value=1.0)

            def grow() -> None:
                options = {
                    "preset": preset.value,
                    "seed": int(seed.value),
                    "leaf_density": float(density.value),
                }
                change(plant_options={} if preset.value == OWN_PLANT else {"plant": options})

            gui.add_button("Grow", icon=viser.Icon.PLANT).on_click(by_hand(ask, lambda _: grow()))

    def tell(self) -> None:
        """Brings the controls up to date."""
        settings = self._player.settings
        self._env_id.value = settings.env_id
        self._policy.options = settings.policies()
        self._policy.value = settings.policy
        self._perception.value = settings.perception
        self._seed.value = settings.seed

    def _next_seed(self, which: str) -> None:
        step = -1 if which == "previous" else 1
        self._player.change(seed=max(self._player.settings.seed + step, 0))


def by_hand(
    ask: Callable[[Callable[[], None]], object], command: Callable[[Any], None]
) -> Callable[[Any], None]:
    """A callback that does something with a control's value if somebody set it in a browser.

    Args:
        ask: Has something done by the page's thread.
        command: What is done with the value.
    """

    def changed(event: Any) -> None:
        value = event.target.value
        if event.client is not None:
            ask(lambda: command(value))

    return changed
