"""The thesis's experiments; see `ReproductionConfig`."""

import logging
import sys

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.configs import ReproductionConfig
from maniskill_tomato.experiments.reproduction import run_reproduction

if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    try:
        run_reproduction(tyro.cli(ReproductionConfig, config=(tyro.conf.PositionalRequiredArgs,)), print)
    except TomatoError as error:
        sys.exit(f"error: {error}")
