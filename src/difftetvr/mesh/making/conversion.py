"""Tetrahedra from other cells: hexahedra, wedges and pyramids are split, quadratic cells are straightened.

Every face with four corners is cut along the diagonal through its smallest vertex index. Both cells at a face see the
same indices, so they agree without knowing of each other, whatever the order of cells and corners.
"""

from __future__ import annotations

import numpy as np

_FACES = {
    "hexahedron": ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedge": ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
_CORNERS = {"tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5}
_LINEAR = {
    "tetra10": "tetra",
    "hexahedron20": "hexahedron",
    "hexahedron24": "hexahedron",
    "hexahedron27": "hexahedron",
    "wedge12": "wedge",
    "wedge15": "wedge",
    "wedge18": "wedge",
    "pyramid13": "pyramid",
    "pyramid14": "pyramid",
}

CONVERTIBLE = (*_CORNERS, *_LINEAR)
"""Kinds of cells that :func:`to_tetrahedra` takes, by meshio's names."""


def num_nodes(kind: str) -> int:
    """Number of nodes of a cell of a kind, one of `CONVERTIBLE`."""
    linear = _LINEAR.get(kind)
    return _CORNERS[kind] if linear is None else int(kind.removeprefix(linear))


def is_quadratic(kind: str) -> bool:
    """Whether cells of a kind have nodes besides their corners, which straightening leaves out."""
    return kind in _LINEAR


def to_tetrahedra(kind: str, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra that fill cells of one kind, cut so that all cells of a mesh fit together.

    A cell is the fan of its smallest vertex over the triangles of the faces that do not hold it: 6 tetrahedra of a
    hexahedron, 3 of a wedge, 2 of a pyramid. Faces need not be plane. A cell that repeats vertices, as a hexahedron
    that stands for a wedge does, also gives tetrahedra that repeat one and fill nothing.

    Args:
        kind: One of `CONVERTIBLE`.
        nodes: (N, n) integer vertex indices in the order of VTK or Gmsh; corners first.

    Returns:
        (T, 4) tetrahedra, of either orientation, and (T,) int64 rows of ``nodes`` that they are pieces of, ascending.
    """
    linear = _LINEAR.get(kind, kind)
    corners = nodes[:, : _CORNERS[linear]]
    if linear == "tetra":
        return corners, np.arange(len(corners))
    apex = corners.argmin(1)
    pieces, parents = [], []
    for face in _FACES[linear]:
        rows = np.flatnonzero(~np.isin(apex, face))
        for triangle in _triangles(corners[rows][:, face]):
            pieces.append(np.column_stack((corners[rows, apex[rows]], triangle)))
            parents.append(rows)
    order = np.argsort(np.concatenate(parents), kind="stable")
    return np.concatenate(pieces)[order], np.concatenate(parents)[order]


def _triangles(faces: np.ndarray) -> list[np.ndarray]:
    """The faces' triangles: (N, 3) faces as they are, (N, 4) ones cut at their smallest vertex."""
    if faces.shape[1] == 3:
        return [faces]
    first = faces.argmin(1)[:, None]
    rolled = np.take_along_axis(faces, (first + np.arange(4)) % 4, 1)
    return [rolled[:, [0, 1, 2]], rolled[:, [0, 2, 3]]]
