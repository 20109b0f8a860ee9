"""Policies on rows; see `RowBenchmarkConfig`."""

import logging
import sys

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.configs import RowBenchmarkConfig
from maniskill_tomato.experiments.row_benchmark import run_row_benchmark

if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    try:
        print(run_row_benchmark(tyro.cli(RowBenchmarkConfig)))
    except TomatoError as error:
        sys.exit(f"error: {error}")
