"""Cells that are given by their faces: recognised where they are of a simple kind, else split into tetrahedra."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from difftetvr.mesh.making.conversion import FACES, fans

_SHAPES = {"tetra": (4, 0), "pyramid": (4, 1), "wedge": (2, 3), "hexahedron": (0, 6)}
"""Numbers of triangles and of quadrilaterals, by kind."""

_TOLERANCE = 1e-6
"""Share of a polyhedron's volume by which its tetrahedra may overlap unmentioned: faces are never quite plane."""
_MOST_TRIED = 60


@dataclass(frozen=True)
class Polyhedra:
    """Cells by their faces.

    Attributes:
        nodes: (M,) vertex indices of all faces in turn, around each; unchecked.
        faces: (F + 1,) where each face begins in ``nodes``.
        cells: (P + 1,) where each cell begins in ``faces``.
    """

    nodes: np.ndarray
    faces: np.ndarray
    cells: np.ndarray

    def __len__(self) -> int:
        """Number of cells."""
        return len(self.cells) - 1

    @property
    def face_sizes(self) -> np.ndarray:
        """(F,) number of vertices of each face."""
        return np.diff(self.faces)

    @property
    def cell_of_faces(self) -> np.ndarray:
        """(F,) cell that each face belongs to."""
        return np.repeat(np.arange(len(self)), np.diff(self.cells))

    def taken(self, rows: np.ndarray) -> Polyhedra:
        """Some of the cells, in another order if need be."""
        faces, cells = runs(self.cells[rows], self.cells[rows + 1] - self.cells[rows])
        nodes, begins = runs(self.faces[faces], self.face_sizes[faces])
        return Polyhedra(self.nodes[nodes], begins, cells)


def runs(starts: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of ranges, one range after the other.

    Args:
        starts: (N,) first index of each range.
        sizes: (N,) length of each.

    Returns:
        All indices, and (N + 1,) where each range begins among them.
    """
    begins = np.concatenate(([0], np.cumsum(sizes)))
    return np.arange(begins[-1]) + np.repeat(starts - begins[:-1], sizes), begins


def recognised(polyhedra: Polyhedra) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Cells that are tetrahedra, pyramids, wedges or hexahedra, in whatever order and turn their faces come.

    Args:
        polyhedra: The cells.

    Returns:
        By kind, rows (N,) of the cells and their corners (N, n) in VTK's order; and the rows of all others.
    """
    sizes = polyhedra.face_sizes
    triangles, quads = (_number_in_cells(polyhedra, sizes == n) for n in (3, 4))
    others = np.ones(len(polyhedra), bool)
    found = {}
    for kind, (a, b) in _SHAPES.items():
        rows = np.flatnonzero((triangles == a) & (quads == b) & (np.diff(polyhedra.cells) == a + b))
        if not len(rows):
            continue
        faces = polyhedra.cells[rows][:, None] + np.arange(a + b)
        faces = np.take_along_axis(faces, np.argsort(sizes[faces], axis=1, kind="stable"), 1)
        parts = [polyhedra.nodes[polyhedra.faces[faces[:, :a], None] + np.arange(3)]] if a else []
        parts += [polyhedra.nodes[polyhedra.faces[faces[:, a:], None] + np.arange(4)]] if b else []
        corners = _corners(kind, parts)
        good = _has_faces(kind, corners, parts)
        if good.any():
            found[kind] = (rows[good], corners[good])
            others[rows[good]] = False
    return found, np.flatnonzero(others)


def split(polyhedra: Polyhedra, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tetrahedra that fill polyhedra, cut so that all cells of a mesh fit together.

    Faces are cut as those of all cells are, so neighbours agree; each polyhedron is the fan of one of its vertices over
    the triangles of the faces that do not hold it. That is the smallest one where this fills the polyhedron, as in all
    that are convex; else the one with which its tetrahedra overlap least.

    Args:
        polyhedra: Closed cells, each of 4 faces of 3 vertices or more, with indices in range.
        points: (V, 3) positions.

    Returns:
        (T, 4) tetrahedra, of either orientation; (T,) rows of the cells that they are pieces of, ascending; and (P,)
        float64, by which share of a cell's volume its tetrahedra overlap; 0 where that is a matter of rounding.
    """
    if not len(polyhedra):
        return np.empty((0, 4), np.int64), np.empty(0, np.int64), np.empty(0)
    triangles, parents = _triangles(polyhedra)
    apex = np.minimum.reduceat(polyhedra.nodes, polyhedra.faces[polyhedra.cells[:-1]])
    with np.errstate(all="ignore"):  # positions may be anything yet
        filled, sums = _filled(points, triangles, parents, points[apex])
        volume = _volumes(polyhedra, points, sums)
        doubtful = np.flatnonzero(filled > (1 + _TOLERANCE) * volume)
        if len(doubtful):
            apex[doubtful], filled[doubtful] = _best_apex(polyhedra.taken(doubtful), points)
        overlap = np.where(filled > (1 + _TOLERANCE) * volume, 0.5 * (filled / volume - 1), 0.0)
    away = (triangles != apex[parents][:, None]).all(1)
    return np.column_stack((apex[parents], triangles))[away], parents[away], overlap


def _number_in_cells(polyhedra: Polyhedra, of_faces: np.ndarray) -> np.ndarray:
    """How many faces of each cell are marked."""
    return np.bincount(polyhedra.cell_of_faces[of_faces], minlength=len(polyhedra))


def _corners(kind: str, parts: list[np.ndarray]) -> np.ndarray:
    """(N, n) corners of cells as they would be if the cells were of a kind; faces by size, triangles first."""
    base = parts[-1][:, 0] if kind in ("pyramid", "hexahedron") else parts[0][:, 0]
    if kind in ("tetra", "pyramid"):
        face = parts[0][:, 1]
        other = (face[:, :, None] != base[:, None]).all(2).argmax(1)
        return np.column_stack((base, face[np.arange(len(face)), other]))
    quads = parts[-1]
    ends = np.concatenate([np.roll(quads, turn, axis=2).reshape(len(quads), -1) for turn in (1, -1)], 1)
    starts = np.tile(quads.reshape(len(quads), -1), 2)
    leaves = (ends[:, :, None] != base[:, None]).all(2)
    edges = [((starts == corner[:, None]) & leaves).argmax(1) for corner in base.T]
    return np.column_stack((base, *(ends[np.arange(len(ends)), edge] for edge in edges)))


def _has_faces(kind: str, corners: np.ndarray, parts: list[np.ndarray]) -> np.ndarray:
    """Which cells with such corners have exactly these faces, and all corners different."""
    ordered = np.sort(corners, 1)
    good = (ordered[:, 1:] != ordered[:, :-1]).all(1)
    for faces in parts:
        size = faces.shape[2]
        wanted = np.stack([corners[:, face] for face in FACES[kind] if len(face) == size], 1)
        same = (np.sort(faces, 2)[:, :, None] == np.sort(wanted, 2)[:, None]).all(3)
        good &= same.any(1).all(1) & same.any(2).all(1)
    return good


def _triangles(polyhedra: Polyhedra) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) triangles of all faces and (K,) the cells they belong to, ascending."""
    sizes, cells = polyhedra.face_sizes, polyhedra.cell_of_faces
    triangles, parents = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for size in np.unique(sizes).tolist():
        rows = np.flatnonzero(sizes == size)
        found = fans(polyhedra.nodes[polyhedra.faces[rows][:, None] + np.arange(size)])
        triangles += found
        parents += [cells[rows]] * len(found)
    order = np.argsort(np.concatenate(parents), kind="stable")
    return np.concatenate(triangles)[order], np.concatenate(parents)[order]


def _centers(polyhedra: Polyhedra, points: np.ndarray) -> np.ndarray:
    cells = np.repeat(polyhedra.cell_of_faces, polyhedra.face_sizes)
    counts = np.bincount(cells, minlength=len(polyhedra))
    sums = [np.bincount(cells, axis[polyhedra.nodes], len(polyhedra)) for axis in points.T]
    return np.stack(sums, 1) / counts[:, None]


def _volumes(polyhedra: Polyhedra, points: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """(P,) six times the volume of each cell.

    Seen from a point within which sees all faces, the pyramids over these fill a cell; from other points they fill
    more. Their signed sum is the volume from everywhere if all faces turn the same way, which not all files heed.
    """
    triangles, parents = _triangles(polyhedra)
    filled, others = _filled(points, triangles, parents, _centers(polyhedra, points))
    return np.where(np.abs(others - sums) <= _TOLERANCE * filled, np.abs(others), filled)


def _filled(
    points: np.ndarray, triangles: np.ndarray, parents: np.ndarray, apexes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(P,) six times the volumes of the pyramids of each cell's apex over its triangles: without signs, and with."""
    a, b, c = (points[triangles[:, i]] - apexes[parents] for i in range(3))
    volumes = np.einsum("ij,ij->i", np.cross(a, b), c)
    return np.bincount(parents, np.abs(volumes), len(apexes)), np.bincount(parents, volumes, len(apexes))


def _best_apex(polyhedra: Polyhedra, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each cell's vertices the one whose fan fills least, and how much it fills."""
    triangles, parents = _triangles(polyhedra)
    begins = polyhedra.faces[polyhedra.cells]
    apex = np.minimum.reduceat(polyhedra.nodes, begins[:-1])
    least, _ = _filled(points, triangles, parents, points[apex])
    for turn in range(min(int(np.diff(begins).max()), _MOST_TRIED)):
        candidate = polyhedra.nodes[begins[:-1] + turn % np.diff(begins)]
        filled, _ = _filled(points, triangles, parents, points[candidate])
        better = filled < (1 - _TOLERANCE) * least
        apex[better], least[better] = candidate[better], filled[better]
    return apex, least
