"""Removal of cells, such as those that no ray needs."""

from __future__ import annotations

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.changes.change import MeshChange, with_vertices_kept
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.topology import Topology


def remove_cells(mesh: TetMesh, removed: torch.Tensor) -> MeshChange:
    """Take cells out of a mesh.

    What remains may be not convex, have holes and several parts, and touch itself in edges and vertices only: still a
    valid mesh, where faces of removed cells are boundary.

    Args:
        mesh: The mesh.
        removed: (T,) bool, the cells to remove; at least one must stay.

    Returns:
        The change. Cells and vertices that stay keep their order; vertices that no cell uses (any more) are dropped.

    Raises:
        MeshError: `removed` is no (T,) bool tensor, or no cell would remain.
    """
    if removed.dtype != torch.bool or removed.shape != (mesh.num_cells,):
        raise MeshError(
            f"The mask of cells to remove is {removed.dtype} of shape {tuple(removed.shape)}; "
            f"pass one bool for each of the {mesh.num_cells} cells."
        )
    cells = true_indices(~removed)
    if not cells.numel():
        raise MeshError("All cells would be removed; keep at least one.")
    compact, kept = cells_of(mesh, cells)
    return with_vertices_kept(mesh, kept, compact.topology, cells.int())


def cells_of(mesh: TetMesh, cells: torch.Tensor) -> tuple[TetMesh, torch.Tensor]:
    """Some cells of a mesh, loose ones if its are: what `remove_cells` leaves.

    Args:
        mesh: The mesh.
        cells: (N,) int64 cells, ascending.

    Returns:
        The mesh of these cells, and the vertices that they use, (V',) int64.
    """
    adjacency = None
    if mesh.is_conforming:
        # Neighbours stay neighbours. The last entry is where index -1, the outside, leads.
        new_cell = torch.full((mesh.num_cells + 1,), -1, dtype=torch.int32, device=cells.device)
        new_cell[cells] = torch.arange(cells.shape[0], dtype=torch.int32, device=cells.device)
        adjacency = new_cell[mesh.topology.cell_adjacency[cells].long()]
    topology = Topology(mesh.tets[cells], mesh.num_vertices, adjacency, is_conforming=mesh.is_conforming)
    return TetMesh.from_valid(mesh.vertices.detach(), topology, mesh.origin).without_unused_vertices()
