"""Perceptions on the same episodes; see `PerceptionConfig`."""

import logging
import sys

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.configs import PerceptionConfig
from maniskill_tomato.experiments.perception_comparison import compare_perceptions

if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    try:
        print(compare_perceptions(tyro.cli(PerceptionConfig)))
    except TomatoError as error:
        sys.exit(f"error: {error}")
