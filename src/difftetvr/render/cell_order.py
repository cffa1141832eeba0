"""One front-to-back order of all cells of a mesh for a whole view, as the projected-tetrahedra renderer composites.

Of two cells that share a face, the one on the eye's side of its plane comes first. In a convex mesh these relations order
all cells that a ray from the eye meets, as it passes from each to the next through a face. Sorting by the power of the eye
with respect to the circumspheres satisfies all of them in a Delaunay mesh (Edelsbrunner, "An acyclicity theorem for cell
complexes in d dimensions", 1990; Max, Hanrahan & Crawfis, "Area and volume coherence for efficient visualization of 3D
scalar functions", 1990) - in exact arithmetic, and but for ties: the six cells of a grid's cube have one circumsphere,
and the power of a thin cell is mostly rounding. So the power only says where to start, and what the faces say is
enforced: a cell that is not behind all its predecessors is moved right behind the last of them, and so are, in turn,
cells behind it. Whether that ends is known afterwards. No tolerance decides, and the mesh need not be Delaunay.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.mesh.arrays import chunks, sort_keys
from difftetvr.mesh.delaunay_check import CellShape, is_convex
from difftetvr.mesh.tetmesh import TetMesh

_MAX_ROUNDS = 1000
"""Rounds of moving cells back after which relations are taken to be cyclic; more than 30 were never seen otherwise."""

_FAR_CENTER = 2.0
"""Circumcentres farther away than this, in units of the cell's longest edge, say more about rounding than about place."""

_SIGN_CERTAIN = 16.0 * 2.0**-52
"""Rounding of a face's distance from the eye, times the face's area, in units of edge length times distance squared."""

_FIRST = -(2**63)
_EXPONENT_AND_FRACTION = 2**63 - 1


@dataclass(frozen=True)
class CellOrder:
    """All cells of a mesh, front to back.

    Attributes:
        order: (T,) int64 cell indices.
        exact: Whether every ray from the eye is known to meet its cells in this order, up to rounding of the positions.
            False does not say that the order is wrong.
    """

    order: torch.Tensor
    exact: bool


def visibility_order(mesh: TetMesh, vertices: torch.Tensor) -> CellOrder:
    """Order the cells of a mesh front to back, for all rays from the eye at once.

    The order is exact for convex meshes unless cells overlap cyclically as seen from the eye, which in Delaunay meshes
    they never do. In other meshes it is right along every stretch of a ray that does not leave the mesh, and across gaps
    if the cells are part of a Delaunay mesh. Loose cells are sorted by the distance of their centroids.

    Args:
        mesh: The cells, and their positions in any frame.
        vertices: (V, 3) float32 or float64, the positions in camera space: the eye is the origin. Detached.

    Returns:
        The order, on the device of the vertices.
    """
    positions = _in_unit_range(vertices)
    if not mesh.is_conforming:
        return CellOrder(torch.argsort(_squared_distances(positions, mesh.tets)), exact=False)
    keys, predecessors = _keys_and_predecessors(positions, mesh)
    acyclic = _move_behind_predecessors(keys, predecessors, mesh.topology.cell_adjacency)
    return CellOrder(_argsort(keys[:-1]), acyclic and is_convex(mesh.vertices, mesh.topology))


def _in_unit_range(vertices: torch.Tensor) -> torch.Tensor:
    """Positions in float64 and in a unit in which no power of them over- or underflows."""
    positions = vertices.detach().double()
    _, exponent = torch.frexp(positions.abs().max())
    return positions * torch.exp2(-exponent.double().clamp(-1000, 1000))


def _squared_distances(positions: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    """(T,) squared distances of the cells' centroids from the eye, times 16."""
    parts = [positions[tets[part]].sum(1).square().sum(1) for part in chunks(tets.shape[0], tets.device, width=12)]
    return torch.cat(parts)


def _keys_and_predecessors(positions: torch.Tensor, mesh: TetMesh) -> tuple[torch.Tensor, torch.Tensor]:
    """What to sort cells by unless faces object, and the cells that have to come before each.

    Args:
        positions: (V, 3) float64 in camera space.
        mesh: The cells.

    Returns:
        keys: (T + 1,) int64; the last belongs to no cell, and is below all others.
        predecessors: (T, 4) int64, the cell across the face opposite local vertex k if it is nearer, else T.
    """
    count, tets, adjacency = mesh.num_cells, mesh.tets, mesh.topology.cell_adjacency
    keys = torch.full((count + 1,), _FIRST, dtype=torch.int64, device=tets.device)
    predecessors = torch.empty((count, 4), dtype=torch.int64, device=tets.device)
    for part in chunks(count, tets.device, width=12):
        cells = CellShape.of(positions, tets[part])
        keys[part] = _ordered_bits(_eye_powers(cells))
        neighbors = adjacency[part]
        predecessors[part] = torch.where(_eye_is_beyond(cells).t() & (neighbors >= 0), neighbors, count)
    return keys, predecessors


def _eye_powers(cells: CellShape) -> torch.Tensor:
    """(N,) power of the eye with respect to each circumsphere, |center|^2 - radius^2.

    Where the centre is far off, the sphere around the centroid with the mean square distance of the corners stands in.
    """
    squares = cells.squares()
    diameters = cells.diameters()
    powers = cells.origin.square().sum(0) + (cells.origin * diameters).sum(0)
    spread = cells.edges.sum(0) / 4.0
    radius_squared = squares.sum(0) / 4.0 - spread.square().sum(0)
    stand_in = (cells.origin + spread).square().sum(0) - radius_squared
    near = diameters.square().sum(0) <= (2.0 * _FAR_CENTER) ** 2 * squares.amax(0)
    return torch.where(near, powers, torch.fmin(powers, stand_in))


def _eye_is_beyond(cells: CellShape) -> torch.Tensor:
    """(4, N) whether the face opposite local vertex k has the eye on the outside for certain.

    Cells that rounding turned inside out do not know in from out and say False.
    """
    through_origin = (cells.normals * cells.origin).sum(1)
    opposite = -(through_origin.sum(0) + cells.determinants)
    distances = torch.cat((opposite[None], through_origin))
    longest = cells.squares().amax(0).sqrt()
    reach = torch.linalg.vector_norm(cells.origin, dim=0) + longest
    certain = distances > _SIGN_CERTAIN * longest * reach.square()
    return certain & (cells.determinants > 0)


def _ordered_bits(values: torch.Tensor) -> torch.Tensor:
    """Float64 values as int64 in the same order, the next number being the next value."""
    bits = values.view(torch.int64)
    return torch.where(bits < 0, bits ^ _EXPONENT_AND_FRACTION, bits)


def _move_behind_predecessors(keys: torch.Tensor, predecessors: torch.Tensor, adjacency: torch.Tensor) -> bool:
    """Raise keys, in place, by as little as makes each greater than those of all its predecessors.

    Returns:
        Whether that succeeded; it cannot where predecessors form a cycle.
    """
    count = predecessors.shape[0]
    parts = [torch.arange(p.start, p.stop, device=keys.device) for p in chunks(count, keys.device, width=4)]
    moved = torch.cat([_raise(keys, predecessors, cells) for cells in parts])
    for _ in range(_MAX_ROUNDS):
        if not moved.numel():
            return True
        behind = adjacency.index_select(0, moved)
        reached = (behind >= 0) & (behind != predecessors.index_select(0, moved))
        reached &= keys[behind] <= keys[moved][:, None]
        cells = torch.unique_consecutive(sort_keys(behind[reached].long()))
        moved = _raise(keys, predecessors, cells)
    return False


def _raise(keys: torch.Tensor, predecessors: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    """Put cells right behind the last of their predecessors if they are not behind it; returns those that moved."""
    before = keys[predecessors.index_select(0, cells)].amax(1)
    moving = before >= keys[cells]
    # Cells without predecessors have the lowest key of all before them, and stay.
    moved = cells[moving]
    keys[moved] = before[moving] + 1
    return moved


def _argsort(keys: torch.Tensor) -> torch.Tensor:
    return torch.argsort(keys)
