"""Size and shape of all cells, and of the cells around each vertex, outside autograd (Dr.Jit kernels, float64).

`difftetvr.mesh.quality` is the differentiable twin that the tests hold this against. Where products are added up,
fma is explicit, so that every kernel rounds alike: a cell that has not moved has the very numbers that it had before.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend, get_backend
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import corner_columns
from difftetvr.mesh.topology.topology import Topology
from difftetvr.recording import eager, few_lengths, replayed

_QUALITY_FACTOR = math.sqrt(432.0)
"""Q = sqrt(432) det / S^(3/2), S the sum of the squared edge lengths: the same as 6 sqrt(2) V / l_rms^3."""

Vector = list[Any]


@dataclass(frozen=True)
class CellShapes:
    """Volume and quality of cells.

    Attributes:
        scale: () float64, a power of two that lengths are multiplied with, so that no cube over- or underflows.
        determinants: (T,) float64, six times the signed volume in the scaled unit.
        qualities: (T,) float64, Q = 6 sqrt(2) V / l_rms^3.
    """

    scale: torch.Tensor
    determinants: torch.Tensor
    qualities: torch.Tensor


@dataclass(frozen=True)
class VertexShapes:
    """What a step of the vertices has to know of the cells around them.

    Attributes:
        sums: (V, 4) float64, gradient of the sum of -log Q over all cells, each with its weight, and the smallest
            altitude of all cells around each vertex, in the scaled unit; 0 where no cell uses it, or where it cannot
            be told.
        cells: Volumes and qualities.
    """

    sums: torch.Tensor
    cells: CellShapes

    @property
    def altitudes(self) -> torch.Tensor:
        """(V,) float64, the smallest altitude of all cells around each vertex, 0 where no cell uses it."""
        return self.sums[:, 3] / self.cells.scale

    @property
    def barrier_gradient(self) -> torch.Tensor:
        """(V, 3) float64, gradient of the sum of -log Q over all cells, each with its weight."""
        return self.sums[:, :3] * self.cells.scale


def length_scale(vertices: torch.Tensor) -> torch.Tensor:
    """The power of two that brings the largest coordinate between 1/2 and 1; multiplying by it changes no digit.

    Args:
        vertices: (V, 3) float32 or float64.

    Returns:
        () float64.
    """
    _, exponent = torch.frexp(vertices.detach().double().abs().max())
    return torch.exp2(-exponent.double().clamp(-1000, 1000))


def scaled_points(vertices: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Positions in a scaled unit as kernels read them.

    Args:
        vertices: (V, 3) float32 or float64.
        scale: () float64, from `length_scale`.

    Returns:
        (V, 4) float64, detached; the last column is padding.
    """
    points = vertices.new_zeros((vertices.shape[0], 4), dtype=torch.float64)
    points[:, :3] = vertices.detach().double() * scale
    return points


@eager
def measure_cells(corners: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Determinants and qualities of cells; equal positions give equal bits.

    Args:
        corners: (4, N) int32 their vertices, contiguous.
        points: (V, 4) float64, from `scaled_points`.

    Returns:
        (N,) float64 determinants, six times the volumes, and (N,) float64 qualities; NaN where positions are.
    """
    if not corners.shape[1]:
        return points.new_empty(0), points.new_empty(0)
    backend = _backend(points)
    with backend.exclusive():
        determinants, qualities = replayed(_measures, cell_source(backend, corners, points))
        return backend.tensor(determinants), backend.tensor(qualities)


@eager
def measure_vertices(mesh: TetMesh, weigh: Callable[[Any], Any] | None = None) -> VertexShapes:
    """Altitudes, gradient of the shape barrier, volumes and qualities of a mesh.

    Args:
        mesh: Mesh of positive cells.
        weigh: Weight of each cell's -log Q as a function of Q, on Dr.Jit's float64 arrays; default: 1 for all. Kernels
            are recorded if it is a dataclass.

    Returns:
        The measures. Where a cell is so thin that float64 finds no volume, the barrier's gradient is not finite and
        the altitude is 0.
    """
    topology, scale = mesh.topology, length_scale(mesh.vertices)
    points = scaled_points(mesh.vertices, scale)
    if not topology.num_cells:
        nothing = points.new_empty(0)
        return VertexShapes(torch.zeros_like(points), CellShapes(scale, nothing, nothing))
    backend = _backend(points)
    with backend.exclusive():
        source, length = cell_source(backend, corner_columns(topology), points), few_lengths(topology.num_cells)
        determinants, qualities, corners = replayed(_shapes, source, weigh, length)
        stars = StarSource.of(backend, topology, corners)
        sums = replayed(sums_of_stars, stars, few_lengths(topology.num_vertices), True)
        of_cells = CellShapes(scale, backend.tensor(determinants), backend.tensor(qualities))
        return VertexShapes(backend.tensor(sums, -1, 4)[: topology.num_vertices], of_cells)


def _backend(points: torch.Tensor) -> Backend:
    return get_backend(str(points.device), torch.float64)


def cell_source(backend: Backend, corners: torch.Tensor, points: torch.Tensor) -> CellSource:
    """Cells as kernels read them: (4, N) int32 vertices, and (V, 4) float64 `scaled_points`."""
    return CellSource(backend, backend.floats(points), [backend.uints(column) for column in corners])


# ---- Kernels


@dataclass
class CellSource:
    """Cells, flat.

    Attributes:
        backend: Array types, float64.
        points: (V, 4) positions, and padding.
        corners: Four arrays (N,) of their vertices.
    """

    backend: Backend
    points: Any
    corners: list[Any]

    def edges(self) -> tuple[Vector, Vector, Vector]:
        """Edges from the first corner."""
        first, *others = (position(self.backend, self.points, corner) for corner in self.corners)
        a, b, c = ([x - y for x, y in zip(other, first, strict=True)] for other in others)
        return a, b, c


@dataclass
class StarSource:
    """The cells around vertices, flat.

    Attributes:
        backend: Array types, float64.
        first, end: (V,) where each vertex's corners begin and end among ``around``.
        around: (4 T,) the corners, 4 * cell + k.
        corners: (T, 4, 4) four numbers about each of them.
    """

    backend: Backend
    first: Any
    end: Any
    around: Any
    corners: Any

    @staticmethod
    def of(backend: Backend, topology: Topology, corners: Any) -> StarSource:
        """The cells of a mesh, with what is known of their corners."""
        offsets, around = topology.vertex_corners
        first, end, around = map(backend.uints, (offsets[:-1], offsets[1:], around))
        return StarSource(backend, first, end, around, corners)


def _measures(source: CellSource) -> tuple[Any, Any]:
    """Determinants and qualities of cells, for :func:`difftetvr.recording.replayed`."""
    determinant, quality = measured(*source.edges())
    dr.eval(determinant, quality)
    return determinant, quality


def measured(a: Vector, b: Vector, c: Vector) -> tuple[Any, Any]:
    """Determinant and quality of a cell with edges from its first corner, for kernels of others, too."""
    determinant = dot(a, cross(b, c))
    return determinant, _quality(determinant, _squared_edges(a, b, c, _sum(a, b, c)))


def _shapes(source: CellSource, weigh: Callable[[Any], Any] | None, length: int) -> tuple[Any, Any, Any]:
    """The same, and for each corner of a cell the gradient of -log Q and the cell's least altitude.

    Args:
        source: The cells.
        weigh: Weight of -log Q by Q; None: 1.
        length: Number of cells to make room for.

    Returns:
        Determinants, qualities, and flat (length, 4, 4) gradients with the altitude behind them.
    """
    a, b, c = source.edges()
    # Twice the area vectors of the faces opposite corners 1, 2 and 3, pointing inwards; all four add up to zero.
    normals = (cross(b, c), cross(c, a), cross(a, b))
    total_normal, total = _sum(*normals), _sum(a, b, c)
    determinant, squares = dot(a, normals[0]), _squared_edges(a, b, c, total)
    quality = _quality(determinant, squares)
    largest = dot(total_normal, total_normal)
    for normal in normals:
        largest = dr.fmax(largest, dot(normal, normal))
    altitude = determinant / dr.sqrt(largest)

    # -log Q = -log det + 3/2 log S; the gradient of det at corner k is its normal, that of S is 2 (4 x_k - sum of x).
    weight = dr.ones_like(quality) if weigh is None else weigh(quality)
    by_normal, by_edge = weight / determinant, 3.0 * weight / squares
    pull = [by_edge * t for t in total]
    record = [*(dr.fma(by_normal, n, -p) for n, p in zip(total_normal, pull, strict=True)), altitude]
    for edge, normal in zip((a, b, c), normals, strict=True):
        parts = zip(edge, pull, normal, strict=True)
        record += [dr.fma(4.0 * by_edge, e, -p) - by_normal * n for e, p, n in parts]
        record.append(altitude)
    corners = dr.empty(source.backend.Float, len(record) * length)
    dr.scatter(corners, source.backend.Floats(record), dr.arange(source.backend.UInt, dr.width(source.corners[0])))
    dr.eval(determinant, quality, corners)
    return determinant, quality, corners


def sums_of_stars(source: StarSource, length: int, takes_least: bool) -> Any:
    """What vertices feel of the cells around them, for :func:`difftetvr.recording.replayed`.

    Args:
        source: The cells around them.
        length: Number of vertices to make room for.
        takes_least: Whether of the last of the four numbers the least counts, 0 where that is not positive and finite.

    Returns:
        Flat (length, 4): sums in the order of the cells, but for such a least number.
    """
    backend, lanes = source.backend, dr.width(source.first)
    vertex = dr.arange(backend.UInt, lanes)

    def add(place: Any, total: Vector, last: Any) -> tuple[Any, Vector, Any]:
        packet = dr.gather(backend.Float4, source.corners, dr.gather(backend.UInt, source.around, place))
        last = dr.select(packet[3] < last, packet[3], last) if takes_least else last + packet[3]
        return place + 1, [t + packet[k] for k, t in enumerate(total)], last

    nothing = dr.full(backend.Float, dr.inf if takes_least else 0.0, lanes)
    begin = (source.first, [dr.zeros(backend.Float, lanes) for _ in range(3)], nothing)
    _, total, last = dr.while_loop(begin, lambda place, *_: place < source.end, add)
    if takes_least:
        # Comparisons with NaN are false, so what cannot be computed counts as nothing.
        last = dr.select(dr.isfinite(last) & (last > 0.0), last, 0.0)
    result = dr.empty(backend.Float, 4 * length)
    dr.scatter(result, backend.Floats([*total, last]), vertex)
    dr.eval(result)
    return result


def position(backend: Backend, points: Any, vertex: Any) -> Vector:
    """Position of a vertex among (V, 4) flat ones, see `scaled_points`."""
    packet = dr.gather(backend.Float4, points, vertex)
    return [packet[k] for k in range(3)]


def cross(p: Vector, q: Vector) -> Vector:
    """Cross product, in kernels."""
    return [dr.fma(p[i], q[j], -(p[j] * q[i])) for i, j in ((1, 2), (2, 0), (0, 1))]


def dot(p: Vector, q: Vector) -> Any:
    """Dot product, in kernels."""
    return dr.fma(p[0], q[0], dr.fma(p[1], q[1], p[2] * q[2]))


def _sum(p: Vector, q: Vector, r: Vector) -> Vector:
    return [x + y + z for x, y, z in zip(p, q, r, strict=True)]


def _squared_edges(a: Vector, b: Vector, c: Vector, total: Vector) -> Any:
    """Sum of the six squared edge lengths; the subtraction cancels at most three quarters."""
    return dr.fma(4.0, dot(a, a) + dot(b, b) + dot(c, c), -dot(total, total))


def _quality(determinant: Any, squares: Any) -> Any:
    return _QUALITY_FACTOR * determinant / (squares * dr.sqrt(squares))
