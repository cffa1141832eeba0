"""Medit files (.mesh), text: a surface's or a volume's geometry, with a number for each element."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import (
    CellBlock,
    Content,
    Output,
    all_digits,
    as_indices,
    damaged,
    parse_numbers,
    write_table,
)

_CELLS = {
    "edges": ("line", 2),
    "triangles": ("triangle", 3),
    "quadrilaterals": ("quad", 4),
    "tetrahedra": ("tetra", 4),
    "prisms": ("wedge", 6),
    "pyramids": ("pyramid", 5),
    "hexahedra": ("hexahedron", 8),
    "hexaedra": ("hexahedron", 8),
    "tetrahedrap2": ("tetra10", 10),
    "hexahedraq2": ("hexahedron27", 27),
}
_COMMENT = re.compile(rb"#[^\n]*")
_KEYWORD = re.compile(rb"(?<!\S)[A-Za-z]{2}\w*")


def read(path: Path) -> Content:
    """Read a text file of Medit, TetWild, Gmsh or CGAL.

    Args:
        path: The file.

    Returns:
        Its content; the elements' numbers are point and cell data ``medit:ref``.

    Raises:
        MeshError: The file is damaged or two-dimensional.
    """
    text = _COMMENT.sub(b"", path.read_bytes())
    keywords = list(_KEYWORD.finditer(text))
    if not keywords or keywords[0].group().lower() != b"meshversionformatted":
        raise damaged(path, "it does not begin as Medit's text files do")
    ends = [k.start() for k in keywords[1:]] + [len(text)]
    sections = {k.group().decode().lower(): text[k.end() : end] for k, end in zip(keywords, ends)}
    if len(sections) < len(keywords):
        raise damaged(path, "one of its sections is there twice")
    if "dimension" in sections and parse_numbers(path, sections["dimension"]).tolist() != [3.0]:
        raise MeshError(f"{path} is no mesh of three dimensions; give a volume mesh.")
    points = _table(path, sections.get("vertices"), 3, "vertices")
    blocks, references, begin = [], [np.empty(0, np.int64)], 0
    for name in (name for name in sections if name in _CELLS):
        kind, size = _CELLS[name]
        table = as_indices(path, _table(path, sections[name], size, name))
        blocks.append(CellBlock(kind, table[:, :size] - 1, np.arange(begin, begin + len(table))))
        references.append(table[:, size])
        begin += len(table)
    return Content(
        points[:, :3],
        tuple(blocks),
        {"medit:ref": as_indices(path, points[:, 3])},
        {"medit:ref": np.concatenate(references)},
    )


def write(path: Path, output: Output) -> None:
    """Write a tetrahedral mesh; numbers have all digits that it takes to read the same ones again.

    Args:
        path: The file to write.
        output: The mesh; all data are passed over.
    """
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write("MeshVersionFormatted 2\nDimension 3\n")
        for name, table in (("Vertices", output.vertices), ("Tetrahedra", output.tets + 1)):
            file.write(f"{name}\n{len(table)}\n")
            write_table(file, table, f"{all_digits(table)} 0")
        file.write("End\n")


def _table(path: Path, text: bytes | None, columns: int, what: str) -> np.ndarray:
    """The rows of a section, (N, columns + 1), the last column being their number."""
    numbers = parse_numbers(path, text or b"")
    if not numbers.size:
        raise damaged(path, f"it lacks its {what}")
    count = float(numbers[0])
    if count * (columns + 1) != numbers.size - 1:
        raise damaged(path, f"it announces {count:g} {what} of {columns + 1} numbers but holds {numbers.size - 1}")
    return numbers[1:].reshape(-1, columns + 1)
