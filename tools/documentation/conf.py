"""Sphinx's configuration of the site; `tools/build_docs.py` runs it on the staged pages."""

import os
import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from maniskill_tomato import __version__

# ManiSkill asks on the terminal before it downloads an asset; a build must not wait for an answer.
os.environ.setdefault("MS_SKIP_ASSET_DOWNLOAD_PROMPT", "1")

project = "maniskill-tomato"
author = "The maniskill-tomato contributors"
copyright = author
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
root_doc = "index"
smartquotes = False
default_role = "code"

myst_heading_anchors = 4

autodoc_default_options = {"members": True, "show-inheritance": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
add_module_names = False
maximum_signature_line_length = 90
napoleon_google_docstring = True
napoleon_numpy_docstring = False
python_use_unqualified_type_names = True
toc_object_entries = False

html_theme = "furo"
html_title = "maniskill-tomato"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_show_copyright = False
html_sourcelink_suffix = ""
html_theme_options: dict[str, list[str]] = {"footer_icons": []}
copybutton_exclude = ".linenos, .gp, .go"


_attributes: dict[str, list[str]] = {}
"""Docstrings of attributes, which napoleon would cut at their first colon, until it has passed."""


def plain_docstring(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Turns the Markdown of docstrings into what Sphinx reads: code in single backticks, nothing else special."""
    text = re.sub(r"(?m)^(?!\s*- )(.*\S.*)\n(?=- )", r"\1\n\n", "\n".join(lines))
    parts = re.split(r"(`+[^`]+`+)", text)
    for k, part in enumerate(parts):
        if k % 2:
            before = "\\ " if parts[k - 1][-1:].strip() else ""
            parts[k] = f"{before}``{part.strip('`')}``" + ("\\ " if parts[k + 1][:1].strip() else "")
        else:
            parts[k] = re.sub(r"(?<![\\*])(\*(?!\*)|\||_(?!\w))", r"\\\1", part)
    lines[:] = "".join(parts).split("\n")
    if what in ("attribute", "data"):
        _attributes[name] = list(lines)


def restore_attribute(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Puts the docstring of an attribute back as it was before napoleon."""
    if name in _attributes:
        lines[:] = _attributes.pop(name)


def setup(app: Any) -> None:
    """Docstrings are made plain before napoleon reads their sections."""
    app.connect("autodoc-process-docstring", plain_docstring, priority=100)
    app.connect("autodoc-process-docstring", restore_attribute, priority=900)
