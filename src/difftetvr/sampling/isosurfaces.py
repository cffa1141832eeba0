"""``isosurface``: where a scalar has a level, by marching tetrahedra (Doi & Koide 1991)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from difftetvr.errors import MeshError, shown
from difftetvr.inputs import as_reals
from difftetvr.mesh import TetMesh
from difftetvr.mesh.topology.incidence import cell_edges
from difftetvr.mesh.topology.topology import LOCAL_EDGE_OF
from difftetvr.sampling.probing import checked_values


def isosurface(mesh: TetMesh, scalar: torch.Tensor, level: float | torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The surface on which the linear interpolant of a scalar has a level.

    It is watertight but where it meets the boundary of the mesh. Vertices lie on edges of the mesh, are shared by
    triangles and are differentiable in ``scalar``, ``level`` and ``mesh.vertices``; how these join them is not.

    Args:
        mesh: The mesh, of joined or loose cells.
        scalar: (V,) per vertex.
        level: The level; values at it count as above.

    Returns:
        vertices: (P, 3) places in world space; float64 where the mesh has an origin of its own.
        triangles: (M, 3) int64, counter-clockwise seen from where the scalar is below the level.

    Raises:
        MeshError: There is not one finite scalar for each vertex, or the level is no finite number.
    """
    found = crossed_edges(mesh, scalar, level)
    return found.interpolated(mesh.positions if any(mesh.origin) else mesh.vertices), found.triangles


class CrossedEdges(NamedTuple):
    """Edges of a mesh on which a scalar has a level, each a vertex of the surface.

    Attributes:
        begin: (P,) int64 vertices of the mesh at which the edges begin.
        end: (P,) those at which they end.
        share: (P,) how far along each the level is, in [0, 1]; differentiable.
        triangles: (M, 3) int64 edges that triangles join.
    """

    begin: torch.Tensor
    end: torch.Tensor
    share: torch.Tensor
    triangles: torch.Tensor

    def interpolated(self, values: torch.Tensor) -> torch.Tensor:
        """(P, ...) values at the places on the edges, of (V, ...) values of the mesh's vertices; differentiable."""
        share = self.share.reshape(-1, *[1] * (values.ndim - 1))
        return values[self.begin] + share * (values[self.end] - values[self.begin])


def crossed_edges(mesh: TetMesh, scalar: torch.Tensor, level: float | torch.Tensor) -> CrossedEdges:
    """Where a scalar has a level, as `isosurface` has it, to take other values there, too.

    Raises:
        MeshError: As `isosurface`.
    """
    table, _ = checked_values(mesh, scalar, "vertex")
    if table.shape[1] != 1:
        raise MeshError(f"There are {table.shape[1]} values for each vertex; pass one scalar, (V,).")
    values = table[:, 0]
    if not bool(torch.isfinite(values.detach()).all()):
        raise MeshError("A scalar is not finite; give finite values, or remove the cells around them.")
    height = as_reals(level, "level", MeshError, values.dtype, "give a finite number")
    if height.numel() != 1 or not math.isfinite(float(height.detach())):
        raise MeshError(f"level is {shown(level)}; give a finite number.")
    height = height.reshape(()).to(values.device)  # of no dimension, so that it takes the precision of the values
    above = values.detach() >= height.detach().to(values)
    edges = mesh.topology.edges.long()
    is_cut = above[edges[:, 0]] != above[edges[:, 1]]
    number = torch.cumsum(is_cut, 0) - 1
    triangles = _triangles(above[mesh.tets.long()], cell_edges(mesh.topology).long())
    begin, end = edges[is_cut].unbind(1)
    from_begin, length = (0.5 * part - 0.5 * values[begin] for part in (height, values[end]))  # halves do not overflow
    share = from_begin / length
    return CrossedEdges(begin, end, share, number[triangles])


def at_vertices(mesh: TetMesh, values: torch.Tensor) -> torch.Tensor:
    """(V, ...) means of the (T, ...) values of the cells around each vertex, weighted by volume."""
    volumes = mesh.volumes().to(values.dtype)
    weights = (volumes / volumes.amax()).reshape(-1, *[1] * (values.ndim - 1))
    total, weight = (part.new_zeros((mesh.num_vertices, *part.shape[1:])) for part in (values, weights))
    for corner in mesh.tets.long().unbind(1):
        total.index_add_(0, corner, weights * values)
        weight.index_add_(0, corner, weights)
    return total / weight


def _triangles(above: torch.Tensor, edges: torch.Tensor) -> torch.Tensor:
    """(M, 3) edges of the mesh that triangles join.

    Args:
        above: (T, 4) which corners of the cells are above.
        edges: (T, 6) edges of the cells.
    """
    case = (above.long() * torch.tensor([1, 2, 4, 8], device=above.device)).sum(1)
    parts = []
    for code in range(1, 15):
        cells = torch.nonzero(case == code).flatten()
        parts += [edges[cells][:, list(triangle)] for triangle in _CASES[code]]
    return torch.cat(parts)


def _cases() -> list[list[tuple[int, int, int]]]:
    """Local edges of the triangles for each set of corners that are above, as bits."""
    cases: list[list[tuple[int, int, int]]] = []
    for code in range(16):
        high = [k for k in range(4) if code >> k & 1]
        low = [k for k in range(4) if not code >> k & 1]
        if len(high) == 1:
            cases.append([_around(high[0])])
        elif len(low) == 1:
            a, b, c = _around(low[0])
            cases.append([(a, c, b)])
        elif len(high) == 2:
            (i, j), (m, n) = high, low
            # The quadrilateral im, in, jn, jm; its sense is that of the permutation (i, j, m, n).
            ring = [LOCAL_EDGE_OF[i][m], LOCAL_EDGE_OF[i][n], LOCAL_EDGE_OF[j][n], LOCAL_EDGE_OF[j][m]]
            if _is_odd([i, j, m, n]):
                ring.reverse()
            cases.append([(ring[0], ring[1], ring[2]), (ring[0], ring[2], ring[3])])
        else:
            cases.append([])
    return cases


def _around(corner: int) -> tuple[int, int, int]:
    """Edges at a corner, counter-clockwise seen from the face opposite it."""
    others = [k for k in range(4) if k != corner]
    if _is_odd([corner, *others]):
        others.reverse()
    a, b, c = (LOCAL_EDGE_OF[corner][k] for k in others)
    return a, b, c


def _is_odd(permutation: list[int]) -> bool:
    inversions = sum(x > y for place, x in enumerate(permutation) for y in permutation[place + 1 :])
    return inversions % 2 == 1


_CASES = _cases()
