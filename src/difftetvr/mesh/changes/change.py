"""What every change of a mesh's cells returns: the new mesh, and how to carry data over to it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.limits import MAX_CELLS
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.topology import Topology


@dataclass(frozen=True)
class MeshChange:
    """A mesh with other cells than before, and where its vertices and cells come from.

    Everything is detached from autograd's graph, and on the device of the mesh. Several changes in a row carry data one
    after the other.

    Attributes:
        mesh: The new mesh; valid by construction.
        parents: (V', 2) int32. New vertex i lies between the old vertices parents[i]; a vertex that was kept has its
            old index in both.
        weight: (V',) float32 in [0, 1]: position of new vertex i = (1 - weight) * first parent + weight * second
            parent; 0 for vertices that were kept.
        cell_parents: (T',) int32, the old cell from which each new cell inherits data.
        num_old_vertices: Number of vertices V before the change.
        num_old_cells: Number of cells T before the change.
    """

    mesh: TetMesh
    parents: torch.Tensor
    weight: torch.Tensor
    cell_parents: torch.Tensor
    num_old_vertices: int
    num_old_cells: int

    @property
    def is_new(self) -> torch.Tensor:
        """(V',) bool: vertices that the change made."""
        return self.parents[:, 0] != self.parents[:, 1]

    def carry(self, values: torch.Tensor) -> torch.Tensor:
        """Take values at the old vertices to the new ones, linearly along edges: exact for linear fields.

        Args:
            values: (V, ...) floating point, on the mesh's device; differentiable.

        Returns:
            (V', ...) of the same dtype; values of kept vertices to the bit.

        Raises:
            MeshError: The number of rows is not the old number of vertices.
        """
        check_rows(values, self.num_old_vertices, "vertices")
        first, second = self.parents.unbind(1)
        carried = values.index_select(0, first)
        new = true_indices(self.is_new)
        if not new.numel():
            return carried
        weight = self.weight[new].to(values.dtype).view(-1, *[1] * (values.ndim - 1))
        return carried.index_copy(0, new, torch.lerp(carried[new], values.index_select(0, second[new]), weight))

    def carry_cells(self, values: torch.Tensor) -> torch.Tensor:
        """Take values of the old cells to the new ones.

        Args:
            values: (T, ...) of any dtype, on the mesh's device; differentiable.

        Returns:
            (T', ...): each new cell has its parent's value.

        Raises:
            MeshError: The number of rows is not the old number of cells.
        """
        check_rows(values, self.num_old_cells, "cells")
        return values.index_select(0, self.cell_parents)


def with_midpoints(mesh: TetMesh, ends: torch.Tensor, tets: torch.Tensor, cell_parents: torch.Tensor) -> MeshChange:
    """The change that adds a vertex in the middle of edges, after all vertices there are.

    Args:
        mesh: The mesh before.
        ends: (N, 2) int32 ends of the edges; the k-th midpoint becomes vertex V + k.
        tets: (T', 4) int32 positive cells on old and new vertices.
        cell_parents: (T',) int32.

    Returns:
        The change.

    Raises:
        MeshError: There would be too many cells.
    """
    kept = torch.arange(mesh.num_vertices, dtype=torch.int32, device=tets.device)
    parents = torch.cat((kept[:, None].expand(-1, 2), ends))
    weight = torch.zeros(parents.shape[0], device=tets.device)
    weight[mesh.num_vertices :] = 0.5
    positions = mesh.vertices.detach()
    midpoints = torch.lerp(positions.index_select(0, ends[:, 0]), positions.index_select(0, ends[:, 1]), 0.5)
    changed = mesh_of(torch.cat((positions, midpoints)), tets, mesh)
    return MeshChange(changed, parents, weight, cell_parents, mesh.num_vertices, mesh.num_cells)


def with_vertices_kept(mesh: TetMesh, kept: torch.Tensor, topology: Topology, cell_parents: torch.Tensor) -> MeshChange:
    """The change that adds no vertices.

    Args:
        mesh: The mesh before.
        kept: (V',) int64 old indices of the vertices that stay, ascending.
        topology: Topology of the new cells, on the vertices that stay.
        cell_parents: (T',) int32.

    Returns:
        The change.
    """
    parents = kept.int()[:, None].expand(-1, 2).contiguous()
    weight = torch.zeros(kept.shape[0], device=kept.device)
    changed = TetMesh.from_valid(mesh.vertices.detach()[kept], topology, mesh.origin)
    return MeshChange(changed, parents, weight, cell_parents, mesh.num_vertices, mesh.num_cells)


def mesh_of(vertices: torch.Tensor, tets: torch.Tensor, mesh: TetMesh) -> TetMesh:
    """Wrap cells that are valid by construction.

    Args:
        vertices: (V, 3) positions.
        tets: (T, 4) int32.
        mesh: What they were made of: they meet face to face, or not, and are counted from where its cells are.

    Returns:
        The mesh.

    Raises:
        MeshError: There are more cells than a mesh can have.
    """
    if tets.shape[0] > MAX_CELLS:
        raise MeshError(f"The refined mesh would have {tets.shape[0]} cells, more than {MAX_CELLS}; refine less of it.")
    topology = Topology(tets, vertices.shape[0], is_conforming=mesh.is_conforming)
    return TetMesh.from_valid(vertices, topology, mesh.origin)


def check_indices(indices: torch.Tensor, count: int, what: str) -> torch.Tensor:
    """Indices that a caller passed, as int64 on their device.

    Args:
        indices: Integers of any shape.
        count: Indices must be in [0, count).
        what: What they count, for the message: "vertex", "edge".

    Returns:
        The same values as int64.

    Raises:
        MeshError: They are no integers, or one is out of range.
    """
    if indices.is_floating_point() or indices.is_complex() or indices.dtype == torch.bool:
        raise MeshError(f"The {what} indices are {indices.dtype}; pass integers.")
    outside = (indices < 0) | (indices >= count)
    if outside.any():
        first = int(indices[outside][0])
        raise MeshError(f"The {what} index {first} is out of range; pass indices from 0 to {count - 1}.")
    return indices.long()


def check_rows(values: torch.Tensor, count: int, what: str) -> None:
    """Refuse data that is not that of the old mesh.

    Args:
        values: What shall be carried.
        count: The rows it must have.
        what: What has one row each, for the message: "vertices", "cells".

    Raises:
        MeshError: The number of rows is another.
    """
    if values.ndim == 0 or values.shape[0] != count:
        raise MeshError(f"The values have shape {tuple(values.shape)}; pass a row for each of the {count} old {what}.")
