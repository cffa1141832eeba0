"""Edge bisection: a new vertex in the middle of edges, every cell around them halved."""

from __future__ import annotations

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import chunks, constant, true_indices
from difftetvr.mesh.changes.change import MeshChange, check_indices, with_midpoints
from difftetvr.mesh.changes.independent import best_first, independent_set
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import cell_edges, cells_per_edge, known_edges
from difftetvr.mesh.topology.topology import LOCAL_EDGES
from difftetvr.mesh.validation import orientations

_SMALLEST_BATCH = 4096


def bisect_edges(mesh: TetMesh, edges: torch.Tensor, priority: torch.Tensor | None = None) -> MeshChange:
    """Bisect edges of which no two share a cell.

    Every cell around a bisected edge becomes two of half its volume, by the plane through the midpoint and the opposite
    edge. Both halves keep the cell's orientation, and the cells around an edge cut their common faces alike, so the
    result conforms. Boundary edges may be bisected: the boundary stays the same surface.

    Args:
        mesh: The mesh.
        edges: (N,) indices into `mesh.topology.edges`, or (N, 2) vertex pairs; not necessarily independent. Of edges
            that share a cell the first by priority is bisected.
        priority: (N,) real numbers, highest first; None takes `edges` in the order they come.

    Returns:
        The change, cell_parents ascending. The new vertices are in the order of their edges in `mesh.topology.edges`.
        An edge whose midpoint, rounded to the mesh's precision, would flatten a cell is left as it is.

    Raises:
        MeshError: An index or pair is no edge of the mesh, priority is NaN, or lengths do not match.
    """
    indices = _edge_indices(mesh, edges)
    if priority is None:
        order = torch.arange(indices.shape[0], device=indices.device)
    else:
        _check_priority(priority, indices.shape[0], "edges passed")
        order = best_first(priority.detach())
    # Of an edge that was passed twice the better rank counts.
    rank = torch.full((mesh.topology.edges.shape[0],), order.shape[0], dtype=torch.int32, device=order.device)
    places = torch.arange(order.shape[0], dtype=torch.int32, device=order.device)
    rank.scatter_reduce_(0, indices[order], places, "amin")
    table = cell_edges(mesh.topology)
    chosen = independent_set(table, rank, order.shape[0])
    return _bisect(mesh, indices[order[chosen]].sort().values)


def independent_edges(
    mesh: TetMesh, priority: torch.Tensor, allowed: torch.Tensor | None = None, budget: int | None = None
) -> torch.Tensor:
    """Choose edges to bisect, highest priority first, such that no two share a cell.

    The result is that of taking edges one by one in the order of priority, leaving out those with a cell in common with
    an earlier one; it is found in parallel. Equal priorities are taken in a fixed order that looks random.

    Args:
        mesh: The mesh.
        priority: (E,) real numbers, for each of `mesh.topology.edges`.
        allowed: (E,) bool, edges that may be chosen (see `long_edges`); None allows all.
        budget: How many cells the bisections may add in all, one for each cell around a chosen edge; choosing ends
            before the first edge that would exceed it. None: no limit.

    Returns:
        (N,) int64 indices into `mesh.topology.edges`, in the order of priority.

    Raises:
        MeshError: priority or allowed have another length than the edges, or priority is NaN.
    """
    num_edges = mesh.topology.edges.shape[0]
    _check_priority(priority, num_edges, "edges")
    if allowed is not None and allowed.shape != (num_edges,):
        raise MeshError(f"`allowed` has shape {tuple(allowed.shape)}; pass one bool for each of the {num_edges} edges.")
    candidates = torch.arange(num_edges, device=priority.device) if allowed is None else true_indices(allowed)
    queue = candidates[best_first(priority.detach()[candidates])]

    table = cell_edges(mesh.topology)
    degrees = cells_per_edge(mesh.topology)
    blocked = torch.zeros(num_edges, dtype=torch.bool, device=queue.device)
    chosen, added = [queue[:0]], 0
    # With a budget the head of the queue is enough; it grows until the budget is used up.
    batch = queue.shape[0] if budget is None else max(_SMALLEST_BATCH, budget)
    within = True
    while queue.shape[0] and within:
        head, queue = queue[:batch], queue[batch:]
        taken = _independent_among(table, head[~blocked[head]], num_edges)
        if budget is not None:
            fits = degrees[taken].cumsum(0) <= budget - added
            within = bool(fits.all())
            taken = taken[fits]
        chosen.append(taken)
        added += int(degrees[taken].sum())
        if queue.shape[0] and within:
            _block(table, taken, blocked)
        batch *= 2
    return torch.cat(chosen)


def long_edges(mesh: TetMesh, ratio: float = 0.6) -> torch.Tensor:
    """Edges that are long in each of their cells: bisecting these alone keeps the shapes of cells good.

    Args:
        mesh: The mesh.
        ratio: Smallest length in units of the longest edge of a cell, in [0, 1].

    Returns:
        (E,) bool, for each of `mesh.topology.edges`: at least `ratio` of the longest edge of each of its cells. The
        longest edge of the whole mesh always is.
    """
    edges = mesh.topology.edges
    table = cell_edges(mesh.topology)
    positions = mesh.vertices.detach().double()
    ends = [positions.index_select(0, edges[:, k]) for k in (0, 1)]
    lengths = torch.linalg.vector_norm(ends[1] - ends[0], dim=1)
    allowed = torch.ones(edges.shape[0], dtype=torch.bool, device=edges.device)
    for part in chunks(table.shape[0], table.device, width=6):
        of_cell = lengths.index_select(0, table[part].reshape(-1)).view(-1, 6)
        short = of_cell < ratio * of_cell.amax(1, keepdim=True)
        allowed[table[part][short]] = False
    return allowed


def _edge_indices(mesh: TetMesh, edges: torch.Tensor) -> torch.Tensor:
    if edges.ndim == 2 and edges.shape[1] == 2:
        return known_edges(mesh.topology, check_indices(edges, mesh.num_vertices, "vertex"))
    if edges.ndim != 1:
        raise MeshError(f"The edges have shape {tuple(edges.shape)}; pass (N,) edge indices or (N, 2) vertex pairs.")
    return check_indices(edges, mesh.topology.edges.shape[0], "edge")


def _check_priority(priority: torch.Tensor, count: int, what: str) -> None:
    if priority.shape != (count,):
        raise MeshError(
            f"The priority has shape {tuple(priority.shape)}; pass one value for each of the {count} {what}."
        )
    if torch.isnan(priority).any():
        raise MeshError("The priority is NaN somewhere; pass real numbers, and -inf for what should come last.")


def _independent_among(table: torch.Tensor, queue: torch.Tensor, num_edges: int) -> torch.Tensor:
    """The edges of `queue`, best first, that remain when those in conflict with earlier ones are left out."""
    count = queue.shape[0]
    rank = torch.full((num_edges,), count, dtype=torch.int32, device=queue.device)
    rank[queue] = torch.arange(count, dtype=torch.int32, device=queue.device)
    return queue[independent_set(table, rank, count)]


def _block(table: torch.Tensor, taken: torch.Tensor, blocked: torch.Tensor) -> None:
    """Mark all edges of all cells around the edges taken, in place."""
    is_taken = torch.zeros_like(blocked)
    is_taken[taken] = True
    for part in chunks(table.shape[0], table.device, width=6):
        used = is_taken.index_select(0, table[part].reshape(-1)).view(-1, 6).any(1)
        blocked[table[part][used].reshape(-1)] = True


def _bisect(mesh: TetMesh, edges: torch.Tensor) -> MeshChange:
    """Bisect independent edges, ascending."""
    topology = mesh.topology
    table = cell_edges(topology)
    midpoint = torch.full((topology.edges.shape[0],), -1, dtype=torch.int32, device=edges.device)
    first = mesh.num_vertices
    midpoint[edges] = torch.arange(first, first + edges.shape[0], dtype=torch.int32, device=edges.device)
    new_vertex = midpoint.index_select(0, table.view(-1)).view(-1, 6)
    halved = new_vertex.amax(1) >= 0
    parents = torch.repeat_interleave(1 + halved.int())
    cell_parents = parents.int()
    tets = topology.tets.index_select(0, parents)

    rows = true_indices(halved)
    vertex, local_edge = new_vertex[rows].max(1)
    local_ends = constant(LOCAL_EDGES, rows.device)[local_edge]
    # Every halved cell before this one has moved it by one place.
    lower = rows + torch.arange(rows.shape[0], device=rows.device)
    tets[lower, local_ends[:, 1]] = vertex
    tets[lower + 1, local_ends[:, 0]] = vertex

    change = with_midpoints(mesh, topology.edges[edges], tets, cell_parents)
    flat = _cells_not_positive(change.mesh, lower)
    if not flat.numel():
        return change
    spoiled = torch.unique(table[cell_parents[flat].long()][new_vertex[cell_parents[flat].long()] >= 0])
    return _bisect(mesh, edges[~torch.isin(edges, spoiled)])


def _cells_not_positive(mesh: TetMesh, lower: torch.Tensor) -> torch.Tensor:
    """Which of the halves, in rows `lower` and the ones after, the rounding of midpoints has flattened or inverted."""
    halves = torch.cat((lower, lower + 1))
    return halves[orientations(mesh.vertices, mesh.tets[halves]) <= 0]
