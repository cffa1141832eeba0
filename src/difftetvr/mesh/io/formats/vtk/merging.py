"""Several pieces of one data set put together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from difftetvr.errors import counted
from difftetvr.mesh.io.content import damaged
from difftetvr.mesh.io.formats.vtk.cells import Cells
from difftetvr.mesh.io.formats.vtk.grid import Grid, used_points
from difftetvr.mesh.making.polyhedra import Polyhedra

_NAMES_SHOWN = 8


def merged(path: Path, grids: Sequence[Grid]) -> tuple[Grid, tuple[str, ...]]:
    """One data set of several, whose points are one where pieces meet.

    Points of different pieces at exactly the same position are one point, so that cells on both sides share their
    faces. Where a piece itself has several points there, as at a crack, all stay as they are.

    Args:
        path: The file, for sentences.
        grids: The pieces; those without volume cells are left out, if others have some.

    Returns:
        The data set, and what is to be said of it.

    Raises:
        MeshError: A cell has a vertex that its piece has not.
    """
    hidden = sum(grid.hidden for grid in grids)
    grids = [grid for grid in grids if grid.cells.have_volume.any()] or list(grids[:1])
    if len(grids) == 1:
        return replace(grids[0], hidden=hidden), ()
    for grid in grids:
        _require_in_range(path, grid)
    points = np.concatenate([grid.points for grid in grids])
    spare = np.concatenate([grid.are_duplicates | ~used_points(grid) for grid in grids])
    pieces = np.repeat(np.arange(len(grids)), [len(grid.points) for grid in grids])
    place = _meeting_points(points, pieces, spare)
    point_data, partial = _common_data([grid.point_data for grid in grids])
    cell_data, partial_too = _common_data([grid.cell_data for grid in grids])
    cells = _joined_cells(grids, place)
    whole = Grid(points, cells, point_data, cell_data, spare, hidden)
    notes = _notes_of_merging(whole, len(grids), place)
    if names := partial | partial_too:
        notes.append(f"Left out data that not all of its {len(grids)} pieces have alike: {_shown(names)}.")
    return whole, tuple(notes)


def _common_data(arrays: Sequence[dict[str, np.ndarray]]) -> tuple[dict[str, np.ndarray], set[str]]:
    """Point or cell data of the whole, and the names of those that not all pieces have alike."""
    shapes = Counter((name, values.shape[1:]) for of_piece in arrays for name, values in of_piece.items())
    partial = {name for (name, _), count in shapes.items() if count < len(arrays)}
    whole = {name: np.concatenate([of_piece[name] for of_piece in arrays]) for name in arrays[0] if name not in partial}
    return whole, partial


def _require_in_range(path: Path, grid: Grid) -> None:
    for nodes in (grid.cells.nodes, grid.cells.polyhedra.nodes):
        if len(nodes) and (nodes.min() < 0 or nodes.max() >= len(grid.points)):
            raise damaged(path, f"a cell of a piece has a vertex that none of its {len(grid.points)} points is")


def _meeting_points(points: np.ndarray, pieces: np.ndarray, spare: np.ndarray) -> np.ndarray:
    """(V,) the point that each is to be: itself, or the first at its position, not a spare one if there are others."""
    if not len(points):
        return np.empty(0, np.int64)
    order = np.lexsort((pieces, *points.T))
    same = (points[order[1:]] == points[order[:-1]]).all(1)
    groups = np.concatenate(([0], np.cumsum(~same)))
    starts = np.flatnonzero(np.concatenate(([True], ~same)))
    repeated = same & (pieces[order[1:]] == pieces[order[:-1]])
    is_cracked = np.bincount(groups[1:][repeated], minlength=len(starts)) > 0
    first = np.minimum.reduceat(order + len(points) * spare[order], starts) % len(points)
    place = np.empty(len(points), np.int64)
    place[order] = np.where(is_cracked[groups], order, first[groups])
    return place


def _joined_cells(grids: Sequence[Grid], place: np.ndarray) -> Cells:
    nodes, faces, shift = [], [], 0
    for grid in grids:
        nodes.append(place[grid.cells.nodes + shift])
        faces.append(place[grid.cells.polyhedra.nodes + shift])
        shift += len(grid.points)
    polyhedra = Polyhedra(
        np.concatenate(faces),
        _joined_offsets([grid.cells.polyhedra.faces for grid in grids]),
        _joined_offsets([grid.cells.polyhedra.cells for grid in grids]),
    )
    types = np.concatenate([grid.cells.types for grid in grids])
    starts = np.cumsum([0, *(len(grid.cells.nodes) for grid in grids)])
    offsets = [grid.cells.offsets[:-1] + start for grid, start in zip(grids, starts.tolist())]
    return Cells(types, np.concatenate(nodes), np.concatenate((*offsets, starts[-1:])), polyhedra)


def _joined_offsets(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(([0], np.cumsum(np.concatenate([np.diff(part) for part in parts]))))


def _notes_of_merging(grid: Grid, pieces: int, place: np.ndarray) -> list[str]:
    moved = np.flatnonzero((place != np.arange(len(place))) & ~grid.are_duplicates)
    if not len(moved):
        return []
    differing = [name for name, values in grid.point_data.items() if _differ(values[moved], values[place[moved]])]
    note = f"Merged {counted(len(moved), 'point')} at which its {pieces} pieces meet"
    if not differing:
        return [f"{note}."]
    return [f"{note}; those of the first piece were kept of data that differ there: {_shown(differing)}."]


def _shown(names: Iterable[str]) -> str:
    ordered = sorted(names)
    return ", ".join(ordered[:_NAMES_SHOWN]) + (", ..." if len(ordered) > _NAMES_SHOWN else "")


def _differ(a: np.ndarray, b: np.ndarray) -> bool:
    return not np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
