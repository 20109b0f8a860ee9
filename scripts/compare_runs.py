"""Training runs compared; see `RunComparisonConfig`."""

import logging
import sys

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.configs import RunComparisonConfig
from maniskill_tomato.experiments.run_comparison import compare_runs

if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    try:
        print(compare_runs(tyro.cli(RunComparisonConfig, config=(tyro.conf.PositionalRequiredArgs,))).table)
    except TomatoError as error:
        sys.exit(f"error: {error}")
