"""Trains, evaluates and reports; the same as `maniskill-tomato demo`.

Usage:
    python scripts/demo.py --minutes 3
"""

import sys

from maniskill_tomato.cli import main

if __name__ == "__main__":
    main(["demo", *sys.argv[1:]])
