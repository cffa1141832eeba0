"""Which edges and faces a cell has, by the places of its corners among each other (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import torch

from difftetvr.mesh import TetMesh
from difftetvr.mesh.arrays import chunks, constant, true_indices
from difftetvr.mesh.topology.incidence import cell_edges, cell_faces
from difftetvr.mesh.topology.topology import LOCAL_EDGE_OF, LOCAL_EDGES, Topology
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.traversal.crossing import View

_SPARE = 16
"""Records that take what is added for hats which nobody asks for: threads of a CPU would guess wrong half of the time
whether they have to add, and additions to one record would wait for each other."""


@dataclass(frozen=True)
class Chosen:
    """The edges or faces that have records.

    Attributes:
        mask: (N,) bool, those that are asked for; None: all.
        count: Number N of all.
    """

    mask: torch.Tensor | None
    count: int

    @cached_property
    def rows(self) -> torch.Tensor:
        """(M,) int64 which of all have records, in the order of these."""
        assert self.mask is not None
        return true_indices(self.mask)

    @property
    def asked(self) -> int:
        """Number M of those that are asked for."""
        return self.count if self.mask is None else self.rows.shape[0]

    @property
    def records(self) -> int:
        """Number of their records, with those that are spare."""
        return self.count if self.mask is None else self.asked + _SPARE

    def numbered(self, table: torch.Tensor) -> torch.Tensor:
        """A table of indices with numbers of records instead."""
        if self.mask is None:
            return table
        spare = torch.arange(self.count, dtype=torch.int32, device=table.device).remainder_(_SPARE).add_(self.asked)
        places = self.mask.cumsum(0, dtype=torch.int32).sub_(1)
        numbers = torch.where(self.mask, places, spare)
        return numbers.index_select(0, table.view(-1)).view_as(table)

    def values(self, values: torch.Tensor) -> torch.Tensor:
        """(N, ...) values of all, as those of the records; 0 for spare ones."""
        if self.mask is None:
            return values
        chosen = values.index_select(0, self.rows)
        return torch.cat((chosen, chosen.new_zeros(_SPARE, *chosen.shape[1:])))

    def spread(self, records: torch.Tensor) -> torch.Tensor:
        """(N, width) what is known of all, from their records; 0 where nothing is."""
        if self.mask is None:
            return records[: self.count]
        known = records.new_zeros(self.count, records.shape[1])
        return known.index_copy_(0, self.rows, records[: self.asked])


@dataclass
class HatTables:
    """Flat tables from a cell to the records of its edges and faces, both in the order of its vertices' indices.

    Attributes:
        edges: (T, 6) records of edges; pairs of ranks in the order of ``LOCAL_EDGES``.
        faces: (T, 4) records of faces; entry r is the face opposite the r-th vertex.
        asked_edges: Number of records that are not spare, in a device value; None where additions need not know.
        asked_faces: The same of faces.
    """

    edges: Any
    faces: Any
    asked_edges: Any | None
    asked_faces: Any | None

    @staticmethod
    def of(view: View, mesh: TetMesh, order: MemoryOrder, edges: Chosen, faces: Chosen) -> HatTables:
        """Upload the tables of a mesh in an order; but for who is asked for, built once for a topology."""
        backend = view.backend
        tables = order.topology.cached("render.hat_tables", lambda: _ranked_tables(mesh.topology, order))
        both = edges, faces
        arrays = (backend.uints(chosen.numbered(table)) for chosen, table in zip(both, tables, strict=True))
        # Atomic additions of a GPU to a few records wait for each other; threads that add nothing cost it nothing.
        waits = backend.name != "llvm"
        limits = (backend.opaque_uint(chosen.asked) if waits and chosen.mask is not None else None for chosen in both)
        return HatTables(*arrays, *limits)


@dataclass
class RankedCell:
    """A cell, and the places of its corners among each other by the indices of their vertices."""

    tables: HatTables
    cell: Any
    ranks: list[Any]

    def edge(self, one: int, other: int, active: Any = True) -> Any:
        """Index of the edge that joins two corners."""
        first, second = self.ranks[one], self.ranks[other]
        low, high = dr.select(first < second, first, second), dr.select(first < second, second, first)
        row = 6 * self.cell + ((low * (7 - low)) >> 1) + (high - low - 1)  # in the order of LOCAL_EDGES
        return dr.gather(type(self.cell), self.tables.edges, row, active)

    def face(self, opposite: int) -> Any:
        """Index of the face opposite a corner."""
        return dr.gather(type(self.cell), self.tables.faces, 4 * self.cell + self.ranks[opposite])


def ranks_of(vertices: list[Any]) -> list[Any]:
    """Place of each of a cell's vertices among all four by index."""
    uint = type(vertices[0])
    ranks = []
    for vertex in vertices:
        rank = uint(0)
        for other in vertices:
            rank += dr.select(other < vertex, uint(1), uint(0))
        ranks.append(rank)
    return ranks


def _ranked_tables(topology: Topology, order: MemoryOrder) -> tuple[torch.Tensor, torch.Tensor]:
    # Vertices of a cell are ranked by their numbers in memory; their places in the cell are the mesh's.
    numbers = order.topology.tets
    cells, device = numbers.shape[0], numbers.device
    edges, faces = (torch.empty((cells, width), dtype=torch.int32, device=device) for width in (6, 4))
    edges_of, faces_of, local = cell_edges(topology), cell_faces(topology), constant(LOCAL_EDGE_OF, device)
    for part in chunks(cells, device, width=6):
        ranked = _ranked(numbers[part])
        columns = torch.stack([local[ranked[i], ranked[j]] for i, j in LOCAL_EDGES], 1)
        rows = order.cells[part]
        torch.gather(edges_of.index_select(0, rows), 1, columns, out=edges[part])
        torch.gather(faces_of.index_select(0, rows), 1, torch.stack(ranked, 1), out=faces[part])
    return edges, faces


def _ranked(corners: torch.Tensor) -> list[torch.Tensor]:
    """Places in (N, 4) cells of their smallest corners, of the next ones, and so on; (N,) each."""
    keys = [(corner.long() << 2) + place for place, corner in enumerate(corners.unbind(1))]
    for i, j in ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2)):
        keys[i], keys[j] = torch.minimum(keys[i], keys[j]), torch.maximum(keys[i], keys[j])
    return [key & 3 for key in keys]
