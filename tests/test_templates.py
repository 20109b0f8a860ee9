"""Templates for issues and changes: forms that a Git host can show, in words that agree with the repository."""

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
FORMS = sorted(path for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if path.stem != "config")


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_a_form_has_what_git_hosts_ask_for(path: Path) -> None:
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert form["name"] and form["description"] and form["labels"]
    ids = [field["id"] for field in form["body"]]
    assert len(set(ids)) == len(ids)
    for field in form["body"]:
        assert field["type"] in ("textarea", "input", "dropdown", "checkboxes")
        assert field["attributes"]["label"]
    assert any(field.get("validations", {}).get("required") for field in form["body"])


def test_there_is_a_form_for_faults_for_wishes_and_for_hardware() -> None:
    assert [path.stem for path in FORMS] == ["fault", "hardware", "wish"]


def test_targets_and_files_that_the_templates_name_exist() -> None:
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / ".github").rglob("*") if path.is_file()]
    targets = {target for text in texts for target in re.findall(r"`make ([a-z-]+)`", text)}
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert targets and [target for target in targets if f".PHONY: {target}\n" not in makefile] == []
    files = {name for text in texts for name in re.findall(r"\b(?:docs/\w+|[A-Z]+)\.md\b", text)}
    assert files and [name for name in files if not (ROOT / name).is_file()] == []
