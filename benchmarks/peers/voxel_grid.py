"""A voxel grid: densities and harmonic coefficients at the vertices of the cells that hold something.

The model of Plenoxels (Fridovich-Keil et al. 2022): values at vertices are interpolated trilinearly and cut off at 0
only then, so that surfaces may lie anywhere in a cell. A table says of every cell whether it holds something, and only
the vertices of those that do have values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from voxel_kernels import EMPTY, Lattice, row_width

from difftetvr.backend import Backend
from difftetvr.capture import Capture
from difftetvr.capture.hull import VisualHull

_CORNERS = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]


@dataclass
class VoxelGrid:
    """A grid and what it holds.

    Attributes:
        lattice: Where its vertices are.
        vertices: (R, 3) int64 place along x, y and z of the vertex of each row.
        held: (z, y, x) bool of each cell, whether it holds something.
        row: (z, y, x) int64 row of each vertex, -1 where it has none.
        rows: (R, width) coefficients of red, green and blue, the density, zeros.
    """

    lattice: Lattice
    vertices: torch.Tensor
    held: np.ndarray
    row: torch.Tensor
    rows: torch.Tensor

    def next_rows(self) -> torch.Tensor:
        """(R, 4) rows of the vertices behind each along x, y and z, its own where there is none; and nothing."""
        own = torch.arange(len(self.vertices))
        columns = []
        for axis in range(3):
            last = self.lattice.size[axis] - 1
            place = self.vertices.clone()
            place[:, axis] = (place[:, axis] + 1).clamp_max(last)
            found = self.row[place[:, 2], place[:, 1], place[:, 0]]
            columns.append(torch.where(found >= 0, found, own))
        return torch.stack([*columns, own], dim=1)


def first_grid(backend: Backend, capture: Capture, longest: int, degree: int, step: float, density: float) -> VoxelGrid:
    """A grid of equal, grey values in all cells that no silhouette rules out.

    Args:
        backend: Array types.
        capture: Whose bounds it fills.
        longest: Number of cells along the longest side.
        degree: Degree of the harmonics.
        step: Length of a ray's steps, in edges of cells.
        density: Density everywhere.
    """
    size, lower, edge = _shape(capture.bounds, longest)
    held = np.ones(tuple(n - 1 for n in reversed(size)), dtype=bool)
    if capture.silhouettes is not None:
        hull = VisualHull.of([capture.cameras[view] for view in capture.train_indices.tolist()], capture.silhouettes)
        centers = (np.argwhere(held)[:, ::-1] + 0.5) * edge + np.array(lower)
        held = hull.keeps(centers, edge, 1.0 / len(hull.cameras)).reshape(held.shape)
        held = ndimage.binary_dilation(held, np.ones((3, 3, 3), dtype=bool))
    grid = _with_cells(Lattice(backend, size, lower, edge, degree, step, None, None), held)
    grid.rows[:, grid.lattice.density_place] = density
    return grid


def refined(grid: VoxelGrid, bounds: torch.Tensor, longest: int, seen: np.ndarray) -> VoxelGrid:
    """What a grid holds on another one, which holds nothing where nothing was seen in a cell or beside it.

    Args:
        grid: A grid.
        bounds: (2, 3) corners of the box that both fill.
        longest: Number of cells along the longest side.
        seen: (cells that hold something,) bool, whether to keep them.
    """
    old = grid.lattice
    size, lower, edge = _shape(bounds, longest)
    kept = grid.held.copy()
    kept[grid.held] = seen
    kept = ndimage.binary_dilation(kept, np.ones((3, 3, 3), dtype=bool)) & grid.held
    # A new cell lies in the old one that its centre lies in.
    centers = [
        np.minimum(((np.arange(n - 1) + 0.5) * edge / old.edge).astype(int), m - 2) for n, m in zip(size, old.size)
    ]
    held = kept[np.ix_(centers[2], centers[1], centers[0])]
    lattice = Lattice(old.backend, size, lower, edge, old.degree, old.step, None, None)
    result = _with_cells(lattice, held)
    result.rows.copy_(_interpolated(grid, result.vertices.double() * (edge / old.edge)))
    return result


def _shape(bounds: torch.Tensor, longest: int) -> tuple[tuple[int, int, int], tuple[float, float, float], float]:
    """Vertices along the axes, the first one, and the edges' length, of cubes that fill a box or a little more."""
    lower, upper = bounds.double()
    edge = float((upper - lower).max()) / longest
    nx, ny, nz = (int(n) for n in torch.ceil((upper - lower) / edge - 1e-6) + 1)
    x, y, z = lower.tolist()
    return (nx, ny, nz), (x, y, z), edge


def _with_cells(lattice: Lattice, held: np.ndarray) -> VoxelGrid:
    """A grid in which some cells hold something, zeros for now."""
    backend, (nx, ny, nz) = lattice.backend, lattice.size
    place = np.argwhere(held)[:, ::-1]  # x, y, z; x runs fastest
    corners = place[:, None, :] + np.array(_CORNERS)
    flat = (corners[..., 2] * ny + corners[..., 1]) * nx + corners[..., 0]
    used = np.zeros(nx * ny * nz, dtype=bool)
    used[flat] = True
    row = np.where(used, np.cumsum(used) - 1, -1)
    if held.all():
        distance = np.zeros(held.shape, dtype=np.int64)
    else:
        distance = ndimage.distance_transform_cdt(~held, metric="chessboard").astype(np.int64)
    table = distance.reshape(-1) + EMPTY
    table[held.reshape(-1)] = np.arange(len(place))
    lattice.cells = backend.UInt(table.astype(np.uint32))
    lattice.corners = backend.UInt(row[flat].reshape(-1).astype(np.uint32))
    where = np.flatnonzero(used)
    vertices = torch.from_numpy(np.stack([where % nx, where // nx % ny, where // (nx * ny)], axis=1))
    rows = torch.zeros(len(where), row_width(lattice.degree))
    return VoxelGrid(lattice, vertices, held, torch.from_numpy(row.reshape(nz, ny, nx)), rows)


def _interpolated(grid: VoxelGrid, places: torch.Tensor) -> torch.Tensor:
    """(N, width) values at places in units of cells; vertices without a row count as 0."""
    limits = torch.tensor(grid.lattice.size) - 2
    first = torch.minimum(places.floor().long(), limits)
    share = (places - first).float()
    total: Any = 0.0
    for corner in _CORNERS:
        x, y, z = (first + torch.tensor(corner)).unbind(1)
        row = grid.row[z, y, x]
        weight = torch.where(torch.tensor(corner) == 1, share, 1.0 - share).prod(1) * (row >= 0)
        total = total + weight[:, None] * grid.rows[row.clamp_min(0)]
    return total
