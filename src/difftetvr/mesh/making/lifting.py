"""Giving flat cells inside a mesh a volume by moving as few vertices as little as possible."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.errors import MeshError, counted
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.changes.independent import independent_set
from difftetvr.mesh.topology.faces import LOCAL_FACES, match_faces
from difftetvr.mesh.validation import orientations

_FLOOR = 1e-3
"""Altitude that a flat cell gets, in units of its longest edge."""

_STEEPEST = 0.05
"""Least cosine between a move and the altitude of a flat cell that it shall raise."""

_KEEP = 0.5
"""A cell that has a volume keeps at least this part of it."""

_ULPS = 16.0
"""A move is at least this many units of rounding of the coordinates long."""

_SEARCH_STEPS = 64


@dataclass(frozen=True)
class _Moves:
    """What moving a vertex could do, for vertices of flat cells; C of them.

    Attributes:
        vertices: (C,) int64, ascending.
        step: (C, 3) float64 the least move that lifts all flat cells of the vertex.
        length: (C,) float64, its length; infinity where no move can.
    """

    vertices: torch.Tensor
    step: torch.Tensor
    length: torch.Tensor


def lift_flat_cells(points: torch.Tensor, tets: torch.Tensor, flat: torch.Tensor) -> torch.Tensor:
    """Move vertices of flat cells until every cell has a positive volume.

    A vertex is moved if there is a direction that raises all its flat cells. It goes as far as their floor asks for,
    and no farther than half of any other cell's altitude. Of the vertices that could, those inside go before those on
    the boundary, then those with the shortest way.

    Args:
        points: (V, 3) float32 or float64.
        tets: (T, 4) int32, all positive but the flat ones, which are oriented like their neighbours.
        flat: (T,) bool, cells of exactly no volume.

    Returns:
        (V, 3) the positions afterwards, in the precision of the points.

    Raises:
        MeshError: Some cells are left that no such move can lift.
    """
    points, flat = points.clone(), flat.clone()
    on_boundary = torch.zeros(points.shape[0], dtype=torch.bool)
    outer = match_faces(tets, points.shape[0]).cell_adjacency < 0
    for face, is_outer in zip(LOCAL_FACES, outer.unbind(1)):
        on_boundary[tets[is_outer][:, list(face)].long().flatten()] = True
    hopeless = torch.zeros_like(on_boundary)
    while flat.any():
        moves = _possible_moves(points, tets, flat)
        able = torch.isfinite(moves.length) & ~hopeless[moves.vertices]
        if not able.any():
            first = tets[true_indices(flat)[0]].tolist()
            raise MeshError(
                f"Moving a vertex cannot mend {counted(int(flat.sum()), 'flat cell')} inside the mesh, the first on "
                f"the vertices {tuple(first)}; remesh it there, or leave the cells around it out."
            )
        order = torch.argsort(moves.length[able], stable=True)
        order = order[torch.argsort(on_boundary[moves.vertices[able]][order].int(), stable=True)]
        candidates = true_indices(able)[order]
        count = candidates.numel()
        rank = torch.full((points.shape[0],), count, dtype=torch.int32)
        rank[moves.vertices[candidates]] = torch.arange(count, dtype=torch.int32)
        chosen = candidates[independent_set(tets, rank, count)]
        _try(points, tets, flat, hopeless, moves, chosen)
    return points


def _try(
    points: torch.Tensor,
    tets: torch.Tensor,
    flat: torch.Tensor,
    hopeless: torch.Tensor,
    moves: _Moves,
    chosen: torch.Tensor,
) -> None:
    """Moves vertices of which no two share a cell, in place; takes back what rounding has spoilt."""
    vertices = moves.vertices[chosen]
    before = points[vertices]
    points[vertices] = (before.double() + moves.step[chosen]).to(points.dtype)
    cells, _, owner = _stars(tets, vertices, points.shape[0])
    signs = orientations(points, tets[cells])
    spoilt = torch.zeros(vertices.numel(), dtype=torch.bool)
    spoilt[owner[signs <= 0]] = True
    points[vertices[spoilt]] = before[spoilt]
    hopeless[vertices[spoilt]] = True
    flat[cells[~spoilt[owner]]] = False


def _stars(
    tets: torch.Tensor, vertices: torch.Tensor, num_vertices: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The cells around vertices: for each pair the cell, the local vertex, and the row in `vertices`; by row."""
    row = torch.full((num_vertices,), -1)
    row[vertices] = torch.arange(vertices.numel())
    rows = row[tets.long()].flatten()
    corners = true_indices(rows >= 0)
    corners = corners[torch.argsort(rows[corners], stable=True)]
    return corners >> 2, corners & 3, rows[corners]


def _possible_moves(points: torch.Tensor, tets: torch.Tensor, flat: torch.Tensor) -> _Moves:
    vertices = torch.unique(tets[flat]).long()
    cells, local, owner = _stars(tets, vertices, points.shape[0])
    corners = points.double()[tets[cells].long()]
    opposite = torch.tensor(LOCAL_FACES)[local]
    p, q, r = corners.gather(1, opposite[:, :, None].expand(-1, -1, 3)).unbind(1)
    # Faces look outwards, the vertex is inside: the altitude rises against the normal.
    inward = torch.linalg.cross(r - p, q - p)
    inward = inward / torch.linalg.vector_norm(inward, dim=1, keepdim=True)
    apex = corners[torch.arange(cells.numel()), local]
    altitude = ((apex - p) * inward).sum(1)
    longest = (corners[:, :, None] - corners[:, None]).square().sum(3).amax((1, 2)).sqrt()

    is_flat = flat[cells]
    direction = _rising(inward[is_flat], owner[is_flat], vertices.numel())
    cosine = (inward * direction[owner]).sum(1)
    rounding = _ULPS * torch.finfo(points.dtype).eps * apex.abs().amax(1)
    # NaN, of faces without area, fails every comparison: such a cell cannot be lifted by this vertex.
    wanted = torch.where(cosine >= _STEEPEST, torch.maximum(_FLOOR * longest, rounding) / cosine, torch.inf)
    wanted = torch.where(is_flat, wanted, 0.0)
    room = torch.where(cosine < 0, (1.0 - _KEEP) * altitude / -cosine, torch.inf)
    room = torch.where(is_flat, torch.inf, room)
    least = wanted.new_zeros(vertices.numel()).scatter_reduce(0, owner, wanted, "amax")
    most = wanted.new_full((vertices.numel(),), torch.inf).scatter_reduce(0, owner, room, "amin")
    length = torch.where(torch.isfinite(least), torch.minimum(least, most), torch.inf)
    step = torch.where(torch.isfinite(length)[:, None], direction * length[:, None], 0.0)
    return _Moves(vertices, step, length)


def _rising(normals: torch.Tensor, owner: torch.Tensor, count: int) -> torch.Tensor:
    """For each owner the unit vector whose least product with its normals is as large as can be, nearly.

    It is the direction of the point nearest to the origin in the normals' convex hull (Gilbert's algorithm: step by
    step towards the normal that it agrees with least).

    Args:
        normals: (N, 3) float64 unit vectors.
        owner: (N,) int64 in [0, count), each at least once.
        count: Number of owners.

    Returns:
        (count, 3); no direction raises everything where a product is not positive.
    """
    total = normals.new_zeros((count, 3)).index_add_(0, owner, normals)
    nearest = total / torch.bincount(owner, minlength=count)[:, None]
    for _ in range(_SEARCH_STEPS):
        agreement = (normals * nearest[owner]).sum(1)
        worst = agreement.new_full((count,), torch.inf).scatter_reduce(0, owner, agreement, "amin")
        is_worst = true_indices(agreement == worst[owner])
        target = nearest.clone()
        target[owner[is_worst]] = normals[is_worst]
        way = target - nearest
        share = -(nearest * way).sum(1) / way.square().sum(1).clamp_min(torch.finfo(torch.float64).tiny)
        nearest = nearest + share.clamp(0.0, 1.0)[:, None] * way
    return nearest / torch.linalg.vector_norm(nearest, dim=1, keepdim=True)
