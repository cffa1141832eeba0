"""Links to examples lead to files where the manual's sources are read, and to the gallery in the manual itself."""

import re

from sphinx.application import Sphinx


def to_gallery(app: Sphinx, document: str, content: list[str]) -> None:
    """Turns links to ``../examples/x.py`` into such to the page made of it, and to the folder to the gallery."""
    text = re.sub(r"\]\(\.\./examples/(\w+)\.py\)", r"](/gallery/\1.rst)", content[0])
    content[0] = text.replace("](../examples/)", "](/gallery/index.rst)")


def setup(app: Sphinx) -> dict[str, bool]:
    """Tells Sphinx."""
    app.connect("source-read", to_gallery)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
