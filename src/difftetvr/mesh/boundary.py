"""Where vertices on the boundary of a mesh may go without changing its shape."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.mesh import quality
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.shapes import length_scale
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import boundary_vertices, shell, stars
from difftetvr.mesh.topology.topology import Topology

_PAIRS_AT_ONCE = 2**16


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


def removable_vertices(mesh: TetMesh, slide: bool, tolerance: float = 1e-4) -> torch.Tensor:
    """Vertices of cells whose removal may leave the boundary as it is: inner ones, and those that could slide along it.

    Args:
        mesh: Any valid mesh.
        slide: Whether those on the boundary count.
        tolerance: See `BoundaryConstraint.sliding`.

    Returns:
        (V,) bool.
    """
    removable = ~boundary_vertices(mesh.topology)
    removable &= torch.diff(mesh.topology.vertex_cells[0]) > 0
    if slide:
        constraint = BoundaryConstraint.sliding(mesh, tolerance)
        removable[constraint.vertices] = constraint.tangents.flatten(1).any(1)
    return removable


def keeps_surface(
    mesh: TetMesh, half_edges: torch.Tensor, tolerance: float = 1e-4, constraint: BoundaryConstraint | None = None
) -> torch.Tensor:
    """Whether the boundary stays the same surface where one of its vertices v is merged into its neighbour u.

    It does if no cell gets inverted, which is not looked at here, and
    - v may slide towards u in the sense of `BoundaryConstraint.sliding`;
    - the boundary faces that v takes along sweep no volume, compared with the cells around v: where cells are thin, a
      direction in which v may slide can still lead through them;
    - the area of the boundary faces around v stays: it grows where one turns over, as only cells that are flat up to
      rounding allow, and changes where v is a corner of a slit without width.

    Args:
        mesh: Any valid mesh.
        half_edges: (N, 2) vertices [v, u] on the boundary that share an edge.
        tolerance: Largest sine of an angle between directions and planes that are taken for parallel, and the largest
            share of volumes and areas that is taken for rounding.
        constraint: `BoundaryConstraint.sliding(mesh, tolerance)`, where the caller has it already.

    Returns:
        (N,) bool.
    """
    constraint = constraint or BoundaryConstraint.sliding(mesh, tolerance)
    positions = mesh.vertices.detach().double() * length_scale(mesh.vertices)
    half_edges = half_edges.long().t().contiguous()
    removed, kept = half_edges
    local = torch.searchsorted(constraint.vertices, removed)
    direction = positions[kept] - positions[removed]
    off = direction - (constraint.tangents[local] @ direction[:, :, None])[:, :, 0]
    keeps = torch.linalg.vector_norm(off, dim=1) <= tolerance * torch.linalg.vector_norm(direction, dim=1)
    for rows in true_indices(keeps).split(_PAIRS_AT_ONCE):
        keeps[rows] = _keep_in_place(positions, mesh.topology, half_edges[:, rows], tolerance)
    return keeps


def _keep_in_place(
    positions: torch.Tensor, topology: Topology, half_edges: torch.Tensor, tolerance: float
) -> torch.Tensor:
    """(N,) bool: boundary faces around v keep their area and sweep no volume; half_edges is (2, N) here."""
    removed, kept = half_edges
    owner, rows = stars(shell(topology), removed)
    faces = topology.boundary_faces[rows].long()
    moved = torch.where(faces == removed[owner, None], kept[owner, None], faces)
    before, after = _area_vectors(positions[faces]), _area_vectors(positions[moved])
    swept = ((positions[kept] - positions[removed])[owner] * before).sum(1).abs() / 6.0
    lengths = [torch.linalg.vector_norm(vectors, dim=1) for vectors in (before, after)]
    sums = positions.new_zeros((removed.shape[0], 3))
    sums.index_add_(0, owner, torch.stack((*lengths, swept), 1))
    area, area_after, swept = sums.unbind(1)
    volume = _star_volumes(positions, topology, removed)
    return ((area_after - area).abs() <= tolerance * area) & (swept <= tolerance * volume)


def _star_volumes(positions: torch.Tensor, topology: Topology, vertices: torch.Tensor) -> torch.Tensor:
    """(N,) volume of the cells around vertices (N,), each of which may come several times."""
    different, place = torch.unique(vertices, return_inverse=True)
    owner, cells = stars(topology, different)
    volumes = quality.volumes(positions, topology.tets[cells])
    return volumes.new_zeros(different.shape[0]).index_add_(0, owner, volumes)[place]


def _area_vectors(triangles: torch.Tensor) -> torch.Tensor:
    """Normals of (N, 3, 3) triangles, (N, 3), as long as twice the area."""
    return torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _normal_squares(triangles: torch.Tensor) -> torch.Tensor:
    """Unit normals of (N, 3, 3) triangles times their transposes, (N, 3, 3); the identity where there is no normal."""
    edges = triangles[:, 1:] - triangles[:, :1]
    edges = edges / edges.abs().amax((1, 2), keepdim=True).clamp_min(torch.finfo(edges.dtype).tiny)
    normals = torch.linalg.cross(edges[:, 0], edges[:, 1])
    lengths = torch.linalg.vector_norm(normals, dim=1)
    units = normals / lengths[:, None]
    nothing_free = torch.eye(3, dtype=units.dtype, device=units.device)
    return torch.where((lengths > 0)[:, None, None], units[:, :, None] * units[:, None, :], nothing_free)
