"""The twin beside the simulated task; see `TwinConfig`."""

import json
import logging
import sys

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.configs import TwinConfig
from maniskill_tomato.experiments.twin_comparison import compare_twin

if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    try:
        print(json.dumps(compare_twin(tyro.cli(TwinConfig), print), indent=1))
    except TomatoError as error:
        sys.exit(f"error: {error}")
