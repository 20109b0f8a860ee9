"""Writes the robot's URDF and meshes anew: `python scripts/build_robot.py [--out FOLDER]`."""

import logging
from pathlib import Path

import tyro

from maniskill_tomato.assets import ASSETS_DIR
from maniskill_tomato.robot import description


def main(out: Path = ASSETS_DIR / "iiwa14") -> None:
    """Writes `iiwa14.urdf` and `meshes/*.glb`.

    Args:
        out: Folder to write into.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    files = description.build(out)
    logging.info("%d files, %.0f kB", len(files), sum(f.stat().st_size for f in files) / 1000)


if __name__ == "__main__":
    tyro.cli(main)
