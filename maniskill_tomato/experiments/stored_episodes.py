"""Episodes that an experiment keeps with what is needed to show them again: the task, its options, the policies.

`DIR/results/PART/about.json` says which episodes the files beside it hold; benchmarks and evaluations write it.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.result_store import (
    ABOUT,
    RESULTS,
    read_results,
    results_path,
    write_results,
)
from maniskill_tomato.files import write_json
from maniskill_tomato.text_files import read_json


@dataclass(frozen=True, kw_only=True)
class StoredEpisodes:
    """The episodes of several policies under one condition."""

    name: str
    """Of the condition."""
    env_id: str
    """The task."""
    env_options: Mapping[str, Any]
    """Its options."""
    episodes: Mapping[str, Mapping[int, EpisodeRecord]]
    """By the policy's label, and by the seed; no policy is without any."""


def about_condition(
    name: str, env_id: str, env_options: Mapping[str, Any], policies: Mapping[str, str]
) -> dict[str, Any] | None:
    """What is written about episodes; None where an option is an object that JSON has no form for.

    Args:
        name: Of the condition.
        env_id: The task.
        env_options: Its options.
        policies: What was opened, a name or a file, by the label.
    """
    about = {"name": name, "env_id": env_id, "env_options": dict(env_options), "policies": dict(policies)}
    try:
        plain: dict[str, Any] = json.loads(json.dumps(about))
    except TypeError:
        return None
    return plain


def store_episodes(
    folder: Path,
    env_id: str,
    env_options: Mapping[str, Any],
    policies: Mapping[str, str],
    episodes: Mapping[str, Sequence[EpisodeRecord]],
) -> None:
    """Writes the episodes of an evaluation, in place of those of an earlier one.

    Nothing is written where an option is an object that JSON has no form for: such episodes can be shown by whoever
    has the object.

    Args:
        folder: Of the evaluation.
        env_id: The task, also the name of the condition.
        env_options: Its options.
        policies: What was opened, a name or a file, by the label.
        episodes: Of each policy, by the label.
    """
    about = about_condition(env_id, env_id, env_options, policies)
    if about is None:
        return
    for label, records in episodes.items():
        write_results(results_path(folder, env_id, label), {r.seed: r.to_json() for r in records})
    write_json(results_path(folder, env_id, "").with_name(ABOUT), about)


def read_stored_episodes(folder: Path) -> list[StoredEpisodes]:
    """The episodes of an experiment, a condition each; sweeps come after what they vary.

    Raises:
        InvalidInputError: There are none, or a file cannot be read.
    """
    found = []
    for path in sorted(folder.glob(f"{RESULTS}/*/{ABOUT}"), key=lambda path: path.stat().st_mtime):
        about = read_json(path)
        try:
            stored = StoredEpisodes(
                name=str(about["name"]),
                env_id=str(about["env_id"]),
                env_options=_found_again(dict(about["env_options"]), folder),
                episodes={
                    label: {n: EpisodeRecord.from_json(r) for n, r in results.items()}
                    for label in about["policies"]
                    if (results := read_results(results_path(folder, about["name"], label)))
                },
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInputError(
                f"{path} does not describe episodes of this version ({error!r})"
            ) from error
        if stored.episodes:
            found.append(stored)
    if not found:
        raise InvalidInputError(f"{folder} holds no episodes; `benchmark` and `eval` write some")
    return found


def _found_again(options: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Options whose list of episodes is looked for beside its results if it is not where it was written."""
    listed = options.get("episodes")
    if isinstance(listed, str) and listed.endswith(".json") and not Path(listed).is_file():
        inside = folder / Path(listed).name
        if inside.is_file():
            options["episodes"] = str(inside)
    return options
