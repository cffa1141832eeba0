"""Faces of polyhedra as VTK's files list them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from difftetvr.mesh.io.content import damaged
from difftetvr.mesh.making.polyhedra import Polyhedra, runs

_MOST_FACES = 10_000
_LEAST_FACES, _LEAST_NODES = 4, 3

NO_POLYHEDRA = Polyhedra(np.empty(0, np.int64), np.zeros(1, np.int64), np.zeros(1, np.int64))


def from_stream(path: Path, stream: np.ndarray, starts: np.ndarray, stops: np.ndarray) -> Polyhedra:
    """Polyhedra from one list of numbers: of each its number of faces, and of each face its vertices' number and these.

    Args:
        path: The file, for sentences.
        stream: (M,) int64 numbers.
        starts: (P,) int64 where the list of each polyhedron begins.
        stops: (P,) int64 where it ends.

    Raises:
        MeshError: The list is damaged.
    """
    if not len(starts):
        return NO_POLYHEDRA
    if starts.min() < 0 or stops.max() > len(stream) or (stops <= starts).any():
        raise damaged(path, "the faces of a polyhedron lie outside the list of faces")
    counts = stream[starts]
    if counts.min() < _LEAST_FACES or counts.max() > _MOST_FACES:
        raise damaged(path, f"a polyhedron has less than {_LEAST_FACES} or more than {_MOST_FACES:,} faces")
    cells, position, found = np.arange(len(starts)), starts + 1, []
    for turn in range(int(counts.max())):  # the next face of all cells that have as many
        alive = counts[cells] > turn
        cells, position = cells[alive], position[alive]
        if (position >= stops[cells]).any():
            raise damaged(path, "the faces of a polyhedron are cut short")
        sizes = stream[position]
        if sizes.min() < _LEAST_NODES or (sizes > stops[cells] - position - 1).any():
            raise damaged(path, f"a face of a polyhedron has less than {_LEAST_NODES} vertices or is cut short")
        found.append((cells, position + 1, sizes))
        position = position + 1 + sizes
    of_cells, begins, sizes = (np.concatenate(parts) for parts in zip(*found))
    order = np.argsort(of_cells, kind="stable")
    nodes, faces = runs(begins[order], sizes[order])
    return Polyhedra(stream[nodes], faces, np.concatenate(([0], np.cumsum(counts))))


def from_tables(
    path: Path,
    connectivity: np.ndarray,
    face_ends: np.ndarray,
    faces_of_cells: np.ndarray,
    cell_starts: np.ndarray,
    cell_ends: np.ndarray,
) -> Polyhedra:
    """Polyhedra from a table of faces and one of the faces that each cell has.

    Args:
        path: The file, for sentences.
        connectivity: (M,) int64 vertex indices of all faces in turn.
        face_ends: (F,) int64 where each face ends in it.
        faces_of_cells: (C,) int64 numbers of the faces of all polyhedra in turn.
        cell_starts: (P,) int64 where each polyhedron's begin there.
        cell_ends: (P,) int64 where they end.

    Raises:
        MeshError: The tables do not fit each other.
    """
    face_starts = np.concatenate(([0], face_ends[:-1])) if len(face_ends) else face_ends
    sizes, counts = face_ends - face_starts, cell_ends - cell_starts
    if len(sizes) and (sizes.min() < _LEAST_NODES or face_ends[-1] > len(connectivity)):
        raise damaged(path, f"a face of a polyhedron has less than {_LEAST_NODES} vertices or is cut short")
    if len(counts) and (counts.min() < _LEAST_FACES or cell_starts.min() < 0 or cell_ends.max() > len(faces_of_cells)):
        raise damaged(path, f"a polyhedron has less than {_LEAST_FACES} faces, or they are not listed")
    picked, cells = runs(cell_starts, counts)
    faces = faces_of_cells[picked]
    if len(faces) and (faces.min() < 0 or faces.max() >= len(sizes)):
        raise damaged(path, "a polyhedron has a face that is not listed")
    nodes, begins = runs(face_starts[faces], sizes[faces])
    return Polyhedra(connectivity[nodes], begins, cells)
