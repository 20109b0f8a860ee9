"""The documentation as a site: its navigation, its links, the list of pages for language models."""

import re
from pathlib import Path

import pytest
from documentation.api_pages import PUBLIC, write_api_pages
from documentation.llms import write_llms_files
from documentation.pages import HOME, NAVIGATION, ROOT, headings, sources, title_and_summary
from documentation.staging import EPISODE_PAGE, rewritten, stage
from draw_diagrams import DIAGRAMS, FOLDER

NAMED = [name for names in NAVIGATION.values() for name in names]


@pytest.fixture(scope="module")
def staged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages as Sphinx reads them."""
    folder = tmp_path_factory.mktemp("site") / "source"
    stage(folder)
    write_api_pages(folder)
    return folder


def test_every_public_module_is_there_and_opens_with_a_sentence() -> None:
    places = {
        f"{room}.{module}": ROOT / "maniskill_tomato" / room / f"{module.replace('.', '/')}.py"
        for room, modules in PUBLIC.items()
        for module in modules
    }
    assert [name for name, path in places.items() if not path.is_file()] == []
    assert [name for name, path in places.items() if not path.read_text().startswith('"""')] == []


def test_links_lead_to_pages_by_their_titles_to_files_beside_them_and_never_to_folders() -> None:
    home, other = Path("/repository/docs/README.md"), ROOT / "docs" / "visibility.md"
    copied: list[Path] = []

    def copy(file: Path) -> str:
        copied.append(file)
        return "files/LICENSE"

    text = (
        f"[visibility.md]({other}#cost), [what V_f is]({other}), [licence]({ROOT}/LICENSE), [all]({ROOT}/deploy/), "
        f"[elsewhere](https://example.org/a.md), [here](#below), ![picture]({ROOT}/LICENSE)"
    )
    assert rewritten(text, home, "results/index", {other: "visibility"}, copy) == (
        "[Cost](../visibility.md#cost), [what V_f is](../visibility.md), [licence](../files/LICENSE), all, "
        "[elsewhere](https://example.org/a.md), [here](#below), ![picture](../files/LICENSE)"
    )
    assert copied == [ROOT / "LICENSE"] * 2


def test_the_viewers_page_links_to_the_episode_that_the_build_exports(staged: Path) -> None:
    assert f'<a href="{EPISODE_PAGE}">' in (staged / "viewer.md").read_text(encoding="utf-8")
    # A Git host has no such file to lead to.
    assert f'href="{EPISODE_PAGE}"' not in (ROOT / "docs" / "viewer.md").read_text(encoding="utf-8")


def test_every_link_of_a_staged_page_leads_to_a_file_on_the_site(staged: Path) -> None:
    pages = [path for path in staged.rglob("*.md") if path.parent.name != "api"]
    assert len(pages) == len(sources())
    broken = [
        (page.name, target)
        for page in pages
        for target in re.findall(r"\]\(([^)\s#]+)", page.read_text(encoding="utf-8"))
        if ":" not in target and not (page.parent / target).is_file()
    ]
    assert broken == []


def test_anchors_are_those_of_a_git_host_and_code_has_none() -> None:
    text = "# Any page\n\n## What `x` is, and why\n\n```bash\n# a comment\n```\n"
    assert headings(text) == {"any-page": "Any page", "what-x-is-and-why": "What `x` is, and why"}


def test_the_first_sentence_of_a_page_is_told_without_its_links() -> None:
    text = "# A page\n\nSee [the\nother](other.md) v1.2 **first**. Then\nread on.\n\nMore.\n"
    assert title_and_summary(text) == ("A page", "See the other v1.2 first.")


def test_the_list_for_language_models_names_every_page_and_the_long_file_holds_them(
    staged: Path, tmp_path: Path
) -> None:
    write_llms_files(staged, tmp_path)
    listed = (tmp_path / "llms.txt").read_text(encoding="utf-8")
    assert listed.startswith("# maniskill-tomato\n\n> ")
    assert re.findall(r"\]\(_sources/([^)]+)\.md\)", listed) == [HOME, *NAMED]
    whole = (tmp_path / "llms-full.txt").read_text(encoding="utf-8")
    assert [name for name in NAMED if (staged / f"{name}.md").read_text(encoding="utf-8") not in whole] == []


@pytest.mark.parametrize("name", DIAGRAMS)
def test_a_diagram_is_what_its_program_draws(name: str) -> None:
    assert (FOLDER / f"{name}.svg").read_text(encoding="utf-8") == str(DIAGRAMS[name]()), (
        "run `make reference`"
    )
