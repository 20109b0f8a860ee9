"""A training's folder: its settings, and data made in blocks by several processes, each block in a file of its own,
so that what is there is not made again."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import read_tensors, write_json, write_tensors
from maniskill_tomato.text_files import read_json
from maniskill_tomato.worker_pool import run_jobs


@dataclass(frozen=True, kw_only=True)
class Block:
    """One file, and how it is made."""

    path: Path
    make: Callable[..., dict[str, Tensor]]
    """A function of a module, called with `arguments` in another process."""
    arguments: tuple[Any, ...]

    def read(self) -> dict[str, Any]:
        """What the file holds.

        Raises:
            CheckpointError: It is missing or damaged.
        """
        data: dict[str, Any] = read_tensors(self.path)
        return data


def run_blocks(blocks: Sequence[Block], jobs: int, report: Callable[[str], None]) -> None:
    """Makes the files that are missing.

    Args:
        blocks: All of them.
        jobs: Processes at a time; one is this process itself.
        report: Told one line after each.

    Raises:
        CheckpointError: A file cannot be written.
    """
    missing = [block for block in blocks if not block.path.is_file()]
    for done, (block, rows) in enumerate(run_jobs(_make, missing, jobs), start=1):
        report(f"{block.path.name}: {rows} rows ({done} of {len(missing)} blocks)")


def _make(block: Block) -> int:
    data = block.make(*block.arguments)
    write_tensors(block.path, data)
    return max(len(rows) for rows in data.values())


def begin_training(out: Path, settings: dict[str, Any]) -> None:
    """Writes the settings of a training into its folder, or goes on with the one that is there.

    Raises:
        InvalidInputError: The folder holds a training with other settings.
    """
    settings = json.loads(json.dumps(settings))  # With lists for tuples, as the file tells it.
    described = out / "config.json"
    if described.is_file() and read_json(described) != settings:
        raise InvalidInputError(f"{out} holds a training with other settings; choose another folder")
    write_json(described, settings)
