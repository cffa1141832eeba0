"""Which edges and faces a cell has, by the places of its corners among each other (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.mesh.arrays import chunks, constant
from difftetvr.mesh.topology.incidence import cell_edges, cell_faces
from difftetvr.mesh.topology.topology import LOCAL_EDGE_OF, LOCAL_EDGES, Topology
from difftetvr.rendering.kernels.hats.space import HatSpace
from difftetvr.rendering.search.memory_order import MemoryOrder


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
    def of(space: HatSpace) -> HatTables:
        """Upload the tables of a mesh in its order; but for who is asked for, built once for a topology."""
        backend, order, topology = space.backend, space.order, space.mesh.topology
        tables = order.topology.cached("render.hat_tables", lambda: _ranked_tables(topology, order))
        both = space.edges, space.faces
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
