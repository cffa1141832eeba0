"""What formats hold of data by name: which names, and which shapes of a row."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from difftetvr.errors import MeshError, listed
from difftetvr.mesh.io.content import Output

_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_TENSOR = (3, 3)


def require_names(output: Output, problem: Callable[[str], str | None]) -> None:
    """Check that a format can write the names of all data.

    Args:
        output: What is to be written.
        problem: What keeps a name from being written, as the end of "its name ..."; None where nothing does.

    Raises:
        MeshError: It cannot.
    """
    for name in (*output.point_data, *output.cell_data):
        if (reason := problem(name)) is not None:
            raise MeshError(
                f"{output.path}: a '{output.path.suffix}' cannot hold the array {name[:80]!r}, as its name {reason}; "
                "rename it."
            )


def xml_problem(name: str) -> str | None:
    """What keeps a name from being an attribute in XML; see `require_names`."""
    found = _NOT_IN_XML.search(name)
    return None if found is None else f"has the character {found[0]!r}, which XML does not know"


def control_problem(name: str, others: str = "") -> str | None:
    """What keeps a name from a format without control characters and some others; see `require_names`."""
    found = next((c for c in name if c < " " or c in "\x7f" or c in others), None)
    return None if found is None else f"has the character {found!r}"


def flattened(output: Output) -> tuple[Output, tuple[str, ...]]:
    """What is to be written, with rows that are lists of components, and a sentence about those that were not.

    Nothing is said of matrices of 3 x 3: nine components, row by row, are what these formats have for them.
    """
    places = output.point_data, output.cell_data
    odd = [n for arrays in places for n, v in arrays.items() if v.ndim > 2 and v.shape[1:] != _TENSOR]
    flat = [{n: v.reshape(len(v), -1) if v.ndim > 2 else v for n, v in arrays.items()} for arrays in places]
    return replace(output, point_data=flat[0], cell_data=flat[1]), said(output.path, odd, "written as rows of numbers")


def said(path: Path, names: Iterable[str], what: str) -> tuple[str, ...]:
    """A sentence about what became of data of some names; none where there are no names.

    Args:
        path: The file.
        names: Of the data, in any order, each once or more often.
        what: The sentence's end: "rounded".
    """
    words = [repr(name[:80]) for name in sorted(set(names))]
    return (f"{path}: the data {listed(words)} were {what}.",) if words else ()
