"""Half-edge collapse: a vertex is merged into a neighbour, and the cells around their edge vanish."""

from __future__ import annotations

import math
from typing import Literal

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import chunks, true_indices
from difftetvr.mesh.boundary import BoundaryConstraint, keeps_surface
from difftetvr.mesh.changes.change import MeshChange, check_indices, with_vertices_kept
from difftetvr.mesh.changes.collapse_shapes import keeps_shapes
from difftetvr.mesh.changes.independent import BestFirst
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import boundary_vertices, stars
from difftetvr.mesh.topology.link import link_condition
from difftetvr.mesh.topology.lookup import is_corner
from difftetvr.mesh.topology.topology import Topology

_SMALLEST_BATCH = 2048
_CELLS_PER_COLLAPSE = 4
"""How many cells a collapse is expected to remove; it decides the size of batches only, never the result."""
_SLOWDOWN = 2.0
"""How many times as many candidates as in the last batch are expected to be needed for each cell that vanishes."""


def collapse_edges(
    mesh: TetMesh,
    edges: torch.Tensor,
    target: torch.Tensor,
    cost: torch.Tensor,
    *,
    limit: int | None = None,
    min_quality: float = 0.1,
    boundary: Literal["fixed", "slide"] = "fixed",
    coplanarity: float = 1e-4,
) -> MeshChange:
    """Merge vertices into neighbours, cheapest first, where the mesh stays valid and its shapes stay good.

    Vertex v may be merged into its neighbour u if

    - v is not on the boundary (u may be), or with boundary="slide" both are and the boundary stays the same surface: v
      lies in a plane of it, or on a straight crease of planes and u further along the crease; corners stay;
    - the link condition Lk(u) ∩ Lk(v) = Lk(uv) holds, so the result is the same manifold;
    - all cells around v that remain have positive volume, and quality of at least `min_quality`; where the worst cell
      around v is worse than that already, none may become worse than it.

    The remaining cells around v then fill the same space as before, without overlap: what bounds them together is the
    same, but for faces that move within their own planes (see `keeps_surface`), and none of them is inverted.
    Collapses that are done together have no cell around their removed vertices in common, nor a boundary face that they
    make, so each is as valid as it would be alone. The choice is that of doing them one by one in the order of cost;
    ties are broken in a fixed order.

    Args:
        mesh: The mesh.
        edges: (C,) indices into `mesh.topology.edges`, candidates only; an edge may come twice, once for each end.
        target: (C,) 0 or 1, the end of the edge that stays, as a column of `mesh.topology.edges`.
        cost: (C,) real numbers, lowest first.
        limit: How many cells may vanish in all; choosing ends before the first collapse that would exceed it.
        min_quality: Smallest quality of a changed cell (see `difftetvr.mesh.quality`).
        boundary: Whether vertices on the boundary stay, or go where its shape does not need them.
        coplanarity: Largest sine of the angle between boundary faces that count as one plane, in [0, 1); positions are
            rounded, so in general 0 lets none slide.

    Returns:
        The change. Vertices and cells that remain keep their order, and vertices their place among a cell's corners; a
        changed cell's parent is the one it was before v moved to u. Vertices that no cell uses stay.

    Raises:
        MeshError: An index is out of range, cost is NaN, lengths do not match, or an option is none of the above.
    """
    _check(edges, target, cost, boundary, coplanarity)
    edges = check_indices(edges, mesh.topology.edges.shape[0], "edge")
    target = check_indices(target, 2, "target")
    candidates = _Candidates(mesh, edges, target, coplanarity if boundary == "slide" else None)
    chosen = _choose(mesh, BestFirst(-cost.detach()), candidates, limit, min_quality)
    return _apply(mesh, _without_twins(mesh, chosen))


def _check(edges: torch.Tensor, target: torch.Tensor, cost: torch.Tensor, boundary: str, coplanarity: float) -> None:
    if edges.ndim != 1 or target.shape != edges.shape or cost.shape != edges.shape:
        shapes = ", ".join(str(tuple(tensor.shape)) for tensor in (edges, target, cost))
        raise MeshError(f"Edges, target and cost have shapes {shapes}; pass three times (C,).")
    if torch.isnan(cost).any():
        raise MeshError("The cost is NaN somewhere; pass real numbers, and inf for what should come last.")
    if boundary not in ("fixed", "slide") or not 0 <= coplanarity < 1:
        raise MeshError(
            f"The boundary is {boundary!r} with a coplanarity of {coplanarity}; pass 'fixed' or 'slide' and a number "
            "of at least 0 and below 1."
        )


class _Candidates:
    """The collapses that a caller proposes, looked at only when it is their turn."""

    def __init__(self, mesh: TetMesh, edges: torch.Tensor, target: torch.Tensor, coplanarity: float | None) -> None:
        """No table is made yet but for the boundary's.

        Args:
            mesh: The mesh.
            edges: (C,) int64, see `collapse_edges`.
            target: (C,) int64, see `collapse_edges`.
            coplanarity: See `collapse_edges`; None where vertices on the boundary stay.
        """
        self._mesh = mesh
        self._edges = edges
        self._target = target
        self._outer = boundary_vertices(mesh.topology)
        self._coplanarity = coplanarity
        self._constraint = None if coplanarity is None else BoundaryConstraint.sliding(mesh, coplanarity)

    def half_edges(self, places: torch.Tensor) -> torch.Tensor:
        """Those that leave the boundary as it is.

        Args:
            places: (N,) int64 indices of candidates.

        Returns:
            (M, 2) int32, [vertex to remove, vertex to keep], in the order of `places`.
        """
        ends = self._mesh.topology.edges.index_select(0, self._edges.index_select(0, places))
        kept = ends.gather(1, self._target.index_select(0, places)[:, None])
        removed = ends.sum(1, keepdim=True, dtype=ends.dtype) - kept
        pairs = torch.cat((removed, kept), 1)
        movable = ~self._outer.index_select(0, pairs[:, 0])
        if self._coplanarity is not None:
            sliding = true_indices(~movable & self._outer.index_select(0, pairs[:, 1]))
            movable[sliding] = keeps_surface(self._mesh, pairs[sliding], self._coplanarity, self._constraint)
        return pairs[movable]


def _choose(
    mesh: TetMesh, queue: BestFirst, candidates: _Candidates, limit: int | None, min_quality: float
) -> torch.Tensor:
    """Collapses (N, 2), [vertex to remove, vertex to keep], that are valid, independent and within the limit.

    Args:
        mesh: The mesh.
        queue: Numbers of the candidates.
        candidates: What they are.
        limit: See `collapse_edges`.
        min_quality: See `collapse_edges`.
    """
    blocked = torch.zeros(mesh.num_vertices, dtype=torch.bool, device=mesh.tets.device)
    chosen, left, within = [mesh.tets[:0, :2]], limit, True
    # With a limit the head of the queue is enough, which is looked at in batches until the limit is reached.
    batch = len(queue) if limit is None else _SMALLEST_BATCH + max(limit, 0) // _CELLS_PER_COLLAPSE
    while len(queue) and within:
        head = queue.take(batch)
        half_edges = candidates.half_edges(head)
        keeps, vanishing = keeps_shapes(mesh, half_edges, min_quality)
        rows = true_indices(keeps)
        taken, counts = _choose_among(mesh, half_edges.index_select(0, rows), vanishing[rows], blocked)
        if left is not None:
            fits = counts.cumsum(0) <= left
            vanished = int(counts[fits].sum())
            taken, left = taken[fits], left - vanished
            within = left > 0 and bool(fits.all())
            batch = _next_batch(head.shape[0], vanished, left)
        chosen.append(taken)
    return torch.cat(chosen)


def _next_batch(batch: int, vanished: int, left: int) -> int:
    """How many candidates to look at next, if `batch` of them removed `vanished` cells and `left` more may vanish.

    The later, the more of them are around vertices that others have changed already.
    """
    needed = batch * left * _SLOWDOWN / vanished if vanished else math.inf
    return max(_SMALLEST_BATCH, int(min(2.0 * batch, needed)))


def _choose_among(
    mesh: TetMesh, queue: torch.Tensor, vanishing: torch.Tensor, blocked: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """What taking collapses one by one from the queue would do, and how many cells each of them removes.

    In each round, the collapses that come before all others around their removed vertex are decided at once.

    Args:
        mesh: The mesh.
        queue: (C, 2) int32, best first; all of them leave good shapes.
        vanishing: (C,) how many cells each of them removes.
        blocked: (V,) bool, vertices around which cells have changed; updated in place.

    Returns:
        (N, 2) int32 collapses, best first, and (N,) counts of cells.
    """
    count = queue.shape[0]
    removed = queue[:, 0].long()
    pending = true_indices(~blocked.index_select(0, removed))
    removes = torch.zeros(count, dtype=torch.int64, device=queue.device)
    edges = mesh.topology.edges
    while pending.shape[0]:
        vertices = removed.index_select(0, pending)
        rank = torch.full((mesh.num_vertices,), count, dtype=torch.int32, device=queue.device)
        rank.scatter_reduce_(0, vertices, pending.int(), "amin")
        edges, later = _between_candidates(edges, rank, count)
        leads = torch.zeros(count, dtype=torch.bool, device=queue.device)
        leads[rank.index_select(0, vertices).long()] = True
        leads[later.long()] = False
        leaders = true_indices(leads)
        winners = leaders[link_condition(mesh.topology, queue.index_select(0, leaders).long())]
        removes[winners] = vanishing[winners]
        _, around = stars(mesh.topology, removed.index_select(0, winners))
        blocked[mesh.tets.index_select(0, around).view(-1).long()] = True
        pending = pending[~(blocked.index_select(0, vertices) | leads.index_select(0, pending))]
    taken = true_indices(removes > 0)
    return queue[taken], removes[taken]


def _between_candidates(edges: torch.Tensor, rank: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows of `edges` (E, 2) with both ends of a rank below count, and the higher rank (E',) of each."""
    kept, highest = [edges[:0]], [rank[:0]]
    for part in chunks(edges.shape[0], edges.device, width=2):
        ranks = rank.index_select(0, edges[part].reshape(-1)).view(-1, 2)
        later = torch.maximum(ranks[:, 0], ranks[:, 1])
        rows = true_indices(later < count)
        kept.append(edges[part].index_select(0, rows))
        highest.append(later.index_select(0, rows))
    return torch.cat(kept), torch.cat(highest)


def _without_twins(mesh: TetMesh, half_edges: torch.Tensor) -> torch.Tensor:
    """Leave out each collapse that makes a boundary face which one before it makes as well.

    It happens on the two sides of a slit without width, where the two faces would be paired as one inner face.
    """
    count = half_edges.shape[0]
    rank = half_edges.new_full((mesh.num_vertices,), count, dtype=torch.int64)
    rank[half_edges[:, 0].long()] = torch.arange(count, device=rank.device)
    faces = mesh.topology.boundary_faces.long()
    # Removed vertices are no neighbours, so a face has one of them at most.
    maker = rank[faces].amin(1)
    made = true_indices(maker < count)
    corners = _moved_to(mesh, half_edges)[faces[made]].sort(1).values
    remains = (corners.diff(dim=1) > 0).all(1)
    maker = maker[made[remains]]
    _, twin = torch.unique(corners[remains], dim=0, return_inverse=True)
    first = torch.full_like(maker, count).scatter_reduce_(0, twin, maker, "amin")
    stays = torch.ones(count, dtype=torch.bool, device=rank.device)
    stays[maker[maker > first[twin]]] = False
    return half_edges[stays]


def _moved_to(mesh: TetMesh, half_edges: torch.Tensor) -> torch.Tensor:
    """(V,) int32: the vertex that each vertex becomes."""
    moved_to = torch.arange(mesh.num_vertices, dtype=torch.int32, device=half_edges.device)
    moved_to[half_edges[:, 0].long()] = half_edges[:, 1]
    return moved_to


def _apply(mesh: TetMesh, half_edges: torch.Tensor) -> MeshChange:
    moved_to, removed = _moved_to(mesh, half_edges), half_edges[:, 0].long()
    is_kept = torch.ones(mesh.num_vertices, dtype=torch.bool, device=half_edges.device)
    is_kept[removed] = False
    kept = true_indices(is_kept)
    renumbered = is_kept.cumsum(0, dtype=torch.int32) - 1

    owner, around = stars(mesh.topology, removed)
    vanishes = is_corner(mesh.tets.index_select(0, around).t(), half_edges[:, 1].index_select(0, owner))
    remains = torch.ones(mesh.num_cells, dtype=torch.bool, device=half_edges.device)
    remains[around[vanishes]] = False
    cells = true_indices(remains)
    renumber = renumbered.index_select(0, moved_to)
    tets = renumber.index_select(0, mesh.tets.index_select(0, cells).view(-1)).view(-1, 4)
    return with_vertices_kept(mesh, kept, Topology(tets, kept.shape[0]), cells.int())
