"""Where a benchmark keeps its episodes, so that it can go on after it was stopped.

`DIR/episodes/CONDITION/POLICY.jsonl` has a line for every finished episode. Lines are only ever added; one that a
crash cut short is left out when they are read again.
"""

import json
import logging
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.view_episode import ViewEpisode
from maniskill_tomato.files import write_atomically

logger = logging.getLogger(__name__)

SETTINGS = "settings.json"


class EpisodeStore:
    """The episodes of one benchmark."""

    def __init__(self, folder: Path, settings: dict[str, Any], policies: dict[str, str]) -> None:
        """Opens the folder, or makes it.

        Args:
            folder: Of the benchmark.
            settings: What every episode depends on; plain JSON values.
            policies: What tells the policies apart by their labels; the folder remembers those of earlier calls.

        Raises:
            InvalidInputError: The folder holds episodes of other settings, or of another policy with the same label.
        """
        self._folder = folder
        path = folder / SETTINGS
        found: dict[str, Any] = {"settings": settings, "policies": {}}
        if path.is_file():
            found = json.loads(path.read_text(encoding="utf-8"))
        differing = _differing(found["settings"], settings)
        known = found["policies"]
        differing += [
            f"policy {name}" for name in policies if known.get(name, policies[name]) != policies[name]
        ]
        if differing:
            raise InvalidInputError(
                f"{folder} holds episodes of another benchmark ({', '.join(differing)} differ); choose another --out, "
                "or delete it"
            )
        content = {"settings": settings, "policies": {**known, **policies}}
        write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())

    def read(self, condition: str, policy: str) -> list[ViewEpisode]:
        """The finished episodes in the order of their numbers."""
        path = self._path(condition, policy)
        if not path.is_file():
            return []
        found: dict[int, ViewEpisode] = {}
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                episode = ViewEpisode.from_json(json.loads(line))
            except (json.JSONDecodeError, InvalidInputError):
                logger.warning("%s has a line that cannot be read; its episode is run again", path)
                continue
            found[episode.episode] = episode
        return [found[number] for number in sorted(found)]

    def missing(self, condition: str, policy: str, episodes: Iterable[int]) -> list[int]:
        """Which of these episodes are not finished yet."""
        done = {episode.episode for episode in self.read(condition, policy)}
        return [number for number in episodes if number not in done]

    def add(self, condition: str, policy: str, episodes: Sequence[ViewEpisode]) -> None:
        """Adds finished episodes; they are on the disk when this returns."""
        path = self._path(condition, policy)
        path.parent.mkdir(parents=True, exist_ok=True)
        text = "".join(json.dumps(e.to_json(), allow_nan=False) + "\n" for e in episodes)
        with path.open("ab+") as file:
            # A line that was cut short must not swallow the next one.
            if file.tell() and _last_byte(file) != b"\n":
                text = "\n" + text
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())

    def _path(self, condition: str, policy: str) -> Path:
        return self._folder / "episodes" / _file_name(condition) / f"{_file_name(policy)}.jsonl"


def _differing(found: dict[str, Any], wanted: dict[str, Any]) -> list[str]:
    return sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name))


def _last_byte(file: Any) -> bytes:
    file.seek(-1, os.SEEK_END)
    byte: bytes = file.read(1)
    return byte


def _file_name(name: str) -> str:
    """A name with nothing in it that a file system minds."""
    return re.sub(r"[^A-Za-z0-9._-]", "_", name)
