"""Size and shape of tetrahedra as differentiable functions of the vertex positions.

All functions take vertices (V, 3) float32 or float64 and tets (T, 4) int32, and return the dtype of the vertices. The
arithmetic is float64 on normalised edges, so that thin cells keep their sign and no unit of length over- or underflows
before the result itself does.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from difftetvr.mesh.arrays import chunks
from difftetvr.mesh.topology.topology import LOCAL_EDGES

_REGULAR_TETRAHEDRON = 6.0 * 2.0**0.5
"""Edge length cubed over volume of the regular tetrahedron."""

FLAT = 1e-12
"""Qualities below are taken for flat: rounding in float64 makes errors of less than a hundredth of that."""


def volumes(vertices: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    """Signed volumes of cells.

    Args:
        vertices: (V, 3) positions.
        tets: (T, 4) int32 vertex indices.

    Returns:
        (T,) det(v1 - v0, v2 - v0, v3 - v0) / 6; positive for every cell of a valid mesh.
    """
    return _per_cell(_volumes, vertices, tets)


def altitudes(vertices: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    """Signed distances of each vertex of a cell from the opposite face.

    Args:
        vertices: (V, 3) positions.
        tets: (T, 4) int32 vertex indices.

    Returns:
        (T, 4) altitude of local vertex k, 3 V / area of the face opposite k; the smallest of a row is the largest move
        that cannot invert the cell when one vertex moves.
    """
    return _per_cell(_altitudes, vertices, tets)


def quality(vertices: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    """Shape of cells, whatever their size: Q = 6 sqrt(2) V / l_rms^3 (article eq. 17, with the true volume V).

    Args:
        vertices: (V, 3) positions.
        tets: (T, 4) int32 vertex indices.

    Returns:
        (T,) at most 1, which is the regular tetrahedron; 0 for flat and negative for inverted cells.
    """
    return _per_cell(_quality, vertices, tets)


def vertex_altitudes(vertices: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    """The smallest altitude among all cells around each vertex: the natural unit of a step of that vertex.

    Args:
        vertices: (V, 3) positions.
        tets: (T, 4) int32 vertex indices.

    Returns:
        (V,) lengths; infinity for vertices that no cell uses.
    """
    smallest = altitudes(vertices, tets).amin(1)
    unused = vertices.new_full((vertices.shape[0],), torch.inf)
    return unused.scatter_reduce(0, tets.reshape(-1).long(), smallest.repeat_interleave(4), "amin")


def _per_cell(
    measure: Callable[[torch.Tensor], torch.Tensor], vertices: torch.Tensor, tets: torch.Tensor
) -> torch.Tensor:
    """Apply `measure` to (4, N, 3) float64 corners, in cache-sized slices where autograd need not see the whole."""
    if torch.is_grad_enabled() and vertices.requires_grad:
        return measure(_corners(vertices, tets)).to(vertices.dtype)
    # Converting once and not per slice: the positions are an order of magnitude fewer than the gathered corners.
    positions = vertices.detach().double()
    slices = chunks(len(tets), tets.device, width=12)
    results = [measure(_corners(positions, tets[part])).to(vertices.dtype) for part in slices]
    return torch.cat(results) if results else measure(_corners(positions, tets)).to(vertices.dtype)


def _corners(vertices: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    return vertices.index_select(0, tets.t().reshape(-1)).double().view(4, tets.shape[0], 3)


def _unit_edges(corners: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Edges from the first corner in units of the longest component among them, (3, N, 3), and that unit, (N, 1)."""
    edges = corners[1:] - corners[0]
    unit = edges.detach().abs().amax((0, 2)).clamp_min(torch.finfo(edges.dtype).tiny)[:, None]
    return edges / unit, unit


def _volumes(corners: torch.Tensor) -> torch.Tensor:
    a, b, c = corners[1:] - corners[0]
    return (a * torch.linalg.cross(b, c)).sum(1) / 6.0


def _altitudes(corners: torch.Tensor) -> torch.Tensor:
    (a, b, c), unit = _unit_edges(corners)
    bc = torch.linalg.cross(b, c)
    normals = torch.stack((torch.linalg.cross(b - a, c - a), bc, torch.linalg.cross(c, a), torch.linalg.cross(a, b)), 1)
    volume = (a * bc).sum(1, keepdim=True)
    return volume / torch.linalg.vector_norm(normals, dim=2) * unit


def _quality(corners: torch.Tensor) -> torch.Tensor:
    (a, b, c), _ = _unit_edges(corners)
    points = torch.stack((torch.zeros_like(a), a, b, c))
    squares = torch.stack([(points[j] - points[i]).square().sum(1) for i, j in LOCAL_EDGES])
    volume = (a * torch.linalg.cross(b, c)).sum(1) / 6.0
    return _REGULAR_TETRAHEDRON * volume / squares.mean(0).pow(1.5)
