"""Code in prose that names something of the reference leads there: `dtv.render`, `Camera.look_at`, `TetMesh`."""

import re
from collections import defaultdict
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.nodes import make_refnode

_NAME = re.compile(r"(?:dtv\.|difftetvr\.)?[A-Za-z_][\w.]*")
_CALL = re.compile(r"\(.*\)$")


class CodeLinks(SphinxPostTransform):
    """Makes links of inline code."""

    default_priority = 20  # after references are resolved

    def run(self, **options: Any) -> None:
        """Looks at every piece of inline code."""
        by_end = self._by_end()
        for literal in list(self.document.findall(nodes.literal)):
            parents = (nodes.reference, nodes.title, nodes.pending)
            if isinstance(literal.parent, parents) or "refdomain" in literal.parent.attributes:
                continue
            target = self._find(literal.astext(), by_end)
            if target is not None:
                full_name, entry = target
                link = make_refnode(
                    self.app.builder, self.env.docname, entry.docname, entry.node_id, literal.deepcopy(), full_name
                )
                literal.replace_self(link)

    def _by_end(self) -> dict[str, list[str]]:
        """Full names of all that is documented, by each of their ends."""
        found = defaultdict(list)
        for full_name, entry in self._objects().items():
            parts = full_name.split(".")
            for start in range(len(parts) if not entry.aliased else 0):
                found[".".join(parts[start:])].append(full_name)
        return found

    def _objects(self) -> dict[str, Any]:
        return self.env.get_domain("py").objects  # type: ignore[attr-defined]

    def _find(self, text: str, by_end: dict[str, list[str]]) -> tuple[str, Any] | None:
        name = _CALL.sub("", text)
        if not _NAME.fullmatch(name):
            return None
        full = re.sub(r"^dtv\.", "difftetvr.", name)
        if full in self._objects():
            return full, self._objects()[full]
        # A word alone is too often something else: an option, a key of a file, an argument.
        if "." not in name and not name[0].isupper() and not ("_" in name and "(" in text):
            return None
        ends = by_end.get(name, [])
        return (ends[0], self._objects()[ends[0]]) if len(ends) == 1 else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Tells Sphinx."""
    app.add_post_transform(CodeLinks)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
