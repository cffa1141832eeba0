"""Half-edge collapse: a vertex is merged into a neighbour, and the cells around their edge vanish."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh import quality
from difftetvr.mesh.arrays import chunks, true_indices
from difftetvr.mesh.boundary import keeps_surface
from difftetvr.mesh.change import MeshChange, check_indices, with_vertices_kept
from difftetvr.mesh.incidence import boundary_vertices, stars
from difftetvr.mesh.independent import best_first
from difftetvr.mesh.link import link_condition
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology import Topology

_SMALLEST_BATCH = 2048
_CELLS_PER_COLLAPSE = 4
"""How many cells a collapse is expected to remove; it decides the size of batches only, never the result."""


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
    edges = check_indices(edges, mesh.topology.edges.shape[0], "edge")
    target = check_indices(target, 2, "target")
    outer = boundary_vertices(mesh.topology)

    def half_edges(places: torch.Tensor) -> torch.Tensor:
        """(N, 2) int32, [vertex to remove, vertex to keep] of those that leave the boundary as it is."""
        ends = mesh.topology.edges[edges[places]]
        kept = ends.gather(1, target[places, None])
        removed = ends.sum(1, keepdim=True, dtype=ends.dtype) - kept
        pairs = torch.cat((removed, kept), 1)
        movable = ~outer[pairs[:, 0].long()]
        if boundary == "slide":
            sliding = true_indices(~movable & outer[pairs[:, 1].long()])
            movable[sliding] = keeps_surface(mesh, pairs[sliding], coplanarity)
        return pairs[movable]

    queue = best_first(-cost.detach())
    return _apply(mesh, _without_twins(mesh, _choose(mesh, queue, half_edges, limit, min_quality)))


def _choose(
    mesh: TetMesh,
    queue: torch.Tensor,
    half_edges: Callable[[torch.Tensor], torch.Tensor],
    limit: int | None,
    min_quality: float,
) -> torch.Tensor:
    """Collapses (N, 2), [vertex to remove, vertex to keep], that are valid, independent and within the limit.

    Args:
        mesh: The mesh.
        queue: (C,) int64 numbers of the candidates, best first.
        half_edges: Gives the collapses (N, 2) of candidates, without those that would change the boundary.
        limit: See `collapse_edges`.
        min_quality: See `collapse_edges`.
    """
    blocked = torch.zeros(mesh.num_vertices, dtype=torch.bool, device=queue.device)
    chosen, vanished, within = [half_edges(queue[:0])], 0, True
    # With a limit the head of the queue is enough; it grows until the limit is reached.
    batch = queue.shape[0] if limit is None else _SMALLEST_BATCH + limit // _CELLS_PER_COLLAPSE
    while queue.shape[0] and within:
        head, queue = queue[:batch], queue[batch:]
        taken, counts = _choose_among(mesh, half_edges(head), blocked, min_quality)
        if limit is not None:
            fits = counts.cumsum(0) <= limit - vanished
            within = bool(fits.all())
            taken, counts = taken[fits], counts[fits]
        chosen.append(taken)
        vanished += int(counts.sum())
        batch *= 2
    return torch.cat(chosen)


def _choose_among(
    mesh: TetMesh, queue: torch.Tensor, blocked: torch.Tensor, min_quality: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """What taking collapses one by one from the queue would do, and how many cells each of them removes.

    In each round, the collapses that come before all others around their removed vertex are decided at once.

    Args:
        mesh: The mesh.
        queue: (C, 2) int32, best first.
        blocked: (V,) bool, vertices around which cells have changed; updated in place.
        min_quality: See `collapse_edges`.

    Returns:
        (N, 2) int32 collapses, best first, and (N,) counts of cells.
    """
    count = queue.shape[0]
    removed = queue[:, 0].long()
    degrees = torch.diff(mesh.topology.vertex_cells[0])
    pending = true_indices(~blocked[removed])
    removes = torch.zeros(count, dtype=torch.int64, device=queue.device)
    groups = mesh.tets
    while pending.shape[0]:
        rank = torch.full((mesh.num_vertices,), count, dtype=torch.int32, device=queue.device)
        rank.scatter_reduce_(0, removed[pending], pending.int(), "amin")
        groups, first = _with_candidates(groups, rank, count)
        wins = torch.bincount(first, minlength=count)
        leaders = true_indices((wins > 0) & (wins == degrees[removed]))
        valid, vanishing = _valid(mesh, queue[leaders], min_quality)
        removes[leaders[valid]] = vanishing[valid]
        _, around = stars(mesh.topology, removed[leaders[valid]])
        blocked[mesh.tets[around].view(-1).long()] = True
        blocked_now = blocked[removed[pending]]
        pending = pending[~blocked_now & ~torch.isin(pending, leaders)]
    taken = true_indices(removes > 0)
    return queue[taken], removes[taken]


def _with_candidates(groups: torch.Tensor, rank: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows of `groups` (G, 4) with a vertex of a rank below count, and the lowest rank (G',) of each."""
    kept, lowest = [groups[:0]], [rank[:0]]
    for part in chunks(groups.shape[0], groups.device, width=4):
        first = rank.index_select(0, groups[part].reshape(-1)).view(-1, 4).amin(1)
        rows = true_indices(first < count)
        kept.append(groups[part][rows])
        lowest.append(first[rows])
    return torch.cat(kept), torch.cat(lowest)


def _valid(mesh: TetMesh, half_edges: torch.Tensor, min_quality: float) -> tuple[torch.Tensor, torch.Tensor]:
    """(N,) bool, which collapses are valid alone, and (N,) how many cells each would remove."""
    count = half_edges.shape[0]
    owner, cells = stars(mesh.topology, half_edges[:, 0].long())
    tets = mesh.tets[cells]
    removed, kept = half_edges.unbind(1)
    vanishes = (tets == kept[owner, None]).any(1)
    stays = true_indices(~vanishes)
    changed_owner = owner[stays]
    changed = torch.where(tets[stays] == removed[changed_owner, None], kept[changed_owner, None], tets[stays])
    positions = mesh.vertices.detach().double()
    worst = _worst(quality.quality(positions, changed), changed_owner, count)

    valid = worst >= max(min_quality, quality.FLAT)
    doubtful = (worst > quality.FLAT) & ~valid
    rows = true_indices(doubtful[owner])
    worst_before = _worst(quality.quality(positions, tets[rows]), owner[rows], count)
    valid |= doubtful & (worst >= worst_before)
    indices = true_indices(valid)
    valid[indices] = link_condition(mesh.topology, half_edges[indices].long())
    return valid, torch.bincount(owner[vanishes], minlength=count)


def _worst(values: torch.Tensor, owner: torch.Tensor, count: int) -> torch.Tensor:
    largest = torch.full((count,), torch.inf, dtype=values.dtype, device=values.device)
    return largest.scatter_reduce_(0, owner, values, "amin")


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

    _, around = stars(mesh.topology, removed)
    target = moved_to.index_select(0, mesh.tets[around].view(-1)).view(-1, 4)
    twice = (target.sort(1).values.diff(dim=1) == 0).any(1)
    remains = torch.ones(mesh.num_cells, dtype=torch.bool, device=half_edges.device)
    remains[around[twice]] = False
    cells = true_indices(remains)
    renumber = renumbered.index_select(0, moved_to)
    tets = renumber.index_select(0, mesh.tets.index_select(0, cells).view(-1)).view(-1, 4)
    return with_vertices_kept(mesh, kept, Topology(tets, kept.shape[0]), cells.int())
