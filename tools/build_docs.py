"""Builds the documentation as a site: `make docs`. Needs no network; a warning is an error."""

import argparse
import shutil
import sys
from pathlib import Path

from documentation.api_pages import write_api_pages
from documentation.llms import write_llms_files
from documentation.pages import ROOT
from documentation.staging import EPISODE_PAGE, stage
from sphinx.cmd.build import build_main

from maniskill_tomato.cli import run

CONFIGURATION = Path(__file__).resolve().parent / "documentation"

EPISODE_SEED = "3"
"""Of the exported episode; the policy that ships needs several moves in it."""


def build(out: Path) -> int:
    """Builds the site anew and returns Sphinx's exit status.

    Args:
        out: Folder of the site; what was built there before is replaced. The pages that Sphinx reads lie beside it.
    """
    staged = out.with_name(f"{out.name}-source")
    for folder in (out, staged):
        shutil.rmtree(folder, ignore_errors=True)
    stage(staged)
    write_api_pages(staged)
    options = ["-q", "-W", "--keep-going", "-E", "-b", "html", "-d", str(staged / ".doctrees")]
    status = build_main([*options, "-c", str(CONFIGURATION), str(staged), str(out)])
    if status == 0:
        write_llms_files(staged, out)
        run(["play", "TomatoViewpoint-v1", "--seed", EPISODE_SEED, "--export", str(out / EPISODE_PAGE)])
    return status


def main() -> None:
    """Reads the command line and builds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "docs", help="folder of the site")
    out = parser.parse_args().out.resolve()
    status = build(out)
    if status:
        sys.exit(status)
    print(f"the site begins at {out / 'index.html'}")


if __name__ == "__main__":
    main()
