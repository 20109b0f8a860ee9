"""A copy of the pages in which every link leads to its page on the site; Sphinx reads that copy.

The pages in the repository link to each other as a Git host shows them. On the site some stand elsewhere
(`docs/README.md` is the home page), and files that are no pages lie beside the page that links to them.
"""

import os
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from documentation.pages import HOME, NAVIGATION, ROOT, headings, sources

LINK = re.compile(
    r"(?P<mark>!?)\[(?P<text>(?:[^\]\[]|\[[^\]]*\])*)\]\((?P<target>[^)\s#]+)(?P<anchor>#[^)\s]*)?\)"
)
"""A Markdown link or image with a target outside its own page."""


EPISODE_PAGE = "episode.html"
"""What `play --export` makes of an episode. It holds viser's program, so that it is built and not kept."""

ADDED = {
    "viewer": f"""
## An episode to turn

<a href="{EPISODE_PAGE}">An episode in one file</a>, made by `maniskill-tomato play --export`: the policy that ships
looks for a hidden tomato on plants that it has never seen. Play it, go back, turn and zoom.
"""
}
"""What pages have on the site only, by their names there."""


def stage(folder: Path) -> None:
    """Writes every page of the repository and the files that they show into an empty folder.

    Args:
        folder: Where Sphinx will read them.
    """
    pages = sources()
    names = {path: name for name, path in pages.items()} | {ROOT / "README.md": HOME}
    for name, path in pages.items():
        place = folder / f"{name}.md"
        place.parent.mkdir(parents=True, exist_ok=True)
        text = rewritten(path.read_text(encoding="utf-8"), path, name, names, _copier(folder))
        place.write_text(
            text + ADDED.get(name, "") + (navigation() if name == HOME else ""), encoding="utf-8"
        )


def rewritten(
    text: str, page: Path, name: str, names: Mapping[Path, str], copy: Callable[[Path], str]
) -> str:
    """A page with its links as the site needs them: they lead to pages, say their titles, and none leads to a folder.

    Args:
        text: The page in Markdown.
        page: Its file in the repository, from which its links count.
        name: Its name on the site.
        names: The names on the site of all pages, by their files.
        copy: Takes a file that is no page, and returns its path on the site.
    """

    def link(match: re.Match[str]) -> str:
        target = match["target"]
        if re.match(r"[a-z]+:", target):
            return match.group()
        file, anchor, words = (page.parent / target).resolve(), match["anchor"] or "", match["text"]
        if file in names:
            place = f"{names[file]}.md"
            if words.endswith((".md", "/")):
                words = _heading(file, anchor.removeprefix("#"))
        elif file.is_file():
            place = copy(file)
        else:
            return words
        return f"{match['mark']}[{words}]({os.path.relpath(place, Path(name).parent)}{anchor})"

    return LINK.sub(link, text)


def navigation() -> str:
    """The side bar, as what Sphinx reads at the end of the home page."""
    parts = (
        "\n".join(("", "```{toctree}", ":hidden:", f":caption: {caption}", "", *names, "```", ""))
        for caption, names in NAVIGATION.items()
    )
    return "".join(parts)


def _heading(page: Path, anchor: str) -> str:
    """What a link says that names a file: the heading that it leads to."""
    found = headings(page.read_text(encoding="utf-8"))
    return found[anchor] if anchor else next(iter(found.values()))


def _copier(folder: Path) -> Callable[[Path], str]:
    """Copies files of the repository to where they stand on the site: those of `docs/` as they stand there."""

    def copy(file: Path) -> str:
        relative = file.relative_to(ROOT)
        relative = relative.relative_to("docs") if relative.parts[0] == "docs" else "files" / relative
        (folder / relative).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, folder / relative)
        return relative.as_posix()

    return copy
