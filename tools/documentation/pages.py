"""Which pages the site has, in which order, and where each of them stands on a Git host."""

import re
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]

HOME: Final = "index"
"""Name of the first page on the site; on a Git host it is the README of `docs/`."""

NAVIGATION: Final[dict[str, tuple[str, ...]]] = {
    "Begin": ("start", "how_it_works"),
    "Tutorials": ("tutorials/train", "tutorials/judge", "make_it_yours", "tutorials/robot"),
    "How to": (
        "viewer",
        "hardware",
        "examples",
        "maniskill",
        "thesis",
        "export",
        "clusters",
        "lerobot",
        "troubleshooting",
        "contributing",
    ),
    "Reference": (
        "tasks",
        "observation",
        "visibility",
        "plants",
        "planners",
        "learning",
        "detection",
        "perception",
        "deploy",
        "profiles",
        "commands",
        "api/index",
    ),
    "Results": (
        "results/index",
        "results/benchmark",
        "results/td3",
        "results/pixels",
        "results/ppo",
        "results/learned_reward",
        "results/thesis",
        "results/perception",
        "results/segmenters",
        "results/memory",
        "results/twin",
        "results/stopping",
        "results/mutation",
    ),
    "About": ("field", "performance", "compatibility", "security", "licences", "changelog"),
}
"""The pages by their names on the site, as its side bar shows them; `api/` is written from docstrings."""


def sources() -> dict[str, Path]:
    """Every Markdown page in the repository that belongs to the site, by its name there."""
    pages = {"contributing": ROOT / "CONTRIBUTING.md", "changelog": ROOT / "CHANGELOG.md"}
    for path in sorted((ROOT / "docs").rglob("*.md")):
        name = path.relative_to(ROOT / "docs").with_suffix("").as_posix()
        pages[re.sub(r"(^|/)README$", rf"\1{HOME}", name)] = path
    return pages


def title_and_summary(text: str) -> tuple[str, str]:
    """The heading of a Markdown page and the first sentence under it, without links and emphasis.

    Args:
        text: The page.
    """
    heading, _, body = text.partition("\n")
    first = body.strip().split("\n\n")[0]
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(first.split())).replace("**", "")
    sentence = re.match(r".*?[.:](?= |$)", plain)
    return heading.removeprefix("# "), (sentence.group() if sentence else plain).rstrip(".:") + "."


def headings(text: str) -> dict[str, str]:
    """The headings of a Markdown page by the anchors that Git hosts give them.

    Args:
        text: The page.
    """
    outside = re.sub(r"(?ms)^```.*?^```", "", text)
    found = (heading.strip() for heading in re.findall(r"^#+ (.*)$", outside, re.MULTILINE))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-"): heading for heading in found}
