"""Which cell holds a point? (Dr.Jit)

Points are looked for in a hierarchy of boxes, so that meshes may have holes, parts that do not touch, and loose cells;
the points of a grid are found the other way round, by going through the grid's points in the box of each cell. A point
on a face belongs to both its cells, which agree about continuous values; the cell of the smallest number is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend, backend_for
from difftetvr.mesh import TetMesh
from difftetvr.rendering.search.hierarchy import Hierarchy, curve_order, leaves_of_cells
from difftetvr.rendering.search.scene import Cells

NOWHERE = -1
"""Stands for the cell of a point that no cell holds."""

_TOLERANCE = 16.0  # roundings by which a weight may be negative for a point to count as inside
_POINTS_OF_AN_ITEM = 256  # of a grid, about so many are looked at by a lane


@dataclass(frozen=True)
class CellReader(Cells):
    """Reads cells and tells barycentric weights of points in them."""

    @staticmethod
    def of(backend: Backend, mesh: TetMesh, vertices: torch.Tensor) -> CellReader:
        """Upload a mesh with (V, 3) vertices."""
        records = torch.nn.functional.pad(vertices.detach(), (0, 1))
        return CellReader(backend, backend.floats(records), backend.uints(mesh.tets), 1)

    def corners(self, cell: Any, active: Any = True) -> tuple[Any, list[list[Any]]]:
        """The four vertices of a cell, and their positions."""
        tet = self.cell(cell, active)
        return tet, [self.point(tet[k], active) for k in range(4)]

    def weights(self, corners: list[list[Any]], point: list[Any]) -> tuple[list[Any], Any]:
        """Barycentric weights of a point, and how much rounding may move them."""
        a, b, c, d = ([x - y for x, y in zip(corner, point, strict=True)] for corner in corners)
        ab, cd = cross(a, b), cross(c, d)
        volumes = [dot(b, cd), -dot(a, cd), dot(d, ab), -dot(c, ab)]
        total = volumes[0] + volumes[1] + volumes[2] + volumes[3]
        inverse = dr.select(total != 0, 1.0 / total, 0.0)
        size = _largest(a) * _largest(b) * (_largest(c) + _largest(d)) + _largest(c) * _largest(d) * (
            _largest(a) + _largest(b)
        )
        return [volume * inverse for volume in volumes], _TOLERANCE * dr.epsilon(size) * size * dr.abs(inverse)

    def holds(self, corners: list[list[Any]], point: list[Any]) -> tuple[Any, Any]:
        """Whether a cell with some corners holds a point, but for rounding; and whether no other cell does."""
        weights, slack = self.weights(corners, point)
        is_in, is_alone = weights[0] >= -slack, weights[0] > slack
        for weight in weights[1:]:  # not of their least one: that of NaN and a number is the number
            is_in &= weight >= -slack
            is_alone &= weight > slack
        return is_in, is_alone


def locate(mesh: TetMesh, vertices: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Find the cells that hold points.

    Args:
        mesh: The mesh, for its cells.
        vertices: (V, 3) their positions.
        points: (P, 3) positions, of the vertices' precision and on their device.

    Returns:
        (P,) int32 cells, -1 where there is none.
    """
    backend = backend_for(vertices)
    uint, count = backend.UInt, points.shape[0]
    if not count or not mesh.num_cells:
        return torch.full((count,), NOWHERE, dtype=torch.int32, device=vertices.device)
    with backend.exclusive():
        order = curve_order(points)  # so that neighbouring lanes look at the same cells
        reader, flat = CellReader.of(backend, mesh, vertices), backend.floats(points[order])
        hierarchy = Hierarchy.over(leaves_of_cells(backend, mesh.topology, lambda: vertices), reader)
        lane = dr.arange(uint, count)
        point = [dr.gather(backend.Float, flat, 3 * lane + axis) for axis in range(3)]

        def at_cell(cell: Any, active: Any, state: tuple[Any, Any]) -> tuple[Any, Any]:
            best, is_settled = state
            _, corners = reader.corners(cell, active)
            is_in, is_alone = reader.holds(corners, point)
            best = dr.select(active & is_in & ~is_settled & (is_alone | (cell < best)), cell, best)
            return best, is_settled | (active & is_alone)

        everywhere = dr.full(backend.Bool, True, count)
        state = dr.full(uint, 0xFFFFFFFF, count), dr.full(backend.Bool, False, count)
        best, _ = hierarchy.meet_points(
            (point[0], point[1], point[2]), 0.0, everywhere, at_cell, state, lambda state: state[1]
        )
        found = backend.tensor(backend.Int(best))
        return torch.empty_like(found).index_put_((order,), found)


@dataclass(frozen=True)
class Lattice:
    """Points at equal distances along the axes.

    Attributes:
        origin: The first point.
        spacing: Distances along x, y and z, > 0.
        shape: How many points along x, y and z.
    """

    origin: tuple[float, float, float]
    spacing: tuple[float, float, float]
    shape: tuple[int, int, int]

    def points(self, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        """(X, Y, Z, 3) the points."""
        axes = [
            first + step * torch.arange(count, dtype=torch.float64)
            for first, step, count in zip(self.origin, self.spacing, self.shape, strict=True)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).to(device, dtype)


def locate_lattice(mesh: TetMesh, vertices: torch.Tensor, lattice: Lattice) -> torch.Tensor:
    """Find the cells that hold the points of a lattice.

    Args:
        mesh: The mesh, for its cells.
        vertices: (V, 3) their positions.
        lattice: The points.

    Returns:
        (X, Y, Z) int32 cells, -1 where there is none.
    """
    backend = backend_for(vertices)
    uint, real, integer = backend.UInt, backend.Float, backend.Int
    nx, ny, nz = lattice.shape
    owners = dr.full(uint, 0xFFFFFFFF, nx * ny * nz)
    with backend.exclusive():
        reader = CellReader.of(backend, mesh, vertices.detach())
        first = [backend.opaque(x) for x in lattice.origin]
        step = [backend.opaque(x) for x in lattice.spacing]
        size = [backend.opaque_uint(n) for n in lattice.shape]
        low, high = _boxes(reader, mesh.num_cells, first, step, lattice.shape)
        extents = [dr.select(high[k] >= low[k], high[k] - low[k] + 1, 0) for k in range(3)]
        # Some cells see many points and most few: lanes take pieces of about one size, whole columns along z.
        columns = extents[0] * extents[1]
        per_item = dr.maximum(_POINTS_OF_AN_ITEM // dr.maximum(extents[2], 1), 1)
        pieces = dr.select((columns > 0) & (extents[2] > 0), (columns + per_item - 1) // per_item, 0)
        backend.run(pieces, per_item, *low, *extents)
        counts = backend.tensor(integer(pieces))
        owner = torch.repeat_interleave(torch.arange(len(counts), dtype=torch.int32, device=counts.device), counts)
        if not owner.shape[0]:
            return backend.tensor(integer(owners), nx, ny, nz)
        begins = (counts.cumsum(0) - counts).to(torch.int32)
        cell = backend.uints(owner)
        piece = dr.arange(uint, owner.shape[0]) - dr.gather(uint, backend.uints(begins), cell)
        take = lambda array: uint(dr.gather(integer, array, cell))  # noqa: E731
        per, (x0, y0, z0), (width, height, depth) = take(per_item), map(take, low), map(take, extents)
        height = dr.maximum(height, 1)  # lanes without a piece divide by it, too
        last = dr.minimum((piece + 1) * per, width * height)
        _, corners = reader.corners(cell)

        def body(column: Any, z: Any) -> tuple[Any, Any]:
            x, y = column // height, column - (column // height) * height
            place = [x0 + x, y0 + y, z0 + z]
            point = [dr.fma(real(i), s, f) for i, s, f in zip(place, step, first, strict=True)]
            index = (place[0] * size[1] + place[1]) * size[2] + place[2]
            dr.scatter_reduce(dr.ReduceOp.Min, owners, cell, index, reader.holds(corners, point)[0])
            ends = z + 1 >= depth
            return dr.select(ends, column + 1, column), dr.select(ends, 0, z + 1)

        dr.while_loop((piece * per, dr.zeros(uint, owner.shape[0])), lambda column, z: column < last, body)
        return backend.tensor(integer(owners), nx, ny, nz)


def _boxes(
    reader: CellReader, cells: int, first: list[Any], step: list[Any], shape: tuple[int, int, int]
) -> tuple[list[Any], list[Any]]:
    """First and last lattice places in the boxes of cells, widened by rounding, along each axis."""
    backend = reader.backend
    _, corners = reader.corners(dr.arange(backend.UInt, cells))
    lows, highs = [], []
    for axis in range(3):
        values = [(corner[axis] - first[axis]) / step[axis] for corner in corners]
        low = dr.fmin(dr.fmin(values[0], values[1]), dr.fmin(values[2], values[3]))
        high = dr.fmax(dr.fmax(values[0], values[1]), dr.fmax(values[2], values[3]))
        slack = 1e-3 + 8.0 * dr.epsilon(low) * dr.fmax(dr.abs(low), dr.abs(high))
        last = float(shape[axis] - 1)
        lows.append(backend.Int(dr.fmin(dr.fmax(dr.ceil(low - slack), 0.0), last + 1.0)))
        highs.append(backend.Int(dr.fmin(dr.fmax(dr.floor(high + slack), -1.0), last)))
    return lows, highs


def cross(a: list[Any], b: list[Any]) -> list[Any]:
    """Cross product."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a: list[Any], b: list[Any]) -> Any:
    """Dot product; explicit fma, so that every kernel rounds alike."""
    total = a[-1] * b[-1]
    for x, y in zip(reversed(a[:-1]), reversed(b[:-1]), strict=True):
        total = dr.fma(x, y, total)
    return total


def _largest(a: list[Any]) -> Any:
    return dr.fmax(dr.fmax(dr.abs(a[0]), dr.abs(a[1])), dr.abs(a[2]))
