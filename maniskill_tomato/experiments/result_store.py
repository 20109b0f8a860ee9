"""Where experiments keep their results, so that one that was stopped at any moment goes on.

`DIR/results/PART/NAME.jsonl` has a line of JSON for every result. Lines are only ever added; one that a crash cut
short is left out when they are read again. `DIR/settings.json` says what the results depend on, and
`DIR/results/PART/about.json` what a part is, where its results are to be understood without the code that made them.
"""

import hashlib
import json
import logging
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.files import write_atomically, write_json
from maniskill_tomato.text_files import parse_json, read_json

logger = logging.getLogger(__name__)

SETTINGS = "settings.json"
RESULTS = "results"
ABOUT = "about.json"


class ResultStore:
    """The results of one experiment, each under a part, a name and a number."""

    def __init__(
        self, folder: Path, settings: Mapping[str, Any], members: Mapping[str, str] | None = None
    ) -> None:
        """Opens the folder, or makes it.

        Args:
            folder: Of the experiment.
            settings: What every result depends on; plain JSON values.
            members: What tells those that come and go, such as policies, apart by their labels; the folder remembers
                those of earlier calls.

        Raises:
            InvalidInputError: The folder holds results of other settings, or of another member with the same label.
        """
        self._folder = folder
        path = folder / SETTINGS
        wanted = json.loads(json.dumps(settings))
        known: dict[str, str] = {}
        if path.is_file():
            found = _read_settings(path)
            known = found["members"]
            before = found["settings"]
            differing = sorted(n for n in before.keys() | wanted.keys() if before.get(n) != wanted.get(n))
            differing += [name for name, what in (members or {}).items() if known.get(name, what) != what]
            if differing:
                raise InvalidInputError(
                    f"{folder} holds results of another experiment ({', '.join(differing)} differ); choose another "
                    "--out, or delete it"
                )
        content = {"settings": wanted, "members": {**known, **(members or {})}}
        write_json(path, content)

    def read(self, part: str, name: str) -> dict[int, dict[str, Any]]:
        """The results by their numbers, in order."""
        return read_results(self._path(part, name))

    def missing(self, part: str, name: str, numbers: Iterable[int]) -> list[int]:
        """Which of these numbers have no result yet."""
        done = self.read(part, name)
        return [number for number in numbers if number not in done]

    def add(self, part: str, name: str, results: Mapping[int, Mapping[str, Any]]) -> None:
        """Adds results; they are on the disk when this returns."""
        path = self._path(part, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        text = _lines(results)
        with path.open("ab+") as file:
            # A line that was cut short must not swallow the next one.
            if file.tell() and _last_byte(file) != b"\n":
                text = b"\n" + text
            file.write(text)
            file.flush()
            os.fsync(file.fileno())

    def episodes(self, part: str, name: str, numbers: Sequence[int]) -> list[EpisodeRecord]:
        """The episodes among these numbers that are there."""
        found = self.read(part, name)
        return [EpisodeRecord.from_json(found[n]) for n in numbers if n in found]

    def add_episodes(self, part: str, name: str, episodes: Sequence[EpisodeRecord]) -> None:
        """Adds episodes under their seeds."""
        self.add(part, name, {episode.seed: episode.to_json() for episode in episodes})

    def describe(self, part: str, about: Mapping[str, Any]) -> None:
        """Says what a part is; plain JSON values."""
        write_json(self._folder / RESULTS / _file_name(part) / ABOUT, about)

    def description(self, part: str) -> dict[str, Any]:
        """What `describe` said; empty if nothing was said."""
        path = self._folder / RESULTS / _file_name(part) / ABOUT
        return dict(read_json(path)) if path.is_file() else {}

    def _path(self, part: str, name: str) -> Path:
        return results_path(self._folder, part, name)


def results_path(folder: Path, part: str, name: str) -> Path:
    """The file of the results of one part and name."""
    return folder / RESULTS / _file_name(part) / f"{_file_name(name)}.jsonl"


def read_results(path: Path) -> dict[int, dict[str, Any]]:
    """The results of a file by their numbers, in order; none if it is not there."""
    found: dict[int, dict[str, Any]] = {}
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        try:
            content = parse_json(line.decode())
            found[int(content["number"])] = content["result"]
        except (ValueError, KeyError, TypeError):
            logger.warning("%s has a line that cannot be read; its result is made again", path)
    return dict(sorted(found.items()))


def write_results(path: Path, results: Mapping[int, Mapping[str, Any]]) -> None:
    """Writes a file of results whole, in place of the one that is there."""
    write_atomically(path, _lines(results))


def fingerprint(*files: Path) -> str:
    """Tells the contents of files apart."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        found = read_json(path)
        return {"settings": dict(found["settings"]), "members": dict(found["members"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(
            f"{path} does not describe an experiment of this version ({error!r}); choose another --out"
        ) from error


def _lines(results: Mapping[int, Mapping[str, Any]]) -> bytes:
    lines = [json.dumps({"number": n, "result": r}, allow_nan=False) + "\n" for n, r in results.items()]
    return "".join(lines).encode()


def _last_byte(file: Any) -> bytes:
    file.seek(-1, os.SEEK_END)
    byte: bytes = file.read(1)
    return byte


def _file_name(name: str) -> str:
    """A name with nothing in it that a file system minds."""
    return re.sub(r"[^A-Za-z0-9._+-]", "_", name)
