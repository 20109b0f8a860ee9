"""Evaluates a policy and writes a report; the same as `maniskill-tomato eval`.

Usage:
    python scripts/eval.py TomatoViewpointGuided-v1 --policy runs/demo/training/policy.pt --episodes 100
    python scripts/eval.py --help
"""

import sys

from maniskill_tomato.cli import main

if __name__ == "__main__":
    main(["eval", *sys.argv[1:]])
