"""Data made in blocks by several processes, each kept in a file of its own, so that what is there is not made again."""

import io
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from maniskill_tomato.files import read_tensors, write_atomically


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
    if jobs == 1 or not missing:
        for done, block in enumerate(missing, start=1):
            report(_told(block, _make(block), done, len(missing)))
        return
    # ManiSkill and Warp start once in each process, which must not be a fork of one that has them.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(missing)), mp_context=context) as pool:
        futures: dict[Future[int], Block] = {pool.submit(_run_block, block): block for block in missing}
        for done, future in enumerate(as_completed(futures), start=1):
            report(_told(futures[future], future.result(), done, len(missing)))


def _told(block: Block, rows: int, done: int, count: int) -> str:
    return f"{block.path.name}: {rows} rows ({done} of {count} blocks)"


def _run_block(block: Block) -> int:
    torch.set_num_threads(1)
    return _make(block)


def _make(block: Block) -> int:
    data = block.make(*block.arguments)
    buffer = io.BytesIO()
    torch.save(data, buffer)
    write_atomically(block.path, buffer.getvalue())
    return max(len(rows) for rows in data.values())
