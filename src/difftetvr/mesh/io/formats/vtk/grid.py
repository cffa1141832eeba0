"""A data set of VTK's with its data, and which of its cells are to be seen."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from difftetvr.errors import counted
from difftetvr.mesh.io.content import Content
from difftetvr.mesh.io.formats.vtk.cells import Cells, blocks

GHOSTS = (_GHOSTS, _OLD_GHOSTS) = ("vtkGhostType", "vtkGhostLevels")
"""Names of the arrays that say which cells are not to be seen."""

_DUPLICATE_POINT, _HIDDEN_POINT = 1, 2
_UNSEEN_CELL = 1 | 8 | 32
"""Bits of cells that another piece has, that finer ones stand for, and that are hidden; see vtkDataSetAttributes.h."""


@dataclass(frozen=True)
class Grid:
    """A data set.

    Attributes:
        points: (V, 3) positions.
        cells: N cells.
        point_data: Arrays of V rows.
        cell_data: Arrays of N rows.
        are_duplicates: (V,) which points belong to another piece.
        hidden: Number of cells that are there no more, as they are not to be seen.
    """

    points: np.ndarray
    cells: Cells
    point_data: dict[str, np.ndarray]
    cell_data: dict[str, np.ndarray]
    are_duplicates: np.ndarray
    hidden: int = 0

    def content(self, path: Path, notes: Iterable[str] = ()) -> Content:
        """What the file holds of meshes.

        Args:
            path: The file, for sentences.
            notes: What else is to be said of it.

        Raises:
            MeshError: A cell has not as many vertices as cells of its kind.
        """
        found, more = blocks(path, self.cells, self.points)
        notes = (*notes, *hidden_notes(self.hidden), *more)
        return Content(self.points, found, self.point_data, self.cell_data, notes, hidden=self.hidden)


def visible_grid(
    points: np.ndarray, cells: Cells, point_data: dict[str, np.ndarray], cell_data: dict[str, np.ndarray]
) -> Grid:
    """A data set less the cells that its ghost arrays mark as hidden or as duplicates, and less these arrays."""
    of_points, unseen = _mark(point_data, _GHOSTS), np.zeros(len(cells.types), bool)
    for name in GHOSTS:
        if (marks := _mark(cell_data, name)) is not None:
            unseen |= are_unseen(name, marks)
    are_duplicates = np.zeros(len(points), bool)
    if of_points is not None:
        are_duplicates |= (of_points & _DUPLICATE_POINT) != 0
        unseen |= _have_node(cells, (of_points & _HIDDEN_POINT) != 0)
    if (levels := _mark(point_data, _OLD_GHOSTS)) is not None:
        are_duplicates |= levels > 0
    point_data = {name: values for name, values in point_data.items() if name not in GHOSTS}
    cell_data = {name: values for name, values in cell_data.items() if name not in GHOSTS}
    count = int((unseen & cells.have_volume).sum())
    cells = cells.without(unseen) if unseen.any() else cells
    return Grid(points, cells, point_data, cell_data, are_duplicates, count)


def are_unseen(name: str, marks: np.ndarray) -> np.ndarray:
    """(N,) which cells are not to be seen, by the integers of the array of that name."""
    return (marks & _UNSEEN_CELL) != 0 if name == _GHOSTS else marks > 0


def hidden_notes(count: int) -> tuple[str, ...]:
    """What is to be said of so many cells that are not to be seen."""
    what = f"{counted(count, 'cell')} marked as hidden or as another piece's ({_GHOSTS})"
    return (f"Left out {what}.",) if count else ()


def used_points(grid: Grid) -> np.ndarray:
    """(V,) which points the cells of a data set use that are to be seen; indices out of range count as others."""
    used = np.zeros(len(grid.points), bool)
    cells = grid.cells
    listed = np.repeat((cells.types != 0) & ~cells.are_polyhedra, np.diff(cells.offsets))
    for nodes in (cells.nodes[cells.offsets[0] : cells.offsets[-1]][listed], cells.polyhedra.nodes):
        used[nodes[(nodes >= 0) & (nodes < len(used))]] = True
    return used


def _mark(arrays: dict[str, np.ndarray], name: str) -> np.ndarray | None:
    values = arrays.get(name)
    return values if values is not None and values.ndim == 1 and values.dtype.kind in "iu" else None


def _have_node(cells: Cells, marked: np.ndarray) -> np.ndarray:
    """(N,) which cells have a marked point; of polyhedra the vertices are not looked at."""
    if not marked.any():
        return np.zeros(len(cells.types), bool)
    count = np.concatenate(([0], np.cumsum(np.take(marked, cells.nodes, mode="clip"))))
    return (count[cells.offsets[1:]] > count[cells.offsets[:-1]]) & ~cells.are_polyhedra
