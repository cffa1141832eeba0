"""Cells as VTK numbers and lists them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from difftetvr.mesh.io.content import CellBlock, damaged

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
}
"""Name and number of nodes of a kind, by VTK's number."""

_FLAT_KINDS_OF_ANY_SIZE = {0, 2, 4, 6, 7, 36, 68, 69, 70, 75, 76, 77}
_VOXEL = 11
_VOXEL_ORDER = [0, 1, 3, 2, 4, 5, 7, 6]


def blocks(
    path: Path, types: np.ndarray, connectivity: np.ndarray, offsets: np.ndarray | None
) -> tuple[CellBlock, ...]:
    """Cells by kind.

    Args:
        path: The file, for sentences.
        types: (N,) VTK's numbers of the cells' kinds.
        connectivity: (M,) vertex indices of all cells in turn.
        offsets: (N + 1,) where a cell's indices begin and end; None where each cell's indices follow their number.

    Returns:
        One block for each kind; kinds that VTK's numbers do not fix the size of have no nodes.

    Raises:
        MeshError: The arrays do not fit each other.
    """
    if offsets is None:
        starts, sizes = _interleaved(path, types, connectivity)
    else:
        if len(offsets) != len(types) + 1:
            raise damaged(path, f"it has {len(offsets)} offsets for {len(types)} cells")
        starts, sizes = offsets[:-1].astype(np.int64), np.diff(offsets.astype(np.int64))
    if len(types) and (starts.min() < 0 or sizes.min() < 0 or (starts + sizes).max() > len(connectivity)):
        raise damaged(path, "a cell's indices lie outside the list of indices")
    found = []
    for number in np.unique(types).tolist():
        rows = np.flatnonzero(types == number)
        if number in _FLAT_KINDS_OF_ANY_SIZE:
            found.append(CellBlock("polygon", np.empty((len(rows), 0), np.int64), rows))
            continue
        kind, size = _KINDS.get(number, (f"VTK cell type {number}", 0))
        if size and (sizes[rows] != size).any():
            raise damaged(path, f"a cell of type '{kind}' has not {size} vertices")
        nodes = connectivity[starts[rows][:, None] + np.arange(size)]
        found.append(CellBlock(kind, nodes[:, _VOXEL_ORDER] if number == _VOXEL else nodes, rows))
    return tuple(found)


def structured_hexahedra(shape: tuple[int, int, int]) -> np.ndarray:
    """Hexahedra between the points of a grid, x running fastest: ((nx - 1)(ny - 1)(nz - 1), 8) int64."""
    nx, ny, nz = shape
    points = np.arange(nx * ny * nz).reshape(nz, ny, nx)
    corners = [
        points[z : nz - 1 + z, y : ny - 1 + y, x : nx - 1 + x]
        for z in (0, 1)
        for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))
    ]
    return np.stack([corner.ravel() for corner in corners], 1)


def _interleaved(path: Path, types: np.ndarray, connectivity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Starts and sizes of cells whose indices follow their number."""
    fixed = np.zeros(256, np.int64)
    fixed[list(_KINDS)] = [size for _, size in _KINDS.values()]
    sizes = fixed[np.clip(types, 0, 255)]
    if (sizes == 0).any():
        sizes = _walk(path, len(types), connectivity)
    starts = np.cumsum(sizes + 1) - sizes
    if len(types) and starts[-1] + sizes[-1] > len(connectivity):
        raise damaged(path, "the list of indices ends before its last cell")
    if (connectivity[starts - 1] != sizes).any():
        raise damaged(path, "a cell's number of vertices is not that of its type")
    return starts, sizes


def _walk(path: Path, count: int, connectivity: np.ndarray) -> np.ndarray:
    """Sizes of cells that only reading one after the other can find."""
    numbers, position, sizes = connectivity.tolist(), 0, []
    for _ in range(count):
        if position >= len(numbers) or numbers[position] < 0:
            raise damaged(path, "the list of indices ends before its last cell")
        sizes.append(numbers[position])
        position += numbers[position] + 1
    return np.array(sizes, np.int64)
