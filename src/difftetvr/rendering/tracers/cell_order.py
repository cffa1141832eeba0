"""One front-to-back order of all cells of a mesh for a whole view, as the projected-tetrahedra renderer composites.

Of two cells that share a face, the one on the eye's side of its plane comes first. In a convex mesh these relations
order all cells that a ray from the eye meets, as it passes from each to the next through a face. In a Delaunay mesh,
sorting by the power of the eye with respect to the circumspheres satisfies them all (Edelsbrunner, "An acyclicity
theorem for cell complexes in d dimensions", 1990; Max, Hanrahan & Crawfis, "Area and volume coherence for efficient
visualization of 3D scalar functions", 1990). That is so in exact arithmetic, and but for ties: the six cells of a
grid's cube have one circumsphere, and the power of a thin cell is mostly rounding. So the power only says where to
start, and what the faces say is enforced: a cell that is not behind all its predecessors is moved right behind the last
of them, and so are, in turn, cells behind it. Whether that ends is known afterwards. No tolerance decides, and the mesh
need not be Delaunay.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.mesh.arrays import chunks, put, sort_keys, true_indices
from difftetvr.mesh.making.delaunay_check import CellShape, dot, is_convex
from difftetvr.mesh.tetmesh import TetMesh

_MAX_ROUNDS = 200
"""Rounds of moving cells back one after another before all of them take turns: 20 are usual."""

_MAX_MOVES = 2
"""Moves per cell, on the average, before all of them take turns."""

_SURE = 0.05
"""How far, in units of its longest edge, rounding may move the centre of a cell's circumsphere for it to count."""

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
    they never do. In other meshes it is right along every stretch of a ray that does not leave the mesh, and across
    gaps if the cells are part of a Delaunay mesh. Loose cells are sorted by the distance of their centroids.

    Args:
        mesh: The cells, and their positions in any frame.
        vertices: (V, 3) float32 or float64, the positions in camera space: the eye is the origin. Detached.

    Returns:
        The order, on the device of the vertices.
    """
    positions = _in_unit_range(vertices)
    if not mesh.is_conforming:
        return CellOrder(torch.argsort(_squared_distances(positions, mesh.tets)), exact=False)
    keys, predecessors = _keys_and_predecessors(positions, mesh, torch.finfo(vertices.dtype).eps)
    acyclic = _move_behind_predecessors(keys, predecessors, mesh.topology.cell_adjacency)
    return CellOrder(torch.argsort(keys[:-1]), acyclic and is_convex(mesh.vertices, mesh.topology))


def _in_unit_range(vertices: torch.Tensor) -> torch.Tensor:
    """Positions in float64, scaled by a power of two to be at most 1, so that their products stay in range."""
    positions = vertices.detach().double()
    _, exponent = torch.frexp(positions.abs().max())
    return positions * torch.exp2(-exponent.double().clamp(-1000, 1000))


def _squared_distances(positions: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    """(T,) squared distances of the cells' centroids from the eye, times 16."""
    parts = []
    for part in chunks(tets.shape[0], tets.device, width=3):
        a, b, c, d = (positions.index_select(0, column) for column in tets[part].unbind(1))
        parts.append((a + b + c + d).square().sum(1))
    return torch.cat(parts)


def _keys_and_predecessors(
    positions: torch.Tensor, mesh: TetMesh, rounding: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """What to sort cells by unless faces object, and the cells that have to come before each.

    Args:
        positions: (V, 3) float64 in camera space, at most 1.
        mesh: The cells.
        rounding: By how much the positions may be off.

    Returns:
        keys: (T + 1,) int64; the last belongs to no cell, and is below all others.
        predecessors: (T, 4) int32, the cell across the face opposite local vertex k if it is nearer, else T.
    """
    count, tets, adjacency = mesh.num_cells, mesh.tets, mesh.topology.cell_adjacency
    keys = torch.full((count + 1,), _FIRST, dtype=torch.int64, device=tets.device)
    predecessors = torch.empty((count, 4), dtype=torch.int32, device=tets.device)
    for part in chunks(count, tets.device, width=4):
        cells = CellShape.of(positions, tets[part])
        keys[part] = _ordered_bits(_eye_powers(cells, rounding))
        neighbors = adjacency[part]
        predecessors[part] = torch.where(_eye_is_beyond(cells).t() & (neighbors >= 0), neighbors, count)
    return keys, predecessors


def _eye_powers(cells: CellShape, rounding: float) -> torch.Tensor:
    """(N,) power of the eye with respect to each circumsphere, |center|^2 - radius^2.

    Where rounding of the positions moves the centre too far, the sphere around the centroid with the mean square
    distance of the corners stands in, if the eye's power is smaller there: a cell too far in front is soon moved back,
    one too far behind moves many.
    """
    diameters = cells.diameters()
    powers = dot(cells.origin, cells.origin + diameters)
    spread = sum(cells.edges[1:], cells.edges[0]) / 4.0
    centroid = cells.origin + spread
    stand_in = dot(centroid, centroid) + dot(spread, spread) - cells.squares.sum(0) / 4.0
    longest = cells.squares.amax(0).sqrt()
    reach = dot(diameters, diameters).sqrt() + longest
    sure = rounding * reach * longest < _SURE * cells.determinants
    return torch.where(sure, powers, torch.fmin(powers, stand_in))


def _eye_is_beyond(cells: CellShape) -> torch.Tensor:
    """(4, N) whether the face opposite local vertex k has the eye on the outside for certain.

    Cells that rounding turned inside out do not know in from out and say False.
    """
    beside = [dot(normal, cells.origin) for normal in cells.normals]
    opposite = -sum(beside, cells.determinants)
    longest = cells.squares.amax(0).sqrt()
    reach = dot(cells.origin, cells.origin).sqrt() + longest
    certain = torch.stack((opposite, *beside)) > _SIGN_CERTAIN * longest * reach.square()
    return certain & (cells.determinants > 0)


def _ordered_bits(values: torch.Tensor) -> torch.Tensor:
    """Float64 values as int64 in the same order, the next number being the next value."""
    bits = values.view(torch.int64)
    return torch.where(bits < 0, bits ^ _EXPONENT_AND_FRACTION, bits)


def _move_behind_predecessors(keys: torch.Tensor, predecessors: torch.Tensor, adjacency: torch.Tensor) -> bool:
    """Raise keys, in place, by as little as makes each greater than those of all its predecessors.

    Cells that moved pass it on to those behind them. That is quick if few do; otherwise all cells take their turn.

    Returns:
        Whether that succeeded; it cannot where predecessors form a cycle.
    """
    count = predecessors.shape[0]
    parts = [torch.arange(p.start, p.stop, device=keys.device) for p in chunks(count, keys.device, width=4)]
    moved = torch.cat([_raise(keys, predecessors, cells) for cells in parts])
    moves = 0
    for _ in range(_MAX_ROUNDS):
        if not moved.numel():
            return True
        if moves > _MAX_MOVES * count:
            break
        behind, before = _behind(predecessors, adjacency, moved)
        late = true_indices(keys.index_select(0, behind) <= keys.index_select(0, before))
        cells = torch.unique_consecutive(sort_keys(behind.index_select(0, late)))
        moved = _raise(keys, predecessors, cells)
        moves += moved.numel()
    return _raise_in_turn(keys, predecessors, adjacency)


def _raise_in_turn(keys: torch.Tensor, predecessors: torch.Tensor, adjacency: torch.Tensor) -> bool:
    """Raise each key once, after those of all its predecessors.

    Returns:
        Whether all cells had their turn: those in and behind cycles have not.
    """
    count = predecessors.shape[0]
    waiting_for = torch.cat([(predecessors[p] < count).sum(1) for p in chunks(count, keys.device, width=4)])
    turn = true_indices(waiting_for == 0)
    done = 0
    while turn.numel():
        done += turn.numel()
        _raise(keys, predecessors, turn)
        behind, before = _behind(predecessors, adjacency, turn)
        # Where the eye is in the plane of a face, the neighbour waits for nothing.
        waiting = predecessors.index_select(0, behind) == before[:, None]
        behind = behind.index_select(0, true_indices(waiting.any(1)))
        waiting_for.index_add_(0, behind, torch.full_like(behind, -1))
        ready = behind.index_select(0, true_indices(waiting_for.index_select(0, behind) == 0))
        turn = torch.unique_consecutive(sort_keys(ready))
    return done == count


def _raise(keys: torch.Tensor, predecessors: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    """Put cells right behind the last of their predecessors if they are not behind it; returns those that moved."""
    before = keys.index_select(0, predecessors.index_select(0, cells).view(-1)).view(-1, 4).amax(1)
    # Without predecessors `before` is the lowest key there is, which no cell has.
    moving = true_indices(before >= keys.index_select(0, cells))
    moved = cells.index_select(0, moving)
    put(keys, moved, before.index_select(0, moving) + 1)
    return moved


def _behind(
    predecessors: torch.Tensor, adjacency: torch.Tensor, cells: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The neighbours of `cells` that are not their predecessors, (N,) int64, and of which cells, (N,) int64."""
    neighbors = adjacency.index_select(0, cells)
    places = true_indices(((neighbors >= 0) & (neighbors != predecessors.index_select(0, cells))).view(-1))
    return neighbors.view(-1).index_select(0, places).long(), cells.index_select(0, places >> 2)
