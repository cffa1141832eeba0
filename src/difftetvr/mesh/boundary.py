"""Where vertices on the boundary of a mesh may go without changing its shape."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.incidence import boundary_vertices
from difftetvr.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class BoundaryConstraint:
    """Keeps the vertices on the boundary where they are, or on the planes and creases they slide along.

    Attributes:
        vertices: (B,) int64, the vertices on the boundary, ascending.
        tangents: (B, 3, 3) float64, projections onto the directions in which each of them may move; 0 where none.
        anchors: (B, 3) float64, points of the planes and creases: moves lead back to them what rounding takes off.
    """

    vertices: torch.Tensor
    tangents: torch.Tensor
    anchors: torch.Tensor

    @staticmethod
    def fixed(mesh: TetMesh) -> BoundaryConstraint:
        """No vertex on the boundary moves.

        Args:
            mesh: Any valid mesh.
        """
        vertices = true_indices(boundary_vertices(mesh.topology))
        anchors = mesh.vertices.detach()[vertices].double()
        return BoundaryConstraint(vertices, anchors.new_zeros((len(vertices), 3, 3)), anchors)

    @staticmethod
    def sliding(mesh: TetMesh, tolerance: float = 1e-4) -> BoundaryConstraint:
        """Vertices slide in the plane of their boundary faces, on a crease of two planes along it; corners stay.

        A direction is free if it lies in all boundary faces of the vertex, which then stay in their planes: the mesh
        fills the same space afterwards.

        Args:
            mesh: Any valid mesh.
            tolerance: Largest sine of the angle between a face and a direction that still counts as lying in it, over
                all faces of a vertex taken together (root of the sum of squares).
        """
        still = BoundaryConstraint.fixed(mesh)
        faces = mesh.topology.boundary_faces.long()
        normal_squares = _normal_squares(mesh.vertices.detach().double()[faces])
        local = torch.searchsorted(still.vertices, faces)
        sums = torch.zeros_like(still.tangents)
        for column in local.unbind(1):
            sums.index_add_(0, column, normal_squares)
        squared_sines, directions = torch.linalg.eigh(sums)
        free = torch.where((squared_sines <= tolerance**2)[:, None, :], directions, 0.0)
        return BoundaryConstraint(still.vertices, free @ free.mT, still.anchors)

    def apply(self, positions: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
        """The part of a move that keeps to the boundary.

        Args:
            positions: (V, 3) before the move.
            move: (V, 3) float64 proposed moves in units of length.

        Returns:
            (V, 3) float64 moves, those of inner vertices as they were.
        """
        on_boundary = move[self.vertices]
        off_anchor = self.anchors - positions[self.vertices].double()
        # The part of `off_anchor` that is not tangential is what rounding has moved the vertex off its plane.
        kept = (self.tangents @ (on_boundary - off_anchor)[:, :, None])[:, :, 0] + off_anchor
        return move.index_copy(0, self.vertices, kept)


def _normal_squares(triangles: torch.Tensor) -> torch.Tensor:
    """Unit normals of (N, 3, 3) triangles times their transposes, (N, 3, 3); the identity where there is no normal."""
    edges = triangles[:, 1:] - triangles[:, :1]
    edges = edges / edges.abs().amax((1, 2), keepdim=True).clamp_min(torch.finfo(edges.dtype).tiny)
    normals = torch.linalg.cross(edges[:, 0], edges[:, 1])
    lengths = torch.linalg.vector_norm(normals, dim=1)
    units = normals / lengths[:, None]
    nothing_free = torch.eye(3, dtype=units.dtype, device=units.device)
    return torch.where((lengths > 0)[:, None, None], units[:, :, None] * units[:, None, :], nothing_free)
