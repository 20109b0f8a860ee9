"""Compares training runs: a report with a table over seeds and training curves over steps and time.

Runs of the same task and options are one configuration; their seeds give the interquartile mean and its 95 % interval.
A folder that holds run folders stands for all of them. With --evaluate, runs without an evaluation get one first.

Examples:
    python scripts/compare_runs.py runs/guided-0 runs/guided-1 runs/guided-2 runs/ppo-guided --out runs/comparison
    python scripts/compare_runs.py runs/td3-guided runs/td3-sparse --evaluate 100 --out runs/comparison
"""

import logging
import sys
from pathlib import Path

import torch
import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.comparison import find_runs, group_runs, load_run
from maniskill_tomato.experiments.comparison_report import make_rows, markdown_table, write_comparison
from maniskill_tomato.experiments.evaluate import evaluate_run


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    out: Path = Path("runs/comparison"),
    evaluate: int | None = None,
    eval_seed: int = 1000,
) -> None:
    """Compares training runs.

    Args:
        runs: Run folders, or folders that hold some.
        out: Folder of the report.
        evaluate: First judge the runs that have no evaluation, in this many episodes on the plants of their training.
        eval_seed: Seed of the first of these episodes; the others follow.
    """
    loaded = [load_run(path) for path in find_runs(runs)]
    if evaluate is not None:
        torch.set_num_threads(1)
        for index, run in enumerate(loaded):
            if run.metrics is None:
                evaluate_run(run, evaluate, eval_seed)
                loaded[index] = load_run(run.path)
    groups = group_runs(loaded)
    report = write_comparison(groups, out)
    print(markdown_table(make_rows(groups)))
    print(f"report  {report}")


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        tyro.cli(main)
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
