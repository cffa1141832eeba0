"""The text of an XDMF file: its elements, and how they refer to each other."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import damaged

_MOST_REFERENCES = 256
_LONGEST_REFERENCE = 1000
_XPOINTER = re.compile(r"(?:xpointer|element)\((.*)\)", re.DOTALL)
_STEP = re.compile(r"""(//?|)(\*|[\w.:-]+)((?:\[(?:[^\]'"]|'[^']*'|"[^"]*")*\])*)""")
_PREDICATE = re.compile(r"""\[((?:[^\]'"]|'[^']*'|"[^"]*")*)\]""")
_ATTRIBUTE = re.compile(r"""@([\w.:-]+)\s*=\s*(?:'([^']*)'|"([^"]*)")""")
_NAMES = re.compile(r"self::\w+(?:\s*(?:or|\|)\s*self::\w+)*")


class Document:
    """A file's elements.

    Attributes:
        path: The file.
        root: The outermost element.
    """

    def __init__(self, path: Path) -> None:
        """Read a file.

        Args:
            path: The file.

        Raises:
            MeshError: It is no XML, or defines entities, which can stand for other files or for endless text.
        """
        self.path = path
        self._found: dict[str, list[Element]] = {}
        builder = TreeBuilder()
        parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler = builder.start
        parser.EndElementHandler = builder.end
        parser.CharacterDataHandler = builder.data
        parser.EntityDeclHandler = self._refuse_entity
        try:
            parser.Parse(path.read_bytes(), True)
            self.root = builder.close()
        # LookupError and ValueError: an unknown or impossible encoding.
        except (expat.ExpatError, LookupError, ValueError) as error:
            raise damaged(path, f"it is no XML: {error}") from error
        if self.root.tag != "Xdmf":
            raise damaged(path, f"it begins with {self.root.tag[:40]!r}, not with 'Xdmf'")

    def children(self, element: Element) -> Iterator[Element]:
        """The elements in an element, with those that an ``xi:include`` stands for in its place."""
        for child in element:
            if child.tag.rpartition(":")[2] != "include":
                yield child
                continue
            pointer = _XPOINTER.fullmatch(child.get("xpointer", "").strip())
            if child.get("href") or pointer is None:
                raise MeshError(f"{self.path} takes parts from another document; put all into one.")
            yield from self.referred(pointer.group(1))

    def referred(self, expression: str) -> list[Element]:
        """The elements that a path of XPath leads to, such as ``//Grid[@Name='mesh']/*[self::Topology]``.

        Raises:
            MeshError: It leads to none, is not understood, or there are too many of them.
        """
        expression = expression.strip()
        if expression not in self._found:
            if len(self._found) >= _MOST_REFERENCES or len(expression) > _LONGEST_REFERENCE:
                raise damaged(self.path, "it refers to more of its parts than any real file does")
            self._found[expression] = self._walk(expression)
        if not self._found[expression]:
            raise damaged(self.path, f"{expression[:80]!r} leads to nothing in it")
        return self._found[expression]

    def _walk(self, expression: str) -> list[Element]:
        top = Element("")
        top.append(self.root)
        nodes = [top if expression.startswith("/") else self.root]
        position = 0
        while position < len(expression):
            step = _STEP.match(expression, position)
            if step is None:
                raise self._unknown(expression)
            position = step.end()
            if step.group(1) == "//":
                nodes = list({id(inner): inner for node in nodes for inner in node.iter()}.values())
            nodes = [child for node in nodes for child in self._step(node, step.group(2), step.group(3), expression)]
        return nodes

    def _step(self, node: Element, name: str, predicates: str, expression: str) -> list[Element]:
        chosen = [child for child in node if name in ("*", child.tag)]
        for predicate in _PREDICATE.findall(predicates):
            text = predicate.strip()
            attribute = _ATTRIBUTE.fullmatch(text)
            if attribute is not None:
                wanted = attribute.group(2) if attribute.group(2) is not None else attribute.group(3)
                chosen = [child for child in chosen if child.get(attribute.group(1)) == wanted]
            elif _NAMES.fullmatch(text):
                names = re.findall(r"self::(\w+)", text)
                chosen = [child for child in chosen if child.tag in names]
            elif text == "last()":
                chosen = chosen[-1:]
            elif text.isascii() and text.isdigit():
                chosen = chosen[max(int(text[:9]) - 1, 0) : int(text[:9])]
            else:
                raise self._unknown(expression)
        return chosen

    def _unknown(self, expression: str) -> MeshError:
        return MeshError(
            f"{self.path} refers to its parts by {expression[:80]!r}, which is not understood; write each grid in full."
        )

    def _refuse_entity(self, *_: object) -> None:
        raise damaged(self.path, "it defines entities, which no mesh needs")
