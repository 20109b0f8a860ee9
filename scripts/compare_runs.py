"""Compares training runs: a report with a table over seeds and training curves over steps and time.

Runs of the same task and options are one configuration; their seeds give the interquartile mean and its 95 % interval.
A folder that holds run folders stands for all of them.

Example:
    python scripts/compare_runs.py runs/guided-0 runs/guided-1 runs/guided-2 runs/ppo-guided --out runs/comparison
"""

import sys
from pathlib import Path

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.evaluation.comparison import find_runs, group_runs, load_run
from maniskill_tomato.evaluation.comparison_report import make_rows, markdown_table, write_comparison


def main(runs: tyro.conf.Positional[tuple[Path, ...]], out: Path = Path("runs/comparison")) -> None:
    """Compares training runs.

    Args:
        runs: Run folders, or folders that hold some.
        out: Folder of the report.
    """
    groups = group_runs([load_run(path) for path in find_runs(runs)])
    report = write_comparison(groups, out)
    print(markdown_table(make_rows(groups)))
    print(f"report  {report}")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
