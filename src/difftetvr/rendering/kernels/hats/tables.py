"""Which edges and faces a cell has, by the places of its corners among each other (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.mesh import TetMesh
from difftetvr.mesh.arrays import constant
from difftetvr.mesh.topology.incidence import cell_edges, cell_faces
from difftetvr.mesh.topology.topology import LOCAL_EDGE_OF, LOCAL_EDGES, Topology
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.traversal.crossing import View


@dataclass
class HatTables:
    """Flat tables from a cell to its edges and faces, both in the order of its vertices' indices.

    Attributes:
        edges: (T, 6) indices into ``topology.edges``; pairs of ranks in the order of ``LOCAL_EDGES``.
        faces: (T, 4) indices into ``topology.faces``; entry r is the face opposite the r-th vertex.
    """

    edges: Any
    faces: Any

    @staticmethod
    def of(view: View, mesh: TetMesh, order: MemoryOrder) -> HatTables:
        """Upload the tables of a mesh in an order; built once for a topology."""
        edges, faces = order.topology.cached("render.hat_tables", lambda: _ranked_tables(mesh.topology, order))
        return HatTables(view.backend.uints(edges), view.backend.uints(faces))


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
    ranked = order.topology.tets.argsort(dim=1)
    edges, faces = (table.index_select(0, order.cells) for table in (cell_edges(topology), cell_faces(topology)))
    local = constant(LOCAL_EDGE_OF, ranked.device)
    columns = torch.stack([local[ranked[:, i], ranked[:, j]] for i, j in LOCAL_EDGES], 1)
    return torch.gather(edges, 1, columns).contiguous(), torch.gather(faces, 1, ranked).contiguous()
