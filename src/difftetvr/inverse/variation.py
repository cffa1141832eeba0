"""Total variation and squared gradient of a density that is linear in each cell, exactly (Dr.Jit kernels, float64).

In a cell with edges e_k from one of its corners and density differences d_k along them, the gradient times six volumes
is ``G = d_1 e_2 x e_3 + d_2 e_3 x e_1 + d_3 e_1 x e_2``. So the cell's part of the total variation, its volume times
the length of the gradient, is |G| / 6: no division by a volume that may be next to nothing. The derivatives of both
terms are those of sums over cells of ``weight |G|^2 / 2``, with weights that are constant for the squared gradient and
1 / (6 |G|) for the total variation: one kernel gives all of them, and with the weights of an earlier density the
quadratic form by which linear solvers replace the total variation (lagged diffusivity, Vogel and Oman 1996).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend, get_backend
from difftetvr.mesh.shapes import StarSource, cross, dot, sums_of_stars
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import corner_columns
from difftetvr.recording import few_lengths, replayed


@dataclass(frozen=True)
class Variation:
    """A penalty of gradients, and its derivatives.

    Attributes:
        value: () float64, what it is.
        by_density: (V,) float64 derivatives by the densities.
        by_vertex: (V, 3) float64 derivatives by the positions, with the cells' weights as they are.
    """

    value: torch.Tensor
    by_density: torch.Tensor
    by_vertex: torch.Tensor


def total_variation(mesh: TetMesh, density: torch.Tensor, smoothing: float = 0.0) -> Variation:
    """The integral of the length of the density's gradient.

    Args:
        mesh: Mesh of positive cells.
        density: (V,) densities of its vertices.
        smoothing: Gradient below which the length is rounded off to that of a parabola, in densities per unit of
            length; the corner at 0 would keep flat places from becoming quite flat.

    Returns:
        Its value, without the rounding, and its derivatives.
    """
    return _variation(mesh, density, smoothing, None)


def weighted_square(mesh: TetMesh, density: torch.Tensor, weights: torch.Tensor) -> Variation:
    """The quadratic form of the density's gradient with a weight for each cell: half the sum of weights times |G|^2.

    Args:
        mesh: Mesh of positive cells.
        density: (V,) values of its vertices, of any sign.
        weights: (T,) float64, such as those of :func:`cell_weights`.
    """
    return _variation(mesh, density, 0.0, weights)


def cell_weights(mesh: TetMesh, density: torch.Tensor, total: float, squared: float, smoothing: float) -> torch.Tensor:
    """(T,) float64 weights with which the quadratic form stands for penalties around a density.

    Args:
        mesh: The mesh.
        density: (V,) the density.
        total: Factor of the total variation.
        squared: Factor of the integral of half the squared gradient.
        smoothing: See :func:`total_variation`; greater than 0 where that counts.
    """
    corners = mesh.vertices.detach().double()[mesh.tets.long()]
    heights = density.detach().double()[mesh.tets.long()]
    a, b, c = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
    normals = [torch.linalg.cross(p, q) for p, q in ((b, c), (c, a), (a, b))]
    volume = (a * normals[0]).sum(1) / 6.0
    gradient = sum((heights[:, k + 1] - heights[:, 0])[:, None] * normal for k, normal in enumerate(normals))
    assert isinstance(gradient, torch.Tensor)
    rounded = (gradient.square().sum(1) + (6.0 * volume * smoothing).square()).sqrt()
    return total / (6.0 * rounded) + squared / (36.0 * volume)


def _variation(mesh: TetMesh, density: torch.Tensor, smoothing: float, weights: torch.Tensor | None) -> Variation:
    points = torch.cat((mesh.vertices.detach().double(), density.detach().double()[:, None]), 1)
    if not mesh.num_cells:
        return Variation(points.new_zeros(()), torch.zeros_like(points[:, 3]), torch.zeros_like(points[:, :3]))
    backend, topology = get_backend(str(points.device), torch.float64), mesh.topology
    with backend.exclusive():
        source = _Source(
            backend,
            backend.floats(points),
            [backend.uints(column) for column in corner_columns(topology)],
            backend.opaque(smoothing),
            None if weights is None else backend.floats(weights),
        )
        parts, corners = replayed(_of_cells, source, few_lengths(topology.num_cells))
        stars = StarSource.of(backend, topology, corners)
        sums = replayed(sums_of_stars, stars, few_lengths(topology.num_vertices), False)
        value = backend.tensor(parts)[: topology.num_cells].sum()
        of_vertices = backend.tensor(sums, -1, 4)[: topology.num_vertices]
    return Variation(value, of_vertices[:, 3], of_vertices[:, :3])


# ---- Kernels


@dataclass
class _Source:
    """Cells and their densities, flat.

    Attributes:
        backend: Array types, float64.
        points: (V, 4) positions and densities.
        corners: Four arrays (T,) of the cells' vertices.
        smoothing: See :func:`total_variation`, as a device value.
        weights: (T,) of the cells; None for those of the total variation.
    """

    backend: Backend
    points: Any
    corners: list[Any]
    smoothing: Any
    weights: Any | None


def _of_cells(source: _Source, length: int) -> tuple[Any, Any]:
    """Each cell's part of the penalty, and flat (length, 4, 4) derivatives by its corners' positions and densities."""
    backend = source.backend
    first, *others = (dr.gather(backend.Float4, source.points, corner) for corner in source.corners)
    edges = [[other[k] - first[k] for k in range(3)] for other in others]
    rises = [other[3] - first[3] for other in others]
    normals = [cross(edges[(k + 1) % 3], edges[(k + 2) % 3]) for k in range(3)]
    gradient = [
        dr.fma(rises[0], normals[0][i], dr.fma(rises[1], normals[1][i], rises[2] * normals[2][i])) for i in range(3)
    ]
    square = dot(gradient, gradient)
    if source.weights is None:
        floor = dot(edges[0], normals[0]) * source.smoothing  # six volumes times the least gradient
        rounded = dr.sqrt(dr.fma(floor, floor, square))
        weight = dr.select(rounded > 0, 1.0 / (6.0 * rounded), 0.0)
        part = dr.sqrt(square) * (1.0 / 6.0)
    else:
        weight = dr.gather(backend.Float, source.weights, dr.arange(backend.UInt, dr.width(source.corners[0])))
        part = 0.5 * weight * square
    pull = [weight * g for g in gradient]
    by_rise = [dot(pull, normal) for normal in normals]
    by_edge = []
    for k in range(3):
        following, previous = (k + 1) % 3, (k + 2) % 3
        # <pull, e_i x e_j> = <e_i, e_j x pull>: two of the three products hold the edge.
        one, other = cross(pull, edges[previous]), cross(edges[following], pull)
        by_edge.append([dr.fma(rises[following], p, rises[previous] * q) for p, q in zip(one, other, strict=True)])
    record = [-(by_edge[0][i] + by_edge[1][i] + by_edge[2][i]) for i in range(3)]
    record.append(-(by_rise[0] + by_rise[1] + by_rise[2]))
    for edge, rise in zip(by_edge, by_rise, strict=True):
        record += [*edge, rise]
    cell = dr.arange(backend.UInt, dr.width(source.corners[0]))
    parts, corners = dr.empty(backend.Float, length), dr.empty(backend.Float, len(record) * length)
    dr.scatter(parts, part, cell)
    dr.scatter(corners, backend.Floats(record), cell)
    dr.eval(parts, corners)
    return parts, corners
