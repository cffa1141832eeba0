"""Edges with few cells around them, and these cells in their order around the edge (Dr.Jit kernels)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import NONE, Backend, get_backend
from difftetvr.mesh.arrays import constant, true_indices
from difftetvr.mesh.topology.incidence import cell_edges, cells_per_edge
from difftetvr.mesh.topology.topology import LOCAL_EDGES, Topology
from difftetvr.recording import eager, few_lengths, replayed

_OTHER_CORNERS = ((2, 3), (3, 1), (1, 2), (0, 3), (2, 0), (0, 1))
"""For each of `LOCAL_EDGES` i, j the other corners x, y, such that x, y, i, j is an even permutation."""

_PATTERNS = tuple((*others, *edge) for others, edge in zip(_OTHER_CORNERS, LOCAL_EDGES, strict=True))


@dataclass(frozen=True)
class Rings:
    """Inner edges that have so many cells around them, and what lies around them.

    In each row the k-th and the next of `vertices` and the two of `edge` are the corners of the k-th of `cells`,
    positively oriented.

    Attributes:
        rows: (N,) int32, the edges as indices into `topology.edges`, ascending.
        edge: (N, 2) int32, their vertices, the smaller one first.
        vertices: (N, size) int32, the vertices around them.
        cells: (N, size) int32, the cells around them, from the one with the lowest number on.
    """

    rows: torch.Tensor
    edge: torch.Tensor
    vertices: torch.Tensor
    cells: torch.Tensor

    def part(self, which: slice) -> Rings:
        """Some of them."""
        return Rings(self.rows[which], self.edge[which], self.vertices[which], self.cells[which])


@eager
def closed_rings(topology: Topology, size: int) -> Rings:
    """The inner edges that have a given number of cells around them, and what lies around them.

    Args:
        topology: The cells.
        size: Number of cells around an edge, at least 3.

    Returns:
        All such edges, but for those at which the mesh merely touches itself.
    """
    rows = true_indices(cells_per_edge(topology) == size)
    if not rows.shape[0]:
        none = topology.tets.new_empty((0, size))
        return Rings(none[:, 0], none[:, :2], none, none)
    places = topology.cached("rings.first_places", lambda: _first_places(topology)).index_select(0, rows)
    patterns = constant(_PATTERNS, topology.tets.device).int()
    backend = get_backend(str(topology.tets.device))
    with backend.exclusive():
        tables = (backend.uints(table) for table in (places, patterns, topology.tets, topology.cell_adjacency))
        found = replayed(_walk, _Fans(backend, *tables), size)
        backend.run(found)
        is_closed, *columns = (backend.tensor(column) for column in found)
    closed = true_indices(is_closed > 0)
    halves = columns[:size], columns[size:]
    ring, cells = (torch.stack([column.index_select(0, closed) for column in half], 1) for half in halves)
    rows = rows.index_select(0, closed)
    return Rings(rows.int(), topology.edges.index_select(0, rows), ring, cells)


def _first_places(topology: Topology) -> torch.Tensor:
    """(E,) int32 the lowest place of each edge in the table of cells' edges."""
    count, table = topology.edges.shape[0], cell_edges(topology)
    backend = get_backend(str(table.device))
    with backend.exclusive():
        return backend.tensor(replayed(_lowest_places, backend, backend.uints(table), few_lengths(count)))[:count]


# ---- Kernels


@dataclass
class _Fans:
    """Edges and the cells around them, flat.

    Attributes:
        backend: Array types.
        places: (N,) a place of each edge in the table of cells' edges.
        patterns: (6, 4) corners of a cell by its edge: the others, and its ends.
        tets: (T, 4) vertices of cells.
        adjacency: (T, 4) neighbours of cells.
    """

    backend: Backend
    places: Any
    patterns: Any
    tets: Any
    adjacency: Any


def _lowest_places(backend: Backend, table: Any, length: int) -> Any:
    result = dr.full(backend.UInt, NONE, length)
    dr.scatter_reduce(dr.ReduceOp.Min, result, dr.arange(backend.UInt, dr.width(table)), table)
    result = backend.Int(result)
    dr.eval(result)
    return result


def _walk(fans: _Fans, size: int) -> list[Any]:
    """Go round edges from cell to cell: whether so many lead back to the first, the vertices, and the cells."""
    uint, edges = fans.backend.UInt, len(LOCAL_EDGES)
    cell = fans.places // edges
    pattern = dr.gather(fans.backend.UInt4, fans.patterns, fans.places - edges * cell)
    x, y, i, j = (dr.gather(uint, fans.tets, 4 * cell + pattern[k]) for k in range(4))
    is_ascending = i < j
    first, vertex = dr.select(is_ascending, x, y), dr.select(is_ascending, y, x)
    first_cell, behind = cell, first
    vertices, cells, is_closed = [first], [cell], dr.full(fans.backend.Bool, True, dr.width(fans.places))
    corners = dr.gather(fans.backend.UInt4, fans.tets, cell)
    for step in range(size):
        across = uint(0)
        for k in range(1, 4):
            across = dr.select(corners[k] == behind, k, across)
        cell = dr.gather(uint, fans.adjacency, 4 * cell + across, is_closed)
        is_closed &= cell != NONE
        corners = dr.gather(fans.backend.UInt4, fans.tets, cell, is_closed)
        behind, vertex = vertex, corners[0] + corners[1] + corners[2] + corners[3] - vertex - i - j
        if step < size - 1:
            vertices.append(behind)
            cells.append(cell)
            is_closed &= behind != first
    is_closed &= (cell == first_cell) & (behind == first)
    integer = fans.backend.Int
    result = [dr.select(is_closed, integer(1), integer(0)), *map(integer, vertices), *map(integer, cells)]
    dr.eval(result)
    return result
