"""Which cell of a mesh holds a point: a walk from cell to cell, for all points at once."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from difftetvr.mesh.arrays import chunks, true_indices
from difftetvr.mesh.tetmesh import TetMesh

TOLERANCE = 1e-6
"""Barycentric weights down to minus this count as inside: points on a face, rounded to float32."""

_MAX_STEPS = 1000
_MIXER = 0x9E3779B1


def locate(mesh: TetMesh, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Find the cells that hold points.

    Each point starts in a cell of its nearest vertex and goes through faces that it lies beyond. In a mesh that is not
    convex, that may end at the boundary although some other cell holds the point (see `search`).

    Args:
        mesh: The mesh.
        points: (P, 3) positions on the mesh's device.

    Returns:
        cells (P,) int64: a cell that holds the point, or a cell near it on the boundary of the mesh where none does.
        weights (P, 4) float64: barycentric coordinates in that cell; some are negative for points outside.
        found (P,) bool: the point lies in the cell.
    """
    positions = mesh.vertices.detach().double()
    points = points.detach().double()
    cells = _start_cells(mesh, positions, points)
    weights = torch.zeros((points.shape[0], 4), dtype=torch.float64, device=points.device)
    found = torch.zeros(points.shape[0], dtype=torch.bool, device=points.device)
    active = torch.arange(points.shape[0], device=points.device)
    for step in range(_MAX_STEPS):
        if not active.numel():
            break
        here = cells[active]
        weights[active] = _barycentric(positions, mesh.tets[here], points[active])
        inside = weights[active].amin(1) >= -TOLERANCE
        found[active[inside]] = True
        active, here = active[~inside], here[~inside]
        ahead = mesh.topology.cell_adjacency[here].long()
        leaves = (weights[active] < 0) & (ahead >= 0)
        # A fixed preference could go round in circles for ever; one that changes from step to step cannot.
        shuffled = ((active[:, None] * 4 + torch.arange(4, device=active.device) + 7919 * step) * _MIXER) & 0xFFFF
        choice = torch.where(leaves, shuffled, -1).argmax(1)
        moves = leaves.any(1)
        active, choice = active[moves], choice[moves]
        cells[active] = ahead[moves].gather(1, choice[:, None])[:, 0]
    _cross_one_face_more(mesh, points, cells, weights, found)
    return cells, weights, found


def _cross_one_face_more(
    mesh: TetMesh, points: torch.Tensor, cells: torch.Tensor, weights: torch.Tensor, found: torch.Tensor
) -> None:
    """Give points that the tolerance alone left in their cells to the cell beyond the face, where they lie deeper."""
    beside = true_indices(found & (weights.amin(1) < 0))
    ahead = mesh.topology.cell_adjacency[cells[beside]].gather(1, weights[beside].argmin(1, keepdim=True))[:, 0].long()
    beside, ahead = beside[ahead >= 0], ahead[ahead >= 0]
    others = _barycentric(mesh.vertices.detach().double(), mesh.tets[ahead], points[beside])
    is_deeper = others.amin(1) > weights[beside].amin(1)
    cells[beside[is_deeper]], weights[beside[is_deeper]] = ahead[is_deeper], others[is_deeper]


def search(mesh: TetMesh, point: torch.Tensor) -> tuple[int, torch.Tensor]:
    """Find the cell that holds a point by looking at every cell: slow, for the few that a walk did not find.

    Args:
        mesh: The mesh.
        point: (3,) position on the mesh's device.

    Returns:
        The cell in which the point's smallest barycentric coordinate is largest, and these coordinates, (4,) float64.
    """
    positions = mesh.vertices.detach().double()
    best, cell, weights = -torch.inf, 0, positions.new_zeros(4)
    for part in chunks(mesh.num_cells, point.device, width=12):
        tets = mesh.tets[part]
        candidates = _barycentric(positions, tets, point.detach().double().expand(tets.shape[0], 3))
        smallest, index = candidates.amin(1).max(0)
        if float(smallest) > best:
            best, cell, weights = float(smallest), part.start + int(index), candidates[index]
    return cell, weights


def _start_cells(mesh: TetMesh, positions: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    used = torch.unique(mesh.tets).long()
    offsets, cells = mesh.topology.vertex_cells
    _, nearest = cKDTree(positions[used].cpu().numpy()).query(points.cpu().numpy())
    vertices = used[torch.from_numpy(np.atleast_1d(nearest)).to(used.device)]
    return cells[offsets[vertices].long()].long()


def _barycentric(positions: torch.Tensor, tets: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """(N, 4) barycentric coordinates of one point for each cell, as volumes over their sum."""
    a, b, c, d = (positions.index_select(0, tets[:, k]) - points for k in range(4))
    ab, cd = torch.linalg.cross(a, b), torch.linalg.cross(c, d)
    volumes = torch.stack(((b * cd).sum(1), -(a * cd).sum(1), (d * ab).sum(1), -(c * ab).sum(1)), 1)
    return volumes / volumes.sum(1, keepdim=True)
