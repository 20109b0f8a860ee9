"""Writes the robot's URDF and meshes anew: `python tools/build_robot.py [--out FOLDER]`."""

import logging
from pathlib import Path

import tyro

from maniskill_tomato.assets import ASSETS_DIR
from maniskill_tomato.robot.robot_description import VISIBLE_LINK_NAMES
from robot_model import glb, meshes, urdf

_logger = logging.getLogger(__name__)


def build(folder: Path) -> list[Path]:
    """Writes the URDF and its meshes into `folder`; the same files on every run.

    Returns:
        The files written.
    """
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    written = [folder / "iiwa14.urdf"]
    written[0].write_text(urdf.urdf_text(), encoding="utf-8")
    for name in VISIBLE_LINK_NAMES:
        path = folder / "meshes" / f"{name}.glb"
        path.write_bytes(glb.to_glb(meshes.link_parts(name)))
        written.append(path)
        _logger.info("%s: %d bytes", path, path.stat().st_size)
    return written


def main(out: Path = ASSETS_DIR / "iiwa14") -> None:
    """Writes `iiwa14.urdf` and `meshes/*.glb`.

    Args:
        out: Folder to write into.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    files = build(out)
    _logger.info("%d files, %.0f kB", len(files), sum(f.stat().st_size for f in files) / 1000)


if __name__ == "__main__":
    tyro.cli(main)
