"""The pages of the documentation: every relative link leads somewhere."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest
from documentation.pages import HOME, NAVIGATION, sources

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
]


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


@pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="the tests run outside a checkout")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if link.startswith(("http:", "https:")):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert broken == []


ROOMS = (
    "assets",
    "cli",
    "deploy",
    "experiments",
    "learning",
    "plants",
    "policies",
    "raycast",
    "rendering",
    "robot",
    "segmentation",
    "sensing",
    "tasks",
    "view",
)


def defined_names(path: Path) -> set[str]:
    """What a module defines or imports at its top, and the members of its classes as `Class.member`."""
    names: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.ClassDef):
            names.add(node.name)
            names.update(f"{node.name}.{name}" for name in _targets(node.body))
            names.update(f"{node.name}.{m.name}" for m in node.body if isinstance(m, ast.FunctionDef))
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names.update(alias.asname or alias.name for alias in node.names)
    return names | _targets(ast.parse(path.read_text(encoding="utf-8")).body)


def _targets(body: list[ast.stmt]) -> set[str]:
    found = {n.target.id for n in body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)}
    for node in body:
        if isinstance(node, ast.Assign):
            found.update(target.id for target in node.targets if isinstance(target, ast.Name))
    return found


def exists(dotted: str) -> bool:
    """Whether a dotted name below the package is a folder, a module, or something that a module defines."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        place = ROOT / "maniskill_tomato" / Path(*parts[:length])
        rest = ".".join(parts[length:])
        if place.with_suffix(".py").is_file():
            return not rest or rest in defined_names(place.with_suffix(".py"))
        if place.is_dir():
            return (
                not rest or (place / "__init__.py").is_file() and rest in defined_names(place / "__init__.py")
            )
    return False


@cache
def python_files() -> tuple[str, ...]:
    """All Python files outside hidden folders such as the environment's."""
    tops = [top for top in ROOT.iterdir() if not top.name.startswith(".")]
    nested = (path for top in tops if top.is_dir() for path in top.rglob("*.py"))
    return tuple(f"/{path.relative_to(ROOT)}" for path in (*nested, *(t for t in tops if t.suffix == ".py")))


@pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="the tests run outside a checkout")
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.name != "CHANGELOG.md"],  # It also names what is gone.
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_names_of_modules_in_the_text_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    rooms = "|".join(ROOMS)
    pattern = rf"(?:maniskill_tomato\.|(?<![-\w./]))((?:{rooms})(?:\.[A-Za-z_]\w*)+)\b"
    dotted = re.findall(pattern, text)
    missing = {
        name for name in dotted if not exists(name) and not name.endswith((".md", ".py", ".json", ".png"))
    }
    files = re.findall(rf"`((?:{rooms}|scripts|tools|tests|examples)/[\w/]+\.\w+)`", text)
    gone = {
        name
        for name in files
        if not (ROOT / name).exists() and not (ROOT / "maniskill_tomato" / name).exists()
    }
    modules = re.findall(r"`([\w/]+\.py)`", text)
    gone |= {name for name in modules if not any(path.endswith(f"/{name}") for path in python_files())}
    folders = re.findall(r"`([a-z_]+/[a-z_/]+/)`", text)
    gone |= {
        name for name in folders if not any((ROOT / top / name).is_dir() for top in ("", "maniskill_tomato"))
    }
    assert missing | gone == set()


def test_every_test_that_a_page_names_exists() -> None:
    places = {path.name: path for path in (ROOT / "tests").rglob("test_*.py")}
    named = {
        (file, name)
        for page in PAGES
        for file, name in re.findall(r"`(test_\w+\.py)::(\w+)`", page.read_text(encoding="utf-8"))
    }
    missing = {
        (file, name)
        for file, name in named
        if file not in places or f"def test_{name}(" not in places[file].read_text(encoding="utf-8")
    }
    assert len(named) > 40 and missing == set()


def test_every_message_that_the_troubleshooting_page_quotes_is_one_of_ours() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    code = [path for top in ("maniskill_tomato", "tasks", "deploy") for path in (ROOT / top).rglob("*.py")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in (*code, *(ROOT / "scripts").glob("*.sh")))
    text = re.sub(r'"\n\s*f?"', "", text)  # A message may run on over several lines.
    first_cells = re.findall(r"^\| (`[^|]*?) \|", page, re.MULTILINE)
    quoted = [quote for cell in first_cells for quote in re.findall(r"`([^`]+)`", cell)]
    parts = {part.strip() for quote in quoted for part in quote.split("...") if part.strip(" =")}
    assert len(quoted) > 15
    assert {part for part in parts if part not in text} == {
        "a test picture took over 180 s",  # "took over %.0f s"
        "libGL.so.1: cannot open shared object file",  # The system's own.
    }


def test_every_page_stands_once_in_the_side_bar_of_the_site() -> None:
    named = sorted(name for names in NAVIGATION.values() for name in names)
    assert named == sorted({*sources(), "api/index"} - {HOME}), (
        "see NAVIGATION of tools/documentation/pages.py"
    )
