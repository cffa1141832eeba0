"""Size and shape of all cells, and of the cells around each vertex, in one fast pass outside autograd.

`difftetvr.mesh.quality` is the differentiable twin that the tests hold this against. Here positions lie axis by axis,
(3, V) float64, so that every gather and every operation runs over contiguous numbers: five times faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import torch

from difftetvr.mesh.arrays import chunks
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.topology import Topology

_QUALITY_FACTOR = math.sqrt(432.0)
"""Q = sqrt(432) det / S^(3/2), S the sum of the squared edge lengths: the same as 6 sqrt(2) V / l_rms^3."""

_TEMPORARIES = 3
"""Shrinks the slices so that the some forty temporaries of a slice stay in a core's cache."""

Axes = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


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
        altitudes: (V,) float64, the smallest altitude of all cells around each vertex, 0 where no cell uses it.
        barrier_gradient: (V, 3) float64, gradient of the sum of -log Q over all cells, each with its weight.
        cells: Volumes and qualities.
    """

    altitudes: torch.Tensor
    barrier_gradient: torch.Tensor
    cells: CellShapes


def length_scale(vertices: torch.Tensor) -> torch.Tensor:
    """The power of two that brings the largest coordinate between 1/2 and 1; multiplying by it changes no digit.

    Args:
        vertices: (V, 3) float32 or float64.

    Returns:
        () float64.
    """
    _, exponent = torch.frexp(vertices.detach().double().abs().max())
    return torch.exp2(-exponent.double().clamp(-1000, 1000))


def scaled_axes(vertices: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Positions as contiguous x, y and z in a scaled unit.

    Args:
        vertices: (V, 3) float32 or float64.
        scale: () float64, from `length_scale`.

    Returns:
        (3, V) float64, detached.
    """
    return (vertices.detach().double() * scale).t().contiguous()


def corner_columns(topology: Topology) -> torch.Tensor:
    """The cells' vertex indices corner by corner, (4, T) int32 contiguous; built once for a topology."""
    return topology.cached("mesh.shapes.corner_columns", lambda: topology.tets.t().contiguous())


def measure_cells(
    topology: Topology, axes: torch.Tensor, cells: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Determinants and qualities of cells.

    Only sums, products, quotients and square roots are involved: equal positions give equal bits, whatever the slice.

    Args:
        topology: The cells.
        axes: (3, V) float64, from `scaled_axes`.
        cells: (N,) int64 indices of the cells wanted; None: all of them.

    Returns:
        (N,) float64 determinants, six times the volumes, and (N,) float64 qualities; NaN where positions are.
    """
    columns = corner_columns(topology)
    if cells is not None:
        columns = columns.index_select(1, cells)
    results = axes.new_empty((2, columns.shape[1]))
    for part in chunks(columns.shape[1], axes.device, width=_TEMPORARIES):
        a, b, c = _edges(axes, columns[:, part])
        determinant = _dot(a, _cross(b, c))
        results[0, part] = determinant
        results[1, part] = _quality(determinant, _squared_edges(a, b, c, _sum(a, b, c)))
    return results[0], results[1]


def measure_vertices(mesh: TetMesh, weigh: Callable[[torch.Tensor], torch.Tensor] | None = None) -> VertexShapes:
    """Altitudes, gradient of the shape barrier, volumes and qualities of a mesh in one pass.

    Args:
        mesh: Mesh of positive cells.
        weigh: Weight of each cell's -log Q as a function of Q, (N,) float64 to (N,); default: 1 for all.

    Returns:
        The measures. Where a cell is so thin that float64 finds no volume, the barrier's gradient is not finite and
        the altitude is 0.
    """
    topology = mesh.topology
    columns = corner_columns(topology)
    scale = length_scale(mesh.vertices)
    axes = scaled_axes(mesh.vertices, scale)
    cells = axes.new_empty((2, topology.num_cells))
    altitudes = axes.new_full((topology.num_vertices,), torch.inf)
    gradient = torch.zeros_like(axes)
    for part in chunks(topology.num_cells, axes.device, width=_TEMPORARIES):
        corners = [column.contiguous() for column in columns[:, part].unbind()]
        shape = _shape(axes, columns[:, part], weigh)
        cells[0, part] = shape.determinant
        cells[1, part] = shape.quality
        for corner, forces in zip(corners, shape.gradients):
            altitudes.scatter_reduce_(0, corner.long(), shape.altitude, "amin")
            for target, force in zip(gradient, forces):
                target.index_add_(0, corner, force)
    altitudes = torch.where(torch.isfinite(altitudes), altitudes, 0.0).clamp_min_(0.0)
    return VertexShapes(altitudes / scale, gradient.t() * scale, CellShapes(scale, cells[0], cells[1]))


class _Shape(NamedTuple):
    determinant: torch.Tensor
    quality: torch.Tensor
    altitude: torch.Tensor
    gradients: tuple[Axes, Axes, Axes, Axes]


def _shape(axes: torch.Tensor, columns: torch.Tensor, weigh: Callable[[torch.Tensor], torch.Tensor] | None) -> _Shape:
    """Everything about some cells; gradients are those of -log Q with respect to their four corners."""
    a, b, c = _edges(axes, columns)
    # Twice the area vectors of the faces opposite corners 1, 2 and 3, pointing inwards; all four add up to zero.
    normals = (_cross(b, c), _cross(c, a), _cross(a, b))
    total_normal = _sum(*normals)
    determinant = _dot(a, normals[0])
    largest = _dot(total_normal, total_normal)
    for normal in normals:
        largest = torch.maximum(largest, _dot(normal, normal))
    total = _sum(a, b, c)
    squares = _squared_edges(a, b, c, total)

    # -log Q = -log det + 3/2 log S; the gradient of det at corner k is its normal, that of S is 2 (4 x_k - sum of x).
    quality = _quality(determinant, squares)
    weight = torch.ones_like(quality) if weigh is None else weigh(quality)
    by_normal, by_edge = weight / determinant, 3.0 * weight / squares
    pull = [by_edge * t for t in total]
    by_edge = 4.0 * by_edge
    second, third, fourth = (
        _axes(by_edge * e - p - by_normal * n for e, p, n in zip(edge, pull, normal))
        for edge, normal in zip((a, b, c), normals)
    )
    first = _axes(by_normal * n - p for n, p in zip(total_normal, pull))
    altitude = determinant / largest.sqrt()
    return _Shape(determinant, quality, altitude, (first, second, third, fourth))


def _edges(axes: torch.Tensor, columns: torch.Tensor) -> tuple[Axes, Axes, Axes]:
    """Edges from the first corner."""
    origin, *others = columns.unbind()
    start = [axis.index_select(0, origin) for axis in axes]
    a, b, c = (_axes(axis.index_select(0, end).sub_(s) for axis, s in zip(axes, start)) for end in others)
    return a, b, c


def _axes(values: Iterable[torch.Tensor]) -> Axes:
    x, y, z = values
    return x, y, z


def _cross(p: Axes, q: Axes) -> Axes:
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


def _dot(p: Axes, q: Axes) -> torch.Tensor:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


def _sum(p: Axes, q: Axes, r: Axes) -> Axes:
    return p[0] + q[0] + r[0], p[1] + q[1] + r[1], p[2] + q[2] + r[2]


def _squared_edges(a: Axes, b: Axes, c: Axes, total: Axes) -> torch.Tensor:
    """Sum of the six squared edge lengths; the subtraction cancels at most three quarters."""
    return 4.0 * (_dot(a, a) + _dot(b, b) + _dot(c, c)) - _dot(total, total)


def _quality(determinant: torch.Tensor, squares: torch.Tensor) -> torch.Tensor:
    return _QUALITY_FACTOR * determinant / (squares * squares.sqrt())
