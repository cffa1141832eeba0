"""Edges and faces looked up for millions of cells at once (Dr.Jit kernels)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import NONE, Backend, get_backend
from difftetvr.mesh.topology.topology import LOCAL_EDGES, Topology
from difftetvr.recording import eager, replayed


@dataclass(frozen=True)
class EdgeRows:
    """Edges in rows, one for each vertex: its neighbours of a higher number, ascending.

    Attributes:
        offsets: (V + 1,) int32, where rows begin.
        higher: (E,) int32.
    """

    offsets: torch.Tensor
    higher: torch.Tensor


@eager
def places_of_edges(rows: EdgeRows, one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """(N,) int32 places of edges between (N,) vertices, -1 where there is none; N is not 0."""
    backend = _backend(rows.higher)
    with backend.exclusive():
        return backend.tensor(replayed(_places, _rows(backend, rows), backend.uints(one), backend.uints(other)))


@eager
def edges_of_cells(rows: EdgeRows, corners: torch.Tensor) -> torch.Tensor:
    """(T, 6) int32 places of the edges of cells, in the order of `LOCAL_EDGES`.

    Args:
        rows: All edges there are.
        corners: (4, T) int32 vertices of the cells.
    """
    backend = _backend(corners)
    with backend.exclusive():
        found = replayed(_edges_of_cells, _rows(backend, rows), [backend.uints(column) for column in corners])
        backend.run(found)
        return torch.stack([backend.tensor(column) for column in found], 1)


@eager
def faces_of_cells(adjacency: torch.Tensor) -> torch.Tensor:
    """(T, 4) int32 faces of cells, numbered in the order of the cells that they are first of.

    Args:
        adjacency: (T, 4) int32 neighbours, see :class:`difftetvr.mesh.Topology`.
    """
    backend = _backend(adjacency)
    with backend.exclusive():
        across = backend.uints(adjacency)
        is_first = backend.tensor(replayed(_is_first_of_face, backend, across))
        rank = is_first.cumsum(0, dtype=torch.int32)
        return backend.tensor(replayed(_faces_of_corners, backend, across, backend.uints(rank)), -1, 4)


@eager
def are_faces(topology: Topology, corners: torch.Tensor) -> torch.Tensor:
    """(N,) bool, whether some cell has three vertices together.

    Args:
        topology: The cells.
        corners: (N, 3) int32 vertices, all different.
    """
    if not corners.shape[0]:
        return torch.zeros_like(corners[:, 0], dtype=torch.bool)
    backend = _backend(corners)
    with backend.exclusive():
        stars = Stars.of(backend, topology)
        columns = [backend.uints(column) for column in corners.unbind(1)]
        return backend.tensor(replayed(_are_faces, stars, columns)) > 0


def is_corner(corners: Any, vertex: Any) -> Any:
    """Which cells have a vertex, of tensors and in kernels alike.

    Args:
        corners: (4, M) the cells' vertices: torch takes ten times as long to look through columns of four.
        vertex: (M,) the vertex asked for in each cell.

    Returns:
        (M,) bool.
    """
    return (corners[0] == vertex) | (corners[1] == vertex) | (corners[2] == vertex) | (corners[3] == vertex)


def _backend(table: torch.Tensor) -> Backend:
    return get_backend(str(table.device))


def _rows(backend: Backend, rows: EdgeRows) -> _Rows:
    return _Rows(backend, backend.uints(rows.offsets), backend.uints(rows.higher))


# ---- Kernels


@dataclass
class _Rows:
    """:class:`EdgeRows` as kernels read them."""

    backend: Backend
    offsets: Any
    higher: Any

    def place(self, one: Any, other: Any) -> Any:
        """Place of the edge between two vertices."""
        uint, is_lower = self.backend.UInt, one < other
        low, high = dr.select(is_lower, one, other), dr.select(is_lower, other, one)
        first = dr.gather(uint, self.offsets, low)
        count = dr.gather(uint, self.offsets, low + 1) - first

        def halve(place: Any, left: Any) -> tuple[Any, Any]:
            half = left >> 1
            is_behind = dr.gather(uint, self.higher, place + half - 1) < high
            return dr.select(is_behind, place + half, place), left - half

        place, _ = dr.while_loop((first, count), lambda _, left: left > 1, halve)
        is_there = (count > 0) & (dr.gather(uint, self.higher, place, count > 0) == high)
        return dr.select(is_there, place, NONE)


def _places(rows: _Rows, one: Any, other: Any) -> Any:
    result = rows.backend.Int(rows.place(one, other))
    dr.eval(result)
    return result


def _edges_of_cells(rows: _Rows, corners: list[Any]) -> list[Any]:
    result = [rows.backend.Int(rows.place(corners[i], corners[j])) for i, j in LOCAL_EDGES]
    dr.eval(result)
    return result


def _is_first_of_face(backend: Backend, across: Any) -> Any:
    """1 where a corner's face has no cell of a lower number behind it, else 0."""
    cell = dr.arange(backend.UInt, dr.width(across)) >> 2
    result = dr.select(across > cell, backend.Int(1), backend.Int(0))
    dr.eval(result)
    return result


def _faces_of_corners(backend: Backend, across: Any, rank: Any) -> Any:
    """The face opposite each corner, by the number of first corners up to each."""
    corner = dr.arange(backend.UInt, dr.width(across))
    cell = corner >> 2
    is_first = across > cell
    behind = dr.gather(backend.UInt4, across, across, ~is_first)
    twin = 4 * across
    for k in range(1, 4):
        twin = dr.select(behind[k] == cell, 4 * across + k, twin)
    result = backend.Int(dr.gather(backend.UInt, rank, dr.select(is_first, corner, twin)) - 1)
    dr.eval(result)
    return result


@dataclass
class Stars:
    """Cells around vertices as kernels read them, flat.

    Attributes:
        backend: Array types.
        offsets, cells: See :attr:`difftetvr.mesh.Topology.vertex_cells`.
        tets: (T, 4) vertices of cells.
    """

    backend: Backend
    offsets: Any
    cells: Any
    tets: Any

    @staticmethod
    def of(backend: Backend, topology: Topology) -> Stars:
        """Those of a mesh."""
        return Stars(backend, *map(backend.uints, (*topology.vertex_cells, topology.tets)))

    def around(self, vertex: Any) -> tuple[Any, Any]:
        """First of the places that stand for the cells around a vertex, and the one behind the last."""
        first, end = (dr.gather(self.backend.UInt, self.offsets, vertex + k) for k in range(2))
        return first, end

    def tet(self, place: Any) -> Any:
        """Vertices of the cell at a place."""
        return dr.gather(self.backend.UInt4, self.tets, dr.gather(self.backend.UInt, self.cells, place))


def _are_faces(stars: Stars, corners: list[Any]) -> Any:
    uint, (first, second, third) = stars.backend.UInt, corners
    begin, end = stars.around(first)

    def look(place: Any, found: Any) -> tuple[Any, Any]:
        tet = stars.tet(place)
        return place + 1, dr.select(is_corner(tet, second) & is_corner(tet, third), uint(1), found)

    state = (begin, dr.zeros(uint, dr.width(first)))
    _, found = dr.while_loop(state, lambda place, found: (place < end) & (found == 0), look)
    result = stars.backend.Int(found)
    dr.eval(result)
    return result
