"""Edges with few cells around them, and these cells in their order around the edge."""

from __future__ import annotations

import torch

from difftetvr.mesh.arrays import chunks, constant, sort_keys, true_indices
from difftetvr.mesh.topology.incidence import cell_edges
from difftetvr.mesh.topology.topology import LOCAL_EDGES, Topology

_OTHER_CORNERS = ((2, 3), (3, 1), (1, 2), (0, 3), (2, 0), (0, 1))
"""For each of `LOCAL_EDGES` i, j the other corners x, y, such that x, y, i, j is an even permutation."""

_PATTERNS = tuple((*others, *edge) for others, edge in zip(_OTHER_CORNERS, LOCAL_EDGES, strict=True))
_PLACE_BITS = 32
_PLACE_MASK = (1 << _PLACE_BITS) - 1


def closed_rings(topology: Topology, size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The inner edges that have a given number of cells around them, and what lies around them.

    Args:
        topology: The cells.
        size: Number of cells around an edge, at least 3.

    Returns:
        edge (N, 2) int32, the smaller vertex first; ring (N, size) int32, the vertices around it; and cells (N, size)
        int32, such that ring[k], ring[k + 1], edge[0], edge[1] are the corners of cells[k], positively oriented.
        Edges on the boundary are left out, and so are edges at which the mesh merely touches itself.
    """
    places = _cells_by_edge(cell_edges(topology), size)
    none = topology.tets[:0, :1]
    edges, rings, around = [none.expand(0, 2)], [none.expand(0, size)], [none.expand(0, size)]
    for part in chunks(places.shape[0], places.device, width=4 * size):
        cells = places[part] // len(LOCAL_EDGES)
        corners = _corners_around(topology.tets, cells, places[part] % len(LOCAL_EDGES))
        ring, order, is_closed = _walk(corners[..., 0], corners[..., 1])
        rows = true_indices(is_closed)
        edges.append(corners[rows, 0, 2:])
        rings.append(ring[rows])
        around.append(cells.gather(1, order)[rows].int())
    return torch.cat(edges), torch.cat(rings), torch.cat(around)


def _cells_by_edge(table: torch.Tensor, size: int) -> torch.Tensor:
    """Places in the table of cells' edges, (N, size) int64, a row for each edge that has `size` cells."""
    degree = torch.bincount(table.view(-1))
    keys = [table.new_empty(0, dtype=torch.int64)]
    for part in chunks(table.shape[0], table.device, width=6):
        edges = table[part].reshape(-1)
        rows = true_indices(degree.index_select(0, edges) == size)
        keys.append((edges[rows].long() << _PLACE_BITS) | (rows + len(LOCAL_EDGES) * part.start))
    return (sort_keys(torch.cat(keys)) & _PLACE_MASK).view(-1, size)


def _corners_around(tets: torch.Tensor, cells: torch.Tensor, local_edges: torch.Tensor) -> torch.Tensor:
    """Corners x, y, i, j of cells (N, K, 4), positively oriented; i, j is the edge, i < j."""
    places = 4 * cells[..., None] + constant(_PATTERNS, tets.device)[local_edges]
    corners = tets.view(-1).index_select(0, places.view(-1)).view(places.shape)
    return torch.where((corners[..., 2] > corners[..., 3])[..., None], corners[..., [1, 0, 3, 2]], corners)


def _walk(starts: torch.Tensor, ends: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Go round edges from cell to cell.

    No start comes twice in a row, and no cell leads back to where another came from: both would be overlaps, which no
    valid mesh has. So a walk that closes after as many steps as there are cells has been in each of them.

    Args:
        starts: (N, K), where each cell around an edge begins.
        ends: (N, K), where it ends.

    Returns:
        ring (N, K), the starts in order; order (N, K) int64, the cells in order; and closed (N,) bool.
    """
    first = starts[:, :1]
    now, ring, order = first, [], []
    is_closed = torch.ones(starts.shape[0], dtype=torch.bool, device=starts.device)
    for _ in range(starts.shape[1]):
        follows = starts == now
        is_closed &= follows.any(1)
        step = follows.int().argmax(1, keepdim=True)
        ring.append(now)
        order.append(step)
        now = ends.gather(1, step)
    return torch.cat(ring, 1), torch.cat(order, 1), is_closed & (now == first)[:, 0]
