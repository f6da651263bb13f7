"""How Sphinx builds the documentation: `make docs` writes it to build/docs, and takes warnings for errors."""

import re
from importlib import metadata
from typing import Any

project = "diffsim"
copyright = "the diffsim contributors"
release = metadata.version("mesh-diffsim")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns: list[str] = []
html_theme = "furo"
html_title = "diffsim"
html_show_sourcelink = False

default_role = "code"  # docstrings write `code` as Markdown does
myst_heading_anchors = 3
myst_enable_extensions = ["dollarmath"]
nb_execution_mode = "off"  # notebooks are committed with their outputs; `docs/notebooks` is a link to them
# Links to files that are not pages, such as ../examples/throw_bunny.py, are links to the repository's files.
suppress_warnings = ["myst.xref_missing"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "undoc-members": False}
autodoc_class_signature = "mixed"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False

_attributes: dict[str, list[str]] = {}  # their docstrings, by name
_SECTION = re.compile(r"^(Args|Returns|Raises|Gradients): +(.*)$")


def _to_restructured_text(app: Any, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    """Docstrings are written to be read: sections may begin on the line of their heading, and |x| is a length."""
    result: list[str] = []
    in_section = False
    for line in lines:
        section = _SECTION.match(line)
        if section:
            result += ["", f"**{section[1]}:** {section[2]}"]
        elif in_section and line.startswith("    "):
            result.append(line.strip())
        else:
            if in_section and line:
                result.append("")
            result.append(line)
        in_section = bool(section) or (in_section and line.startswith("    "))
    parts = (
        part if k % 2 else re.sub(r"(?<!\w)[|]|[|](?!\w)|(?<=\w)[|]|_(?!\w)", r"\\\g<0>", part)
        for k, part in enumerate(re.split(r"(`+[^`]*`+)", "\n".join(result)))
    )
    lines[:] = "".join(parts).split("\n")
    if what == "attribute":
        _attributes[name] = list(lines)


def _restore_attribute(app: Any, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    """Napoleon takes what comes before a colon for an attribute's type; here types are annotations."""
    if what == "attribute":
        lines[:] = _attributes[name]


def _link_to_pages(app: Any, name: str, source: list[str]) -> None:
    """Notebooks are pages here; in the repository they lie beside the examples."""
    source[0] = source[0].replace("](../examples/notebooks/", "](notebooks/")


def setup(app: Any) -> None:
    app.connect("source-read", _link_to_pages)
    app.connect("autodoc-process-docstring", _to_restructured_text, priority=400)  # before napoleon's
    app.connect("autodoc-process-docstring", _restore_attribute, priority=600)
