"""TetGen's pairs of text files: vertices in .node, tetrahedra in .ele.

Attributes have no names in this format; ours are named in a comment, which other readers pass over.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.files import atomic_write
from difftetvr.mesh.io.content import (
    CellBlock,
    Content,
    Output,
    all_digits,
    as_indices,
    damaged,
    parse_numbers,
    split_rgba,
    write_table,
)

_COMMENT = re.compile(rb"#[^\n]*")
_NAMES = re.compile(rb"#[ \t]*attributes:[ \t]*(\w+(?:[ \t]+\w+)*)")
_RGBA = ("red", "green", "blue", "density")


def files(path: Path) -> tuple[Path, Path]:
    """The pair that a .node or .ele file belongs to: the .node file, the .ele file."""
    suffix = path.suffix
    node, ele = (".NODE", ".ELE") if suffix.isupper() else (".node", ".ele")
    return path.with_suffix(node), path.with_suffix(ele)


def read(path: Path) -> Content:
    """Read a pair of files; indices may begin at 0 or 1.

    Args:
        path: Either file.

    Returns:
        Their content: attributes are point and cell data by their names, else ``attribute_0``, ...; boundary markers
        are point data ``marker``.

    Raises:
        MeshError: One is missing or damaged.
    """
    node, ele = files(path)
    for file in (node, ele):
        if not file.is_file():
            raise MeshError(f"{path} is one of a pair and there is no {file.name} beside it; put both into one folder.")
    header, names, rows = _rows(node, 4)
    _, dimension, attributes, markers = header
    if dimension != 3:
        raise damaged(node, f"its points have {dimension} coordinates")
    first = _first_index(node, rows)
    point_data = _attributes(rows[:, 4 : 4 + attributes], names)
    if markers:
        point_data["marker"] = rows[:, 4 + attributes]
    (_, size, attributes, _), names, cells = _rows(ele, 3)
    if size not in (4, 10):
        raise damaged(ele, f"its cells have {size} vertices")
    if len(cells):
        _first_index(ele, cells)
    nodes = as_indices(ele, cells[:, 1 : 1 + size]) - first
    block = CellBlock("tetra" if size == 4 else "tetra10", nodes, np.arange(len(nodes)))
    return Content(rows[:, 1:4], (block,), point_data, _attributes(cells[:, 1 + size :], names))


def write(path: Path, output: Output) -> None:
    """Write a pair of files; numbers have all digits that it takes to read the same ones again.

    Args:
        path: The one of the pair to write; the other appears beside ``output.path``, whole or not at all.
        output: The mesh, and the field's arrays.
    """
    node, ele = files(output.path)
    is_node = output.path == node
    with atomic_write(ele if is_node else node, MeshError) as partner:
        node, ele = (path, partner) if is_node else (partner, path)
        on_vertices, on_cells = (None, output.rgba) if output.is_per_cell else (output.rgba, None)
        _write_table(node, f"{len(output.vertices)} 3 {{}} 0", output.vertices, on_vertices)
        _write_table(ele, f"{len(output.tets)} 4 {{}}", output.tets, on_cells)


def _write_table(path: Path, header: str, values: np.ndarray, rgba: np.ndarray | None) -> None:
    columns = [np.arange(len(values))[:, None], values]
    lines = [header.format(0 if rgba is None else 4)]
    if rgba is not None:
        lines.append("# attributes: " + " ".join(_RGBA))
        columns.append(rgba)
    row = " ".join(map(all_digits, columns))
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write("\n".join(lines) + "\n")
        write_table(file, np.hstack([column.astype(np.float64) for column in columns]), row)


def _rows(path: Path, words: int) -> tuple[list[int], list[str], np.ndarray]:
    """The header (4 numbers), names of the attributes if known, and the rows of a file as float64."""
    text = path.read_bytes()
    match = _NAMES.search(text)
    names = match.group(1).decode().split() if match else []
    head, _, body = _COMMENT.sub(b"", text).lstrip().partition(b"\n")
    header = as_indices(path, parse_numbers(path, head)).tolist()
    if not 2 <= len(header) <= words or min(header) < 0 or header[0] > len(text) or max(header[1:]) > len(text):
        raise damaged(path, "its first line does not say what follows")
    header += [0] * (4 - len(header))
    count, size, attributes, markers = header
    columns = 1 + size + attributes + markers
    numbers = parse_numbers(path, body)
    if numbers.size != count * columns:
        raise damaged(path, f"it announces {count} rows of {columns} numbers but holds {numbers.size} numbers")
    return header, names, numbers.reshape(count, columns)


def _first_index(path: Path, rows: np.ndarray) -> int:
    """0 or 1, where the indices in the first column begin."""
    first = rows[0, 0] if len(rows) else 0
    if first not in (0, 1) or (rows[:, 0] != np.arange(len(rows)) + first).any():
        raise damaged(path, "its rows are not numbered from 0 or 1 on")
    return int(first)


def _attributes(values: np.ndarray, names: list[str]) -> dict[str, np.ndarray]:
    if tuple(names) == _RGBA and values.shape[1] == 4:
        return split_rgba(values)
    if len(names) != values.shape[1] or len(set(names)) != len(names):
        names = [f"attribute_{i}" for i in range(values.shape[1])]
    return {name: values[:, i] for i, name in enumerate(names)}
