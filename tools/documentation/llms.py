"""`llms.txt`, a list of the pages for language models, and `llms-full.txt`, all of them in one file (llmstxt.org)."""

from pathlib import Path

from documentation.pages import HOME, NAVIGATION, title_and_summary

SUMMARY = (
    "Active perception for tomato harvesting: a robot arm with a wrist camera learns where to look so that a "
    "tomato hidden behind leaves becomes fully visible. Tasks, plants, robot, training, evaluation and deployment "
    "as a ManiSkill plugin in Python."
)


def write_llms_files(staged: Path, site: Path) -> None:
    """Writes both files beside the home page; links lead to the Markdown of the pages.

    Args:
        staged: The pages as Sphinx read them.
        site: The built site.
    """
    lines = ["# maniskill-tomato", "", f"> {SUMMARY}"]
    everything = []
    for caption, names in {"Home": (HOME,), **NAVIGATION}.items():
        lines += ["", f"## {caption}", ""]
        for name in names:
            text = (staged / f"{name}.md").read_text(encoding="utf-8")
            title, summary = title_and_summary(text)
            lines.append(f"- [{title}](_sources/{name}.md): {summary}")
            everything.append(text)
    (site / "llms.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (site / "llms-full.txt").write_text("\n\n".join(everything), encoding="utf-8")
