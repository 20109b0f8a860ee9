"""The episodes of a fixed list, taken by a reset's seed or by its option `episode`."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.episode_list import EPISODE_LISTS, Episode, load_episodes


class EpisodeChoice:
    """Says which episode of a list a reset begins; of no list, none."""

    def __init__(self, episodes: str | Sequence[Episode] | None) -> None:
        """Reads the list.

        Args:
            episodes: One of `EPISODE_LISTS`, the path of a `.json` file, episodes, or None for no list.

        Raises:
            InvalidInputError: There is no such list, or there are no episodes in it.
        """
        self.split = episodes if isinstance(episodes, str) and episodes in EPISODE_LISTS else "train"
        """The split of seeds that the plants come from."""
        self.episodes: tuple[Episode, ...] | None = None
        """The list."""
        if isinstance(episodes, str):
            self.episodes = load_episodes(episodes)
        elif episodes is not None:
            self.episodes = tuple(episodes)
            if not self.episodes or not all(isinstance(e, Episode) for e in self.episodes):
                raise InvalidInputError("episodes must be the name of a list or one or more Episode objects")

    def at(self, env_index: int, seed: int, options: Mapping[str, Any]) -> Episode | None:
        """The episode that a reset begins in an environment; None without a list.

        Args:
            env_index: Which environment.
            seed: Its seed, the index unless the option `episode` says otherwise; modulo the list's length.
            options: Of the reset. `episode` is an index, or one for each environment.

        Raises:
            InvalidInputError: The option is no index, or there is no list.
        """
        if self.episodes is None:
            if "episode" in options:
                raise InvalidInputError(
                    f"reset option episode needs a list: make the task with episodes= one of {', '.join(EPISODE_LISTS)}"
                )
            return None
        index = options.get("episode", None)
        if index is None:
            index = seed
        elif isinstance(index, Sequence | np.ndarray | Tensor):
            index = index[env_index]
        if isinstance(index, bool) or int(index) != index or int(index) < 0:
            raise InvalidInputError(f"reset option episode must be an index of 0 or more; got {index!r}")
        return self.episodes[int(index) % len(self.episodes)]
