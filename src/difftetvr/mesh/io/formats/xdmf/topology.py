"""Points and cells of one grid of an XDMF file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import CellBlock, damaged
from difftetvr.mesh.io.formats.vtk.structured import hexahedra
from difftetvr.mesh.io.formats.xdmf.items import Items

_KINDS = {
    1: ("vertex", 1),
    2: ("line", 2),
    4: ("triangle", 3),
    5: ("quad", 4),
    6: ("tetra", 4),
    7: ("pyramid", 5),
    8: ("wedge", 6),
    9: ("hexahedron", 8),
    0x22: ("line3", 3),
    0x23: ("quad9", 9),
    0x24: ("triangle6", 6),
    0x25: ("quad8", 8),
    0x26: ("tetra10", 10),
    0x27: ("pyramid13", 13),
    0x28: ("wedge15", 15),
    0x29: ("wedge18", 18),
    0x30: ("hexahedron20", 20),
    0x31: ("hexahedron24", 24),
    0x32: ("hexahedron27", 27),
    0x33: ("hexahedron64", 64),
    0x34: ("hexahedron125", 125),
}
"""Name and number of nodes of a kind, by XDMF's number."""

_NAMES = {
    "edge": "line",
    "tri": "triangle",
    "triangle": "triangle",
    "quad": "quad",
    "quadrilateral": "quad",
    "tet": "tetra",
    "tetrahedron": "tetra",
    "pyramid": "pyramid",
    "wedge": "wedge",
    "hex": "hexahedron",
    "hexahedron": "hexahedron",
}
"""XDMF's names of families of kinds, in lower case."""

_POLYVERTEX, _POLYLINE, _POLYGON, _POLYHEDRON = 1, 2, 3, 16
_SIZE_FOLLOWS = (_POLYVERTEX, _POLYLINE, _POLYGON, _POLYHEDRON)
_NUMBERS = {
    "polyvertex": _POLYVERTEX,
    "polyline": _POLYLINE,
    "polygon": _POLYGON,
    "polyhedron": _POLYHEDRON,
    **{name: number for name, family in _NAMES.items() for number, (kind, _) in _KINDS.items() if kind == family},
    **{
        f"{name}_{size}": number
        for name, family in _NAMES.items()
        for number, (kind, size) in _KINDS.items()
        if kind.startswith(family)
    },
}
"""XDMF's number of a kind, by its names in lower case."""

_STRUCTURED = ("3dsmesh", "3drectmesh", "3dcorectmesh")


@dataclass(frozen=True)
class Shape:
    """Points (V, 3) and cells, whose rows count the cells of this grid."""

    vertices: np.ndarray
    cells: tuple[CellBlock, ...]

    @property
    def num_cells(self) -> int:
        """Number of cells of all kinds."""
        return sum(len(block.rows) for block in self.cells)


def shape_of(items: Items, topology: Element, geometry: Element) -> Shape:
    """Points and cells of a grid.

    Args:
        items: Reads arrays.
        topology: Its element Topology.
        geometry: Its element Geometry.

    Raises:
        MeshError: They are damaged, or of a kind that is not read.
    """
    name = _attribute(topology, "TopologyType").lower()
    if name in _STRUCTURED:
        words = (topology.get("Dimensions") or topology.get("NumberOfElements") or "").split()
        if len(words) != 3 or not all(word.isascii() and word.isdigit() and len(word) < 10 for word in words):
            raise damaged(items.path, "a structured grid lacks its dimensions")
        nz, ny, nx = map(int, words)
        vertices = _structured_points(items, geometry, (nx, ny, nz))
        if min(nx, ny, nz) < 2 or len(vertices) != nx * ny * nz:
            raise damaged(items.path, f"a structured grid of {nx} x {ny} x {nz} points has {len(vertices)} points")
        corners = hexahedra((nx, ny, nz)).nodes.reshape(-1, 8)
        return Shape(vertices, (CellBlock("hexahedron", corners, np.arange(len(corners))),))
    return Shape(_points(items, geometry), _cells(items, topology, name))


def _attribute(element: Element, name: str) -> str:
    return element.get(name, element.get("Type", ""))


def _points(items: Items, geometry: Element) -> np.ndarray:
    kind, arrays = _attribute(geometry, "GeometryType").upper() or "XYZ", items.of(geometry)
    if kind == "XY" or (kind == "XYZ" and arrays and arrays[0].ndim == 2 and arrays[0].shape[1] == 2):
        raise MeshError(f"{items.path} is no mesh of three dimensions; give a volume mesh.")
    if kind == "X_Y_Z" and len(arrays) == 3 and len({values.size for values in arrays}) == 1:
        return np.column_stack([values.ravel() for values in arrays])
    if kind != "XYZ":
        raise MeshError(f"{items.path} has points of the kind {kind[:40]!r}, which is not read; write them as XYZ.")
    if len(arrays) != 1 or arrays[0].size % 3:
        raise damaged(items.path, "its points are no array of three numbers each")
    return arrays[0].reshape(-1, 3)


def _structured_points(items: Items, geometry: Element, shape: tuple[int, int, int]) -> np.ndarray:
    kind, arrays = _attribute(geometry, "GeometryType").upper(), items.of(geometry)
    if kind == "ORIGIN_DXDYDZ" and [values.size for values in arrays] == [3, 3]:
        origin, spacing = (values.ravel()[::-1].astype(np.float64) for values in arrays)  # both are z, y, x
        axes = [origin[i] + spacing[i] * np.arange(shape[i]) for i in range(3)]
    elif kind == "VXVYVZ" and len(arrays) == 3:
        axes = [values.ravel() for values in arrays]
    else:
        return _points(items, geometry)
    if [len(axis) for axis in axes] != list(shape):
        raise damaged(items.path, "the axes of a structured grid have other lengths than it")
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def _cells(items: Items, topology: Element, name: str) -> tuple[CellBlock, ...]:
    arrays = items.of(topology)
    if len(arrays) != 1 or arrays[0].dtype.kind not in "iu":
        raise damaged(items.path, "its cells are no array of integers")
    base, order = _base(items, topology), topology.get("Order", "").split()
    nodes = arrays[0].astype(np.int64)
    if name == "mixed":
        if order:
            raise damaged(items.path, "cells of several kinds have one order of nodes")
        return tuple(CellBlock(b.kind, b.nodes - base, b.rows) for b in _mixed(items.path, nodes.ravel()))
    number = int(name) if name.isascii() and name.isdigit() and len(name) < 9 else _NUMBERS.get(name, 0)
    if number == _POLYHEDRON or number not in (*_KINDS, _POLYGON):
        raise MeshError(f"{items.path} has cells of the kind {name[:40]!r}, which is not read; write tetrahedra.")
    kind, size = _KINDS.get(number, ("polygon", 0))
    per_element = topology.get("NodesPerElement", "")
    if number in _SIZE_FOLLOWS and per_element.isascii() and per_element.isdigit() and int(per_element[:9]):
        size = int(per_element[:9])
        kind = kind if size == _KINDS.get(number, ("", 0))[1] else "polygon"
    if not size or nodes.size % size:
        raise damaged(items.path, f"{nodes.size} indices make no cells of the kind {kind!r}")
    table = nodes.reshape(-1, size) - base
    if order:
        if sorted(order) != sorted(map(str, range(size))):
            raise damaged(items.path, f"{' '.join(order)[:40]!r} is no order of {size} nodes")
        table = table[:, list(map(int, order))]
    return (CellBlock(kind, table, np.arange(len(table))),)


def _base(items: Items, topology: Element) -> int:
    """The index of the first point."""
    arrays = [child for child in items.document.children(topology) if child.tag == "DataItem"]
    text = next((text for e in (topology, *arrays) if (text := e.get("BaseOffset"))), "0")
    if not text.isascii() or not text.isdigit() or len(text) > 18:
        raise damaged(items.path, f"{text[:40]!r} is no index of its first point")
    return int(text)


def _mixed(path: Path, numbers: np.ndarray) -> tuple[CellBlock, ...]:
    """Cells of several kinds: the number of a cell's kind, how many nodes where that is open, the nodes."""
    words, position, row = numbers.tolist(), 0, 0
    begins: dict[tuple[int, int], list[tuple[int, int]]] = {}
    while position < len(words):
        number, begin = words[position], position + 1
        size = _KINDS.get(number, ("", 0))[1]
        if number in _SIZE_FOLLOWS and begin < len(words):
            size, begin = words[begin], begin + 1
        elif number not in _KINDS:
            raise damaged(path, f"it has cells of the unknown type {number}")
        if number == _POLYHEDRON:
            begin, size = _after_faces(words, begin, size), 0
        if size < 0 or begin < 0 or begin + size > len(words):
            raise damaged(path, "its list of cells ends before the last one")
        begins.setdefault((number, size), []).append((begin, row))
        position, row = begin + size, row + 1
    return tuple(_block(numbers, number, size, np.array(found)) for (number, size), found in begins.items())


def _block(numbers: np.ndarray, number: int, size: int, found: np.ndarray) -> CellBlock:
    kind, usual = _KINDS.get(number, ("polyhedron" if number == _POLYHEDRON else "polygon", size))
    nodes = numbers[found[:, :1] + np.arange(size)]
    return CellBlock(kind if size == usual else "polygon", nodes, found[:, 1])


def _after_faces(words: list[int], position: int, count: int) -> int:
    """Where the faces of a polyhedron end; -1 where the list does."""
    for _ in range(max(count, 0)):
        if position >= len(words) or words[position] < 0:
            return -1
        position += 1 + words[position]
    return position
