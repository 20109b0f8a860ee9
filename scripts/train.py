"""Trains a policy; the same as `maniskill-tomato train`.

Usage:
    python scripts/train.py TomatoViewpointGuided-v1 --preset thesis-guided --seed 1
    python scripts/train.py --help
"""

import sys

from maniskill_tomato.cli import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
