"""Docstrings of attributes and properties as this package writes them."""

import re
from typing import Any

from sphinx.application import Sphinx

_BEFORE_NAPOLEON, _AFTER_NAPOLEON = 400, 600


def keep_description(app: Sphinx, what: str, name: str, item: Any, options: Any, lines: list[str]) -> None:
    """Napoleon takes what stands before the first colon for a type; an empty comment before it keeps it from that."""
    if what in ("attribute", "property") and lines and ":" in lines[0]:
        lines[:0] = ["..", ""]


def put_types_beside_names(app: Sphinx, what: str, name: str, item: Any, options: Any, lines: list[str]) -> None:
    """Napoleon gives an attribute's type a paragraph of its own; as the directive's option it stands in its line."""
    attribute = None
    for index, line in enumerate(lines):
        if line.startswith(".. attribute:: "):
            attribute = index
        elif attribute is not None and (found := re.match(r"   :type: (.+)", line)):
            lines[index] = ""
            lines[attribute] += "\n   :type: " + found[1].replace("torch.", "")
            attribute = None
    lines[:] = "\n".join(lines).split("\n")


def name_factories(
    app: Sphinx, what: str, name: str, item: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """A default that is made anew for each object has no value to be shown, and no syntax that could be read."""
    return signature and signature.replace("<factory>", "..."), returned


def setup(app: Sphinx) -> dict[str, bool]:
    """Tells Sphinx."""
    app.connect("autodoc-process-docstring", keep_description, priority=_BEFORE_NAPOLEON)
    app.connect("autodoc-process-docstring", put_types_beside_names, priority=_AFTER_NAPOLEON)
    app.connect("autodoc-process-signature", name_factories)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
