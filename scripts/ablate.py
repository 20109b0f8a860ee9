"""What each option of the learner is worth; see `AblationConfig`."""

import logging
import sys

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.ablation import run_ablation
from maniskill_tomato.experiments.configs import AblationConfig

if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    try:
        print(run_ablation(tyro.cli(AblationConfig), print))
    except TomatoError as error:
        sys.exit(f"error: {error}")
