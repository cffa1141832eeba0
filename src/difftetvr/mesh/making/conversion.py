"""Tetrahedra from other cells: hexahedra, wedges and their kin are split, cells of higher order are straightened.

Every face with more than three corners is cut into the fan of its smallest vertex index. Both cells at a face see the
same indices, so they agree without knowing of each other, whatever the order of cells and corners.
"""

from __future__ import annotations

import numpy as np


def _prism_faces(n: int) -> tuple[tuple[int, ...], ...]:
    sides = tuple((i, (i + 1) % n, (i + 1) % n + n, i + n) for i in range(n))
    return (tuple(range(n)), tuple(range(n, 2 * n)), *sides)


FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "tetra": ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)),
    "pyramid": ((0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    "wedge": _prism_faces(3),
    "hexahedron": _prism_faces(4),
    "pentagonal prism": _prism_faces(5),
    "hexagonal prism": _prism_faces(6),
}
"""Corners of each face, in turn around it, of the kinds of cells that are split, and of tetrahedra."""

PIECES = "polyhedron"
"""Kind of a block whose rows are tetrahedra that fill polyhedra, several of them each: see `polyhedra`."""

_CORNERS = {kind: 1 + max(map(max, faces)) for kind, faces in FACES.items()} | {PIECES: 4}


def is_convertible(kind: str) -> bool:
    """Whether :func:`to_tetrahedra` takes cells of a kind."""
    linear = linear_kind(kind)
    return kind in _CORNERS or (linear in FACES and num_nodes(kind) > _CORNERS[linear])


def linear_kind(kind: str) -> str:
    """The kind of cells with the same corners and no further nodes."""
    return kind.rstrip("0123456789")


def num_nodes(kind: str) -> int:
    """Number of nodes of a cell of a convertible kind."""
    linear = linear_kind(kind)
    return int(kind.removeprefix(linear) or _CORNERS[linear])


def is_curved(kind: str) -> bool:
    """Whether cells of a kind have nodes besides their corners, which straightening leaves out."""
    return num_nodes(kind) > _CORNERS[linear_kind(kind)]


def to_tetrahedra(kind: str, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra that fill cells of one kind, cut so that all cells of a mesh fit together.

    A cell is the fan of its smallest vertex over the triangles of the faces that do not hold it: 6 tetrahedra of a
    hexahedron, 3 of a wedge, 2 of a pyramid. Faces need not be plane. A cell that repeats vertices, as a hexahedron
    that stands for a wedge does, also gives tetrahedra that repeat one and fill nothing.

    Args:
        kind: A key of `FACES`, followed by its number of nodes where it is of higher order (tetra10); or `PIECES`.
        nodes: (N, n) integer vertex indices in the order of VTK or Gmsh; corners first.

    Returns:
        (T, 4) tetrahedra, of either orientation, and (T,) int64 rows of ``nodes`` that they are pieces of, ascending.
    """
    linear = linear_kind(kind)
    corners = nodes[:, : _CORNERS[linear]]
    if _CORNERS[linear] == 4:
        return corners, np.arange(len(corners))
    apex = corners.argmin(1)
    pieces, parents = [], []
    for face in FACES[linear]:
        rows = np.flatnonzero(~np.isin(apex, face))
        for triangle in fans(corners[rows][:, face]):
            pieces.append(np.column_stack((corners[rows, apex[rows]], triangle)))
            parents.append(rows)
    order = np.argsort(np.concatenate(parents), kind="stable")
    return np.concatenate(pieces)[order], np.concatenate(parents)[order]


def fans(faces: np.ndarray) -> list[np.ndarray]:
    """Triangles of polygons, cut at their smallest vertex.

    Args:
        faces: (N, n) vertex indices in turn around each polygon; triangles stay as they are.

    Returns:
        n - 2 arrays (N, 3): one triangle of each polygon.
    """
    count = faces.shape[1]
    if count == 3:
        return [faces]
    first = faces.argmin(1)[:, None]
    rolled = np.take_along_axis(faces, (first + np.arange(count)) % count, 1)
    return [rolled[:, [0, i, i + 1]] for i in range(1, count - 1)]
