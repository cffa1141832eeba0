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
from typing import Any

import torch

from difftetvr.backend import Backend
from difftetvr.mesh.arrays import chunks, put, sort_keys, true_indices
from difftetvr.mesh.making.delaunay_check import boundary_creases
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.topology import Topology
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.search.plan import Counts, Found, Told
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.tracers.cell_keys import (
    BEHIND,
    DENTED,
    UNSETTLED,
    CellKeys,
    CellsToSort,
    Creases,
    dented,
    keys_of,
    told_flags,
)
from difftetvr.rendering.tracers.tiles import CellTiles, tiles_of

_MAX_ROUNDS = 200
"""Rounds of moving cells back one after another before all of them take turns."""

_MAX_MOVES = 2
"""Moves per cell, on the average, before all of them take turns."""

_FIRST = -(2**63)


@dataclass
class OrderPlan:
    """Plans to sort the cells of a view; see :class:`difftetvr.rendering.search.plan.SearchPlan`.

    In a convex mesh the order is exact unless cells overlap cyclically as seen from the eye, which in Delaunay meshes
    they never do. In other meshes it is right along every stretch of a ray that does not leave the mesh, and across
    gaps if the cells are part of a Delaunay mesh. Loose cells are sorted by the distance of their centroids.

    Attributes:
        cells: The cells.
        creases: Of the boundary; None where it is known not to be that of a convex body.
        capacity, sees_all: Nothing is looked for along rays.
    """

    cells: CellsToSort
    creases: Creases | None
    capacity: int = 0
    sees_all: Any | None = None

    @staticmethod
    def of(backend: Backend, mesh: TetMesh) -> OrderPlan:
        """Plan for a mesh."""
        tables, creases = MemoryOrder.of(mesh).tables(backend), None
        if mesh.is_conforming and boundary_creases(mesh.topology) is not None:
            edges, numbers = mesh.topology.cached(
                f"render.creases.{backend.name}", lambda: _uploaded_creases(backend, mesh.topology)
            )
            exact, single = (torch.finfo(dtype).eps for dtype in (mesh.vertices.dtype, torch.float32))
            positions = backend.at(mesh.vertices.dtype).floats(mesh.vertices)
            creases = Creases(backend, edges, numbers, positions, exact, single)
        return OrderPlan(CellsToSort(tables.numbers, tables.adjacency, torch.finfo(backend.dtype).eps), creases)

    def find(self, scene: Scene, extent: Any) -> Found:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.find`."""
        found = keys_of(scene, self.cells, extent)
        tiles = tiles_of(scene, self.cells.cell)
        dents = None if self.creases is None else dented(self.creases)
        flags = told_flags(scene.backend, found.unsettled, dents, extent)
        return Found(Counts.of(scene.backend.UInt(tiles.pairs), None), None, [], (found, tiles), flags)

    def settled(self, scene: Scene, found: Found, told: Told) -> KeyedCells:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.settled`."""
        assert found.sorting is not None
        keys, tiles = found.sorting
        return KeyedCells(keys, tiles, told, self.creases is not None)


@dataclass(frozen=True)
class KeyedCells:
    """The cells of a view, still to be sorted.

    Attributes:
        keys: What they are sorted by.
        tiles: Where in the image they may be seen.
        told: What the host has heard of both.
        is_closed: Whether their boundary is one closed surface.
    """

    keys: CellKeys
    tiles: CellTiles
    told: Told
    is_closed: bool

    @property
    def starts_inside(self) -> bool:
        """Whether some crossings may begin behind the camera."""
        return bool(self.told.flags & BEHIND)

    def sorted(self, backend: Backend, topology: Topology) -> CellOrder:
        """Sort them, after more moves of cells if those in kernels were not enough."""
        keys, is_right = backend.tensor(self.keys.keys), topology.is_conforming
        if self.told.flags & UNSETTLED:
            columns = [backend.tensor(backend.Int(part)) for part in self.keys.predecessors]
            predecessors = torch.stack(columns, dim=1)
            predecessors[predecessors < 0] = len(keys)
            keys = torch.cat((keys, keys.new_full((1,), _FIRST)))
            is_right = _move_behind_predecessors(keys, predecessors, topology.cell_adjacency)
            keys = keys[:-1]
        exact = is_right and self.is_closed and not self.told.flags & DENTED
        return CellOrder(torch.argsort(keys), exact)


@dataclass(frozen=True)
class CellOrder:
    """All cells of a mesh, front to back.

    Attributes:
        order: (T,) int64 cells, as kernels number them.
        exact: Whether every ray from the eye is known to meet its cells in this order, up to rounding of the positions.
            False does not say that the order is wrong.
    """

    order: torch.Tensor
    exact: bool


def _uploaded_creases(backend: Backend, topology: Topology) -> tuple[Any, Any]:
    """Flat (E, 4) edges of the boundary with the far corners of the faces beside them, and (E,) their numbers."""
    creases = boundary_creases(topology)
    assert creases is not None
    return backend.uints(creases.to(torch.int32)), backend.lanes(len(creases))


def _move_behind_predecessors(keys: torch.Tensor, predecessors: torch.Tensor, adjacency: torch.Tensor) -> bool:
    """Raise keys, in place, by as little as makes each greater than those of all its predecessors.

    Args:
        keys: (T + 1,) int64; the last belongs to no cell, and is below all others.
        predecessors: (T, 4) int32, the cell across the face opposite local vertex k if it is nearer, else T.
        adjacency: (T, 4) int32 cells behind the faces.

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
