"""Gmsh files (.msh), text and binary, formats 2 and 4.1."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import CellBlock, Content, as_indices, parse_numbers
from difftetvr.mesh.io.source import Source

_KINDS = {
    1: ("line", 2),
    2: ("triangle", 3),
    3: ("quad", 4),
    4: ("tetra", 4),
    5: ("hexahedron", 8),
    6: ("wedge", 6),
    7: ("pyramid", 5),
    8: ("line3", 3),
    9: ("triangle6", 6),
    10: ("quad9", 9),
    11: ("tetra10", 10),
    12: ("hexahedron27", 27),
    13: ("wedge18", 18),
    14: ("pyramid14", 14),
    15: ("vertex", 1),
    16: ("quad8", 8),
    17: ("hexahedron20", 20),
    18: ("wedge15", 15),
    19: ("pyramid13", 13),
    20: ("triangle9", 9),
    21: ("triangle10", 10),
    22: ("triangle12", 12),
    23: ("triangle15", 15),
    24: ("triangle15", 15),
    25: ("triangle21", 21),
    26: ("line4", 4),
    27: ("line5", 5),
    28: ("line6", 6),
    29: ("tetra20", 20),
    30: ("tetra35", 35),
    31: ("tetra56", 56),
}
"""Name and number of nodes of a kind, by Gmsh's number."""


@dataclass
class _Elements:
    """Elements of one kind: tags (N,), nodes (N, n) by tag, and up to two tags of groups."""

    kind: str
    tags: np.ndarray
    nodes: np.ndarray
    groups: np.ndarray


@dataclass
class _State:
    """What was read so far; data by name are tags (N,) and values (N, ...)."""

    node_tags: np.ndarray | None = None
    vertices: np.ndarray | None = None
    elements: list[_Elements] = field(default_factory=list)
    data: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = field(
        default_factory=lambda: {"NodeData": {}, "ElementData": {}}
    )


def read(path: Path) -> Content:
    """Read a .msh file.

    Args:
        path: The file.

    Returns:
        Its content. ``gmsh:physical`` and ``gmsh:geometrical`` are cell data where the elements of a file of format 2
        carry them. Element data are NaN for elements that the file has none for.

    Raises:
        MeshError: The file is damaged or of another version.
    """
    with open(path, "rb") as file:
        source = Source(path, file)
        state = _State()
        version, data_size = _read_format(source)
        while (line := source.next_line()) is not None:
            if not line.startswith("$"):
                raise source.damaged(f"{line[:40]!r} stands where a section should begin")
            _read_section(source, state, line[1:], version, data_size)
    return _content(source, state)


def _read_format(source: Source) -> tuple[int, int]:
    line = source.next_line()
    while line == "$Comments":
        source.until(b"$EndComments", "comments")
        line = source.next_line()
    words = source.words("the format", 3) if line == "$MeshFormat" else []
    if not words or words[1] not in ("0", "1"):
        raise source.damaged("it does not begin as Gmsh's files do")
    if not words[0].startswith("2") and words[0] not in ("4", "4.1"):
        raise MeshError(f"{source.path} is of Gmsh's format {words[0][:20]}; save it again in format 4.1 or 2.2.")
    source.text = words[1] == "0"
    if not source.text:
        one = source.take(4, "the mark of the byte order")
        if one not in (b"\1\0\0\0", b"\0\0\0\1"):
            raise source.damaged("the mark of the byte order is missing")
        source.order = "<" if one[0] else ">"
    source.until(b"$EndMeshFormat", "the format")
    if words[2] not in ("4", "8"):
        raise source.damaged(f"its numbers have {words[2][:20]!r} bytes")
    return int(words[0][0]), int(words[2])


def _read_section(source: Source, state: _State, name: str, version: int, data_size: int) -> None:
    if name == "Nodes":
        if state.vertices is not None:
            raise source.damaged("it has two lists of nodes")
        read_nodes = _read_nodes_2 if version == 2 else _read_nodes_4
        state.node_tags, state.vertices = read_nodes(source, data_size)
    elif name == "Elements":
        if version == 2:
            state.elements += _read_elements_2_text(source) if source.text else _read_elements_2_binary(source)
        else:
            state.elements += _read_elements_4(source, data_size)
    elif name in state.data:
        label, tags, values = _read_data(source)
        state.data[name][label] = (tags, values)
    source.until(b"$End" + name.encode(), f"the section {name[:40]!r} does")


def _read_nodes_2(source: Source, _: int) -> tuple[np.ndarray, np.ndarray]:
    return _tagged(source, source.count(source.words("the number of nodes")[0], "nodes"), 3, "nodes")


def _tagged(source: Source, count: int, columns: int, what: str) -> tuple[np.ndarray, np.ndarray]:
    """(count,) tags, each followed by numbers: (count, columns)."""
    if source.text:
        rows = source.numbers(count * (columns + 1), "f8", what).reshape(count, columns + 1)
        return as_indices(source.path, rows[:, 0]), rows[:, 1:]
    record = np.dtype([("tag", source.order + "i4"), ("values", source.order + "f8", (columns,))])
    records = source.records(count, record, what)
    return records["tag"].astype(np.int64), records["values"].astype(np.float64)


def _read_elements_2_text(source: Source) -> list[_Elements]:
    count = source.count(source.words("the number of elements")[0], "elements")
    start = source.position()
    numbers = parse_numbers(source.path, source.until(b"$EndElements", "elements"), np.int64)
    source.seek(start)  # the caller looks for the end
    starts: dict[tuple[int, int], list[int]] = {}
    position, rows = 0, numbers.tolist()
    for _ in range(count):
        if position + 3 > len(rows):
            raise source.damaged("elements are missing")
        kind, groups = rows[position + 1], rows[position + 2]
        size = 3 + groups + _kind(source, kind)[1]
        if groups < 0 or position + size > len(rows):
            raise source.damaged("an element's indices are missing")
        starts.setdefault((kind, groups), []).append(position)
        position += size
    if position != len(rows):
        raise source.damaged("there are more elements than announced")
    found = []
    for (kind, groups), begin in starts.items():
        name, size = _kind(source, kind)
        table = numbers[np.array(begin)[:, None] + np.arange(3 + groups + size)]
        found.append(_Elements(name, table[:, 0], table[:, 3 + groups :], table[:, 3 : 3 + min(groups, 2)]))
    return found


def _read_elements_2_binary(source: Source) -> list[_Elements]:
    left = source.count(source.words("the number of elements")[0], "elements")
    found = []
    while left > 0:
        number, count, groups = source.numbers(3, "i4", "elements").tolist()
        name, size = _kind(source, number)
        if not 0 < count <= left or groups < 0:
            raise source.damaged("a block of elements has an impossible size")
        table = source.numbers(count * (1 + groups + size), "i4", "elements").reshape(count, 1 + groups + size)
        found.append(_Elements(name, table[:, 0], table[:, 1 + groups :], table[:, 1 : 1 + min(groups, 2)]))
        left -= count
    return found


def _read_nodes_4(source: Source, data_size: int) -> tuple[np.ndarray, np.ndarray]:
    blocks, total, _, _ = source.numbers(4, f"u{data_size}", "numbers of nodes").tolist()
    tags, vertices = [np.empty(0, np.int64)], [np.empty((0, 3))]
    for _ in range(blocks):
        dimension, _, parametric = source.numbers(3, "i4", "blocks of nodes").tolist()
        count = int(source.numbers(1, f"u{data_size}", "blocks of nodes")[0])
        if not 0 <= dimension <= 3:
            raise source.damaged("a block of nodes belongs to nothing")
        columns = 3 + dimension * bool(parametric)
        tags.append(_signed(source, source.numbers(count, f"u{data_size}", "tags of nodes")))
        vertices.append(source.numbers(count * columns, "f8", "nodes").reshape(count, columns)[:, :3])
    if sum(map(len, tags)) != total:
        raise source.damaged("its nodes are not as many as announced")
    return np.concatenate(tags), np.concatenate(vertices)


def _read_elements_4(source: Source, data_size: int) -> list[_Elements]:
    blocks, total, _, _ = source.numbers(4, f"u{data_size}", "numbers of elements").tolist()
    found = []
    for _ in range(blocks):
        _, entity, number = source.numbers(3, "i4", "blocks of elements").tolist()
        count = int(source.numbers(1, f"u{data_size}", "blocks of elements")[0])
        name, size = _kind(source, number)
        table = source.numbers(count * (1 + size), f"u{data_size}", "elements").reshape(count, 1 + size)
        table = _signed(source, table)
        found.append(_Elements(name, table[:, 0], table[:, 1:], np.full((count, 1), entity)))
    if sum(len(e.tags) for e in found) != total:
        raise source.damaged("its elements are not as many as announced")
    return found


def _read_data(source: Source) -> tuple[str, np.ndarray, np.ndarray]:
    strings = [source.line() or "" for _ in range(source.count(source.words("names")[0], "names"))]
    for _ in range(source.count(source.words("times")[0], "times")):
        source.line()
    integers = [source.words("sizes")[0] for _ in range(source.count(source.words("sizes")[0], "sizes"))]
    if not strings or len(integers) < 3:
        raise source.damaged("data lack their name or size")
    columns, count = source.count(integers[1], "components"), source.count(integers[2], "values")
    name = strings[0].strip('"')
    tags, values = _tagged(source, count, columns, f"values of {name[:40]!r}")
    return name, tags, values[:, 0] if columns == 1 else values


def _content(source: Source, state: _State) -> Content:
    if state.vertices is None or state.node_tags is None:
        raise source.damaged("it lacks its nodes")
    blocks, cell_tags, begin = [], [np.empty(0, np.int64)], 0
    for elements in state.elements:
        nodes = _positions(source, state.node_tags, elements.nodes.astype(np.int64), "an element uses a node")
        blocks.append(CellBlock(elements.kind, nodes, np.arange(begin, begin + len(nodes))))
        cell_tags.append(elements.tags.astype(np.int64))
        begin += len(nodes)
    point_data = {
        name: _spread(source, state.node_tags, *data, "data belong to a node")
        for name, data in state.data["NodeData"].items()
    }
    cell_data = _groups(state.elements)
    for name, data in state.data["ElementData"].items():
        cell_data[name] = _spread(source, np.concatenate(cell_tags), *data, "data belong to an element")
    return Content(state.vertices, tuple(blocks), point_data, cell_data)


def _groups(elements: list[_Elements]) -> dict[str, np.ndarray]:
    """Groups that elements belong to: both where all elements name both, the geometrical one of format 4.1."""
    columns = {e.groups.shape[1] for e in elements}
    names = {2: ("gmsh:physical", "gmsh:geometrical"), 1: ("gmsh:geometrical",)}.get(
        columns.pop() if len(columns) == 1 else 0, ()
    )
    return {name: np.concatenate([e.groups[:, i] for e in elements]) for i, name in enumerate(names)}


def _positions(source: Source, tags: np.ndarray, wanted: np.ndarray, what: str) -> np.ndarray:
    """Where tags stand in a list of tags in any order and with any gaps."""
    order = np.argsort(tags, kind="stable")
    ordered = tags[order]
    if (ordered[1:] == ordered[:-1]).any():
        raise source.damaged("two nodes or elements have one number")
    if not len(tags) and wanted.size:
        raise source.damaged(f"{what} that is not there")
    places = np.searchsorted(ordered, wanted).clip(max=max(len(tags) - 1, 0))
    if (ordered[places] != wanted).any():
        raise source.damaged(f"{what} that is not there")
    return order[places]


def _spread(source: Source, tags: np.ndarray, data_tags: np.ndarray, values: np.ndarray, what: str) -> np.ndarray:
    """Data in the order of the tags they belong to, NaN where there are none."""
    spread = np.full((len(tags), *values.shape[1:]), np.nan)
    spread[_positions(source, tags, data_tags, what)] = values
    return spread


def _kind(source: Source, number: int) -> tuple[str, int]:
    if number not in _KINDS:
        raise source.damaged(f"it has elements of the unknown type {number}")
    return _KINDS[number]


def _signed(source: Source, tags: np.ndarray) -> np.ndarray:
    if tags.size and tags.max() > 2**62:
        raise source.damaged("a tag is larger than any that there can be")
    return tags.astype(np.int64)
