"""Where profiles are found; cheap to import."""

from pathlib import Path
from typing import Final

PROFILES: Final = Path(__file__).resolve().parent / "profiles"
"""Those that ship with the package."""


def profile_names() -> tuple[str, ...]:
    """The names of the profiles that ship."""
    return tuple(sorted(path.stem for path in PROFILES.glob("*.toml")))


def profile_path(name_or_file: str) -> Path:
    """The file of a profile that ships, or the path itself."""
    return PROFILES / f"{name_or_file}.toml" if name_or_file in profile_names() else Path(name_or_file)
