"""Elements of Gmsh's files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import parse_numbers
from difftetvr.mesh.io.formats.gmsh.nodes import signed
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
    36: ("quad16", 16),
    37: ("quad25", 25),
    38: ("quad36", 36),
    90: ("wedge40", 40),
    91: ("wedge75", 75),
    92: ("hexahedron64", 64),
    93: ("hexahedron125", 125),
    118: ("pyramid30", 30),
    119: ("pyramid55", 55),
}
"""Name and number of nodes of a kind, by Gmsh's number."""


@dataclass
class Elements:
    """Elements of one kind.

    Attributes:
        kind: Its name.
        tags: (N,) int64 numbers of the elements.
        nodes: (N, n) int64 tags of their nodes.
        groups: (N, k) int64: in format 2 up to two tags of groups, physical and geometrical; in format 4 the dimension
            and the tag of the entity.
    """

    kind: str
    tags: np.ndarray
    nodes: np.ndarray
    groups: np.ndarray


def read_elements_2(source: Source) -> list[Elements]:
    """Elements of format 2."""
    count = source.count(source.words("the number of elements")[0], "elements")
    return joined(_text_2(source, count) if source.text else _binary_2(source, count))


def read_elements_4(source: Source, data_size: int | None) -> list[Elements]:
    """Elements of format 4.1, or of 4.0 where the size of numbers is None."""
    sizes, tag_type = (2, "i4") if data_size is None else (4, f"u{data_size}")
    count_type = f"u{data_size or 8}"
    blocks, total, *_ = source.numbers(sizes, count_type, "numbers of elements").tolist()
    found = []
    for _ in range(blocks):
        first, second, number = source.numbers(3, "i4", "blocks of elements").tolist()
        dimension, entity = (second, first) if data_size is None else (first, second)
        count = int(source.numbers(1, count_type, "blocks of elements")[0])
        name, size = _kind(source, number)
        table = source.numbers(count * (1 + size), tag_type, "elements").reshape(count, 1 + size)
        table = signed(source, table)
        groups = np.tile(np.array([[dimension, entity]]), (count, 1))
        found.append(Elements(name, table[:, 0], table[:, 1:], groups))
    if sum(len(e.tags) for e in found) != total:
        raise source.damaged("its elements are not as many as announced")
    return joined(found)


def joined(elements: list[Elements]) -> list[Elements]:
    """Elements of one kind that follow each other as one, as far as they have equally many tags of groups."""
    runs: list[list[Elements]] = []
    for e in elements:
        if runs and (runs[-1][0].kind, runs[-1][0].groups.shape[1]) == (e.kind, e.groups.shape[1]):
            runs[-1].append(e)
        else:
            runs.append([e])
    return [
        Elements(
            run[0].kind,
            np.concatenate([e.tags for e in run]).astype(np.int64),
            np.concatenate([e.nodes for e in run]).astype(np.int64),
            np.concatenate([e.groups for e in run]).astype(np.int64),
        )
        for run in runs
    ]


def _text_2(source: Source, count: int) -> list[Elements]:
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
        found.append(Elements(name, table[:, 0], table[:, 3 + groups :], table[:, 3 : 3 + min(groups, 2)]))
    return found


def _binary_2(source: Source, left: int) -> list[Elements]:
    found = []
    while left > 0:
        start = source.position()
        number, count, groups = source.numbers(3, "i4", "elements").tolist()
        name, size = _kind(source, number)
        if not 0 < count <= left or not 0 <= groups < source.size:
            raise source.damaged("a block of elements has an impossible size")
        if count == 1:
            source.seek(start)
            table = _blocks_of_one(source, left, 4 + groups + size)[:, 3:]
        else:
            table = source.numbers(count * (1 + groups + size), "i4", "elements").reshape(count, 1 + groups + size)
        found.append(Elements(name, table[:, 0], table[:, 1 + groups :], table[:, 1 : 1 + min(groups, 2)]))
        left -= len(table)
    return found


def _blocks_of_one(source: Source, most: int, width: int) -> np.ndarray:
    """(N, width) numbers of as many blocks with the head of the first as follow each other; Gmsh writes such."""
    found: list[np.ndarray] = []
    count = 1
    while most > 0:
        start = source.position()
        # Twice as many each time: little is read in vain where heads change.
        count = min(2 * count, most, max((source.size - start) // (4 * width), 1))
        rows = source.numbers(count * width, "i4", "elements").reshape(count, width)
        found.append(rows)
        alike = (rows[:, :3] == found[0][0, :3]).all(1)
        if not alike.all():
            found[-1] = rows[: alike.argmin()]
            source.seek(start + 4 * width * len(found[-1]))
            break
        most -= count
    return np.concatenate(found)


def _kind(source: Source, number: int) -> tuple[str, int]:
    if number not in _KINDS:
        raise MeshError(f"{source.path} has elements of Gmsh's type {number}, which is not read; save linear elements.")
    return _KINDS[number]
