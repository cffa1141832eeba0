"""Delaunay insertion: new vertices anywhere in a mesh, and all cells anew."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.changes.change import MeshChange, check_rows
from difftetvr.mesh.locate import TOLERANCE, locate, search
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.validation import as_vertices


@dataclass(frozen=True)
class DelaunayInsertion(MeshChange):
    """A change whose new vertices lie inside old cells and not on old edges.

    `parents` and `weight` name the two old corners that weigh most in a new vertex and their shares of each other; the
    position is the mean of four, and `carry` takes that.

    Attributes:
        corners: (N, 4) int32, corners of the old cell around each new vertex, in the order of the new vertices.
        corner_weights: (N, 4) float64, their weights: not negative, of sum one.
    """

    corners: torch.Tensor
    corner_weights: torch.Tensor

    def carry(self, values: torch.Tensor) -> torch.Tensor:
        """Take values at the old vertices to the new ones, linearly inside the old cells: exact for linear fields.

        Args:
            values: (V, ...) floating point, on the mesh's device; differentiable.

        Returns:
            (V', ...) of the same dtype; values of kept vertices to the bit.

        Raises:
            MeshError: The number of rows is not the old number of vertices.
        """
        check_rows(values, self.num_old_vertices, "vertices")
        carried = values.index_select(0, self.parents[:, 0])
        weights = self.corner_weights.to(values.dtype).view(-1, 4, *[1] * (values.ndim - 1))
        return carried.index_copy(0, true_indices(self.is_new), (values[self.corners.long()] * weights).sum(1))


def insert_delaunay(mesh: TetMesh, points: Any) -> DelaunayInsertion:
    """Add points to the vertices and make the Delaunay mesh of them all.

    The mesh's own cells are given up: the result fills the convex hull of the vertices (see `TetMesh.delaunay`), so
    holes and hollows of a mesh that is not convex are filled. The time is Qhull's, some 20 s for a million cells.

    Args:
        mesh: The mesh before; values are interpolated in it.
        points: (P, 3) positions inside the mesh, array-like. A point where a vertex or an earlier point is already is
            left out.

    Returns:
        The change. Kept vertices come first, in their order, then the new ones; vertices that no cell uses are dropped.
        cell_parents, in no order, is the old cell that holds the new cell's centroid, or one near it where none does.

    Raises:
        MeshError: Points of another shape, not finite or outside the mesh, or no valid mesh was found.
    """
    new = as_vertices(points).detach().to(mesh.vertices)
    if not torch.isfinite(new).all():
        first = int(true_indices(~torch.isfinite(new).all(1))[0])
        raise MeshError(f"Point {first} is at {new[first].tolist()}; pass finite positions.")
    corners, weights = _interpolation(mesh, new)
    complete = TetMesh.delaunay(torch.cat((mesh.vertices.detach(), new)))
    changed, kept = complete.without_unused_vertices()

    is_old = kept < mesh.num_vertices
    inserted = kept[~is_old] - mesh.num_vertices
    corners, weights = corners[inserted], weights[inserted]
    heaviest = weights.topk(2, dim=1)
    pairs = corners.gather(1, heaviest.indices)
    shares = heaviest.values[:, 1] / heaviest.values.sum(1)
    old = kept[is_old].int()
    parents = torch.cat((old[:, None].expand(-1, 2), pairs))
    weight = torch.cat((torch.zeros(old.shape[0], device=old.device), shares.float()))
    centroids = changed.vertices.double()[changed.tets.long()].mean(1)
    cell_parents, _, _ = locate(mesh, centroids)
    return DelaunayInsertion(
        changed, parents, weight, cell_parents.int(), mesh.num_vertices, mesh.num_cells, corners, weights
    )


def _interpolation(mesh: TetMesh, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Corners (P, 4) int32 of the cells that hold points, and their weights (P, 4) float64."""
    cells, weights, found = locate(mesh, points)
    for i in true_indices(~found).tolist():
        cells[i], weights[i] = search(mesh, points[i])
        if not weights[i].min() >= -TOLERANCE:
            position = ", ".join(f"{x:g}" for x in points[i].tolist())
            raise MeshError(f"Point {i} at ({position}) lies outside the mesh; pass points inside it.")
    # A point on a face may be outside by a rounding: densities must not become negative by that.
    weights = weights.clamp_min(0.0)
    return mesh.tets[cells], weights / weights.sum(1, keepdim=True)
