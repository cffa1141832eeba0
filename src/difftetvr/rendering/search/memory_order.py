"""The order in which renderers keep a mesh in memory: what is near in space is near in memory (PyTorch).

A ray walks through neighbours, and so do the rays beside it. Meshes come in any order, and changes of a mesh append
what is new; so renderers number vertices and cells along a curve through space, once for each topology, and nobody
else sees these numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import NONE, Backend
from difftetvr.mesh import TetMesh
from difftetvr.mesh.topology.topology import Topology
from difftetvr.recording import few_lengths
from difftetvr.rendering.search.hierarchy import curve_order
from difftetvr.rendering.search.scene import boundary_half_faces
from difftetvr.rendering.traversal.walk import walk_table


@dataclass(frozen=True)
class MemoryOrder:
    """A mesh in another order.

    Attributes:
        vertices: (V,) int32 the mesh's number of each vertex.
        cells: (T,) int32 the mesh's number of each cell.
        topology: The mesh in this order; vertices of a cell stay in theirs.
    """

    vertices: torch.Tensor
    cells: torch.Tensor
    topology: Topology

    @staticmethod
    def of(mesh: TetMesh) -> MemoryOrder:
        """The order of a mesh; that of its positions when it is first asked for."""
        return mesh.topology.cached("render.memory_order", lambda: _ordered(mesh))

    def mesh(self, mesh: TetMesh) -> TetMesh:
        """The mesh in this order, without a gradient."""
        vertices = mesh.vertices.detach().index_select(0, self.vertices)
        return TetMesh.from_valid(vertices, self.topology, mesh.origin)

    def in_order_of_mesh(self, rows: torch.Tensor) -> torch.Tensor:
        """(V, ...) records of vertices as the mesh counts these, from such as kernels count them."""
        return torch.empty_like(rows).index_copy_(0, self.vertices.long(), rows)

    def tables(self, backend: Backend) -> MeshTables:
        """What kernels read of the topology."""
        return self.topology.cached(f"render.tables.{backend.name}", lambda: MeshTables.of(backend, self))


@dataclass
class MeshTables:
    """Flat tables of a mesh in the order of memory; None for what loose cells do not have.

    Attributes:
        vertices: (V,) the mesh's number of each vertex.
        cells: (T,) the mesh's number of each cell.
        numbers: (T,) their numbers in this order.
        tets: (T, 4) vertices.
        adjacency: (T, 4) cells behind the half-faces.
        walk: See :func:`difftetvr.rendering.traversal.walk.walk_table`.
        boundary: (faces,) half-faces of the boundary, `NONE` behind them.
        faces: Length of ``boundary``, one of few.
    """

    vertices: Any
    cells: Any
    numbers: Any
    tets: Any
    adjacency: Any | None
    walk: Any | None
    boundary: Any | None
    faces: int

    @staticmethod
    def of(backend: Backend, order: MemoryOrder) -> MeshTables:
        """Upload a topology."""
        topology = order.topology
        vertices, cells, tets = (backend.uints(table) for table in (order.vertices, order.cells, topology.tets))
        numbers = dr.arange(backend.UInt, topology.num_cells)
        dr.make_opaque(numbers)
        if not topology.is_conforming:
            return MeshTables(vertices, cells, numbers, tets, None, None, None, 0)
        boundary = boundary_half_faces(topology)
        faces = few_lengths(boundary.shape[0])
        padded = torch.nn.functional.pad(boundary, (0, faces - boundary.shape[0]), value=NONE - (1 << 32))
        joined = (backend.uints(table) for table in (topology.cell_adjacency, walk_table(topology), padded))
        adjacency, walk, faces_of_boundary = joined
        return MeshTables(vertices, cells, numbers, tets, adjacency, walk, faces_of_boundary, faces)


def _ordered(mesh: TetMesh) -> MemoryOrder:
    positions, tets = mesh.vertices.detach(), mesh.tets
    vertices = curve_order(positions)
    centers = positions.index_select(0, tets[:, 0])
    for column in tets[:, 1:].unbind(1):
        centers += positions.index_select(0, column)
    cells = curve_order(centers)
    adjacency = None
    if mesh.is_conforming:
        behind = mesh.topology.cell_adjacency.index_select(0, cells)
        adjacency = torch.where(behind < 0, behind, _inverse(cells)[behind.long()])
    ordered = _inverse(vertices)[tets.index_select(0, cells).long()]
    topology = Topology(ordered, mesh.num_vertices, adjacency, is_conforming=mesh.is_conforming)
    return MemoryOrder(vertices.to(torch.int32), cells.to(torch.int32), topology)


def _inverse(order: torch.Tensor) -> torch.Tensor:
    """(N,) int32 place of each number in a permutation of them."""
    places = torch.empty(order.shape[0], dtype=torch.int32, device=order.device)
    places[order] = torch.arange(order.shape[0], dtype=torch.int32, device=order.device)
    return places
