"""Runs the command as `python -m maniskill_tomato.cli`."""

from maniskill_tomato.cli import main

if __name__ == "__main__":
    main()
