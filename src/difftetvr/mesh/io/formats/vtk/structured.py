"""Structured grids: points in rows, columns and layers, with hexahedra between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from difftetvr.mesh.io.formats.vtk.cells import Cells

_HEXAHEDRON = 12


def lattice(axes: Sequence[np.ndarray]) -> np.ndarray:
    """(N, 3) points of all combinations of coordinates along x, y and z; x runs fastest."""
    z, y, x = np.meshgrid(*reversed(axes), indexing="ij")
    return np.column_stack((x.ravel(), y.ravel(), z.ravel()))


def hexahedra(shape: tuple[int, int, int]) -> Cells:
    """The cells between (nx, ny, nz) points, x running fastest."""
    nx, ny, nz = shape
    points = np.arange(nx * ny * nz).reshape(nz, ny, nx)
    corners = [
        points[z : nz - 1 + z, y : ny - 1 + y, x : nx - 1 + x].ravel()
        for z in (0, 1)
        for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))
    ]
    nodes = np.stack(corners, 1)
    return Cells(np.full(len(nodes), _HEXAHEDRON, np.uint8), nodes.ravel(), 8 * np.arange(len(nodes) + 1))
