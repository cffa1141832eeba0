"""Cells as VTK numbers and lists them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from difftetvr.errors import counted
from difftetvr.mesh.io.content import CellBlock, damaged
from difftetvr.mesh.io.formats.vtk.faces import NO_POLYHEDRA, from_stream
from difftetvr.mesh.making.conversion import PIECES, num_nodes
from difftetvr.mesh.making.polyhedra import Polyhedra, recognised, runs, split

_KINDS = {
    1: ("vertex", 1),
    3: ("line", 2),
    5: ("triangle", 3),
    8: ("quad", 4),
    9: ("quad", 4),
    10: ("tetra", 4),
    11: ("hexahedron", 8),
    12: ("hexahedron", 8),
    13: ("wedge", 6),
    14: ("pyramid", 5),
    15: ("pentagonal prism", 10),
    16: ("hexagonal prism", 12),
    21: ("line3", 3),
    22: ("triangle6", 6),
    23: ("quad8", 8),
    24: ("tetra10", 10),
    25: ("hexahedron20", 20),
    26: ("wedge15", 15),
    27: ("pyramid13", 13),
    28: ("quad9", 9),
    29: ("hexahedron27", 27),
    30: ("quad6", 6),
    31: ("wedge12", 12),
    32: ("wedge18", 18),
    33: ("hexahedron24", 24),
    34: ("triangle7", 7),
    35: ("line4", 4),
    37: ("pyramid19", 19),
}
"""Name and number of nodes of a kind, by VTK's number."""

_OF_ANY_ORDER = {
    **dict(zip((71, 72, 73, 74), ("tetra", "hexahedron", "wedge", "pyramid"))),  # Lagrange
    **dict(zip((78, 79, 80, 81), ("tetra", "hexahedron", "wedge", "pyramid"))),  # Bezier
}
"""Kinds with the same corners, by VTK's number; how many nodes follow these is for the order to say."""

_FLAT_OF_ANY_SIZE = (0, 2, 4, 6, 7, 36, 68, 69, 70, 75, 76, 77)
_FLAT = np.array([*_FLAT_OF_ANY_SIZE, 1, 3, 5, 8, 9, 21, 22, 23, 28, 30, 34, 35])
_EMPTY, _VOXEL, _POLYHEDRON = 0, 11, 42
_VOXEL_ORDER = [0, 1, 3, 2, 4, 5, 7, 6]


@dataclass(frozen=True)
class Cells:
    """Cells of all kinds.

    Attributes:
        types: (N,) VTK's numbers of their kinds.
        nodes: (M,) int64 vertex indices of all cells in turn; unchecked.
        offsets: (N + 1,) int64 where each cell's indices begin and end.
        polyhedra: Those of VTK's type 42, in their order; what ``nodes`` has of them is of no account.
    """

    types: np.ndarray
    nodes: np.ndarray
    offsets: np.ndarray
    polyhedra: Polyhedra = NO_POLYHEDRA

    @property
    def are_polyhedra(self) -> np.ndarray:
        """(N,) which cells are given by their faces."""
        return self.types == _POLYHEDRON

    @property
    def have_volume(self) -> np.ndarray:
        """(N,) which cells are of kinds that are no points, lines or surfaces."""
        return ~np.isin(self.types, _FLAT)

    def without(self, left_out: np.ndarray) -> Cells:
        """The same cells with some, (N,) truth values, emptied; all keep their rows."""
        kept = np.flatnonzero(~left_out[self.are_polyhedra])
        types = np.where(left_out, _EMPTY, self.types)
        return replace(self, types=types, polyhedra=self.polyhedra.taken(kept))


def checked(
    path: Path, types: np.ndarray, nodes: np.ndarray, offsets: np.ndarray, polyhedra: Polyhedra = NO_POLYHEDRA
) -> Cells:
    """Cells whose arrays fit each other; see `Cells`.

    Raises:
        MeshError: They do not.
    """
    nodes, offsets = nodes.astype(np.int64, copy=False), offsets.astype(np.int64, copy=False)
    if len(offsets) != len(types) + 1:
        raise damaged(path, f"it has {len(offsets)} offsets for {len(types)} cells")
    if offsets[0] < 0 or (np.diff(offsets) < 0).any() or offsets[-1] > len(nodes):
        raise damaged(path, "a cell's indices lie outside the list of indices")
    return Cells(types, nodes, offsets, polyhedra)


def from_legacy(path: Path, types: np.ndarray, nodes: np.ndarray, offsets: np.ndarray | None) -> Cells:
    """Cells of a legacy file, where polyhedra list their faces in place of their vertices.

    Args:
        path: The file, for sentences.
        types: (N,) VTK's numbers of the cells' kinds.
        nodes: (M,) vertex indices of all cells in turn.
        offsets: (N + 1,) where a cell's indices begin and end; None where each cell's indices follow their number.

    Raises:
        MeshError: The arrays do not fit each other.
    """
    if offsets is None:
        nodes, offsets = _without_numbers(path, types, nodes)
    cells = checked(path, types, nodes, offsets)
    rows = np.flatnonzero(cells.are_polyhedra)
    polyhedra = from_stream(path, cells.nodes, cells.offsets[rows], cells.offsets[rows + 1])
    return replace(cells, polyhedra=polyhedra)


def blocks(path: Path, cells: Cells, points: np.ndarray) -> tuple[tuple[CellBlock, ...], tuple[str, ...]]:
    """Cells by kind.

    Args:
        path: The file, for sentences.
        cells: The cells.
        points: (V, 3) positions.

    Returns:
        One block for each kind, with no nodes where VTK's number does not fix the kind's size; and sentences about
        polyhedra that do not split well.

    Raises:
        MeshError: A cell has not as many vertices as cells of its kind.
    """
    found: list[CellBlock] = []
    notes: tuple[str, ...] = ()
    sizes = np.diff(cells.offsets)
    for number in np.unique(cells.types).tolist():
        rows = np.flatnonzero(cells.types == number)
        if number == _POLYHEDRON:
            of_faces, notes = _polyhedra_blocks(path, cells.polyhedra, rows, points)
            found += of_faces
        elif number in _OF_ANY_ORDER:
            for size in np.unique(sizes[rows]).tolist():
                kind = _kind_of_size(path, _OF_ANY_ORDER[number], size)
                found.append(_block(cells, kind, size, rows[sizes[rows] == size]))
        elif number in _FLAT_OF_ANY_SIZE:
            found.append(_block(cells, "polygon", 0, rows))
        else:
            kind, size = _KINDS.get(number, (f"VTK cell type {number}", 0))
            if size and (sizes[rows] != size).any():
                raise damaged(path, f"a cell of type '{kind}' has not {size} vertices")
            block = _block(cells, kind, size, rows)
            found.append(replace(block, nodes=block.nodes[:, _VOXEL_ORDER]) if number == _VOXEL else block)
    return tuple(found), notes


def _block(cells: Cells, kind: str, size: int, rows: np.ndarray) -> CellBlock:
    return CellBlock(kind, cells.nodes[cells.offsets[rows][:, None] + np.arange(size)], rows)


def _kind_of_size(path: Path, linear: str, size: int) -> str:
    corners = num_nodes(linear)
    if size < corners:
        raise damaged(path, f"a cell of type '{linear}' of any order has only {size} vertices")
    return linear if size == corners else f"{linear}{size}"


def _polyhedra_blocks(
    path: Path, polyhedra: Polyhedra, rows: np.ndarray, points: np.ndarray
) -> tuple[list[CellBlock], tuple[str, ...]]:
    if len(polyhedra) != len(rows):
        raise damaged(path, f"it lists the faces of {len(polyhedra)} polyhedra, but has {len(rows)}")
    if polyhedra.nodes.min() < 0 or polyhedra.nodes.max() >= len(points):
        raise damaged(path, "a vertex index of a polyhedron's face is out of range")
    simple, others = recognised(polyhedra)
    found = [CellBlock(kind, corners, rows[which]) for kind, (which, corners) in simple.items()]
    if not len(others):
        return found, ()
    tets, parents, overlap = split(polyhedra.taken(others), points.astype(np.float64))
    found.append(CellBlock(PIECES, tets, rows[others[parents]]))
    bad = int((overlap > 0).sum())
    if not bad:
        return found, ()
    return found, (
        f"{counted(bad, 'polyhedron', 'polyhedra')} of {len(rows):,} cannot be split into tetrahedra that do not "
        f"overlap, by up to {100 * min(float(overlap.max()), 1.0):.2g} % of {'its' if bad == 1 else 'their'} volume.",
    )


def _without_numbers(path: Path, types: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices and offsets of cells whose indices follow their number."""
    fixed = np.zeros(256, np.int64)
    fixed[list(_KINDS)] = [size for _, size in _KINDS.values()]
    sizes = fixed[np.clip(types, 0, 255)]
    if (sizes == 0).any():
        sizes = _walk(path, len(types), numbers)
    starts = np.cumsum(sizes + 1) - sizes
    if len(types) and starts[-1] + sizes[-1] > len(numbers):
        raise damaged(path, "the list of indices ends before its last cell")
    if (numbers[starts - 1] != sizes).any():
        raise damaged(path, "a cell's number of vertices is not that of its type")
    picked, offsets = runs(starts, sizes)
    return numbers[picked], offsets


def _walk(path: Path, count: int, connectivity: np.ndarray) -> np.ndarray:
    """Sizes of cells that only reading one after the other can find."""
    numbers, position, sizes = connectivity.tolist(), 0, []
    for _ in range(count):
        if position >= len(numbers) or numbers[position] < 0:
            raise damaged(path, "the list of indices ends before its last cell")
        sizes.append(numbers[position])
        position += numbers[position] + 1
    return np.array(sizes, np.int64)
