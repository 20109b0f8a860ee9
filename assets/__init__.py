"""Files that ship with the package, and the one place that knows where they are."""

from pathlib import Path

if __name__ != "maniskill_tomato.assets":
    raise ImportError(
        f"imported as {__name__!r}; import `maniskill_tomato.assets` instead "
        "(is the repository root on sys.path?)"
    )

ASSETS_DIR = Path(__file__).resolve().parent


def asset_path(name: str) -> Path:
    """The path of the shipped file `name`, which is relative to the assets folder.

    Raises:
        FileNotFoundError: There is no such file; the message lists the folder's entries.
    """
    path = ASSETS_DIR / name
    if not path.is_file():
        entries = ", ".join(sorted(p.name for p in ASSETS_DIR.iterdir() if not p.name.startswith("_")))
        raise FileNotFoundError(f"asset {name!r} not found in {ASSETS_DIR}, which holds: {entries}")
    return path
