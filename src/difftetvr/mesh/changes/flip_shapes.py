"""What bistellar flips do to the shapes of cells, a candidate a lane (Dr.Jit kernels)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import NONE, Backend, get_backend
from difftetvr.mesh import quality
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.changes.flips import FOUR_TO_FOUR, THREE_TO_TWO, TWO_TO_THREE, Flips, cells_after
from difftetvr.mesh.shapes import Vector, length_scale, measure_cells, measured, position, scaled_points
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import corner_columns
from difftetvr.recording import replayed


@dataclass(frozen=True)
class FlipCandidates:
    """Flips of one kind that the topology admits; for the attributes see `Flips`, here without filling."""

    kind: int
    vanishes: torch.Tensor
    cells: torch.Tensor
    edge: torch.Tensor
    ring: torch.Tensor

    def select(self, rows: torch.Tensor) -> FlipCandidates:
        """Some of them, (M,) int64."""
        parts = (self.vanishes, self.cells, self.edge, self.ring)
        return FlipCandidates(self.kind, *(part.index_select(0, rows) for part in parts))


class FlipJudge:
    """Tells which flips of a mesh leave good cells: of a quality that is high enough, or no worse than before."""

    def __init__(self, mesh: TetMesh, min_quality: float) -> None:
        self.mesh = mesh
        self.points = scaled_points(mesh.vertices, length_scale(mesh.vertices))
        self._shapes = measure_cells(corner_columns(mesh.topology), self.points)
        self._backend = get_backend(str(self.points.device), torch.float64)
        self._min_quality = min_quality

    def good_faces(self) -> torch.Tensor:
        """(N,) int64 the inner faces whose 2-3 flips leave good cells, as indices into `mesh.topology.faces`."""
        topology, backend = self.mesh.topology, self._backend
        with backend.exclusive():
            cells = [backend.uints(column) for column in topology.face_cells.unbind(1)]
            faces = _Faces(cells, backend.uints(topology.faces), backend.uints(topology.tets))
            return true_indices(backend.tensor(replayed(_good_faces, self._source(), faces)) > 0)

    def good(self, candidates: FlipCandidates) -> FlipCandidates:
        """Those candidates that leave good cells."""
        if not len(candidates.vanishes):
            return candidates
        backend = self._backend
        with backend.exclusive():
            is_good = backend.tensor(replayed(_are_good, self._source(), _uploaded(backend, candidates)))
        return candidates.select(true_indices(is_good > 0))

    def flips(self, candidates: FlipCandidates) -> Flips:
        """Candidates that are possible, and what is to be known of them."""
        backend, numbers = self._backend, [self.points[:0, 0]] * 6
        if len(candidates.vanishes):
            with backend.exclusive():
                found = replayed(_described, self._source(), _uploaded(backend, candidates))
                backend.run(found)
                numbers = [backend.tensor(column) for column in found]
        return Flips(
            mesh=self.mesh,
            kind=torch.full_like(candidates.vanishes, candidates.kind, dtype=torch.int8),
            vanishes=candidates.vanishes,
            cells=_filled(candidates.cells),
            edge=candidates.edge,
            ring=_filled(candidates.ring),
            weight=numbers[0],
            face_weights=torch.stack(numbers[1:4], 1),
            quality_before=numbers[4],
            quality_after=numbers[5],
        )

    def _source(self) -> _Shapes:
        points, determinants, qualities = map(self._backend.floats, (self.points, *self._shapes))
        return _Shapes(self._backend, points, determinants, qualities, self._backend.opaque(self._min_quality))


def _uploaded(backend: Backend, candidates: FlipCandidates) -> _Flips:
    columns = (candidates.cells, candidates.edge, candidates.ring)
    cells, edge, ring = ([backend.uints(column) for column in part.t().contiguous()] for part in columns)
    return _Flips(candidates.kind, cells, edge, ring)


def _filled(indices: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.pad(indices, (0, 4 - indices.shape[1]), value=-1)


# ---- Kernels


@dataclass
class _Shapes:
    """Cells as they are, flat.

    Attributes:
        backend: Array types, float64.
        points: (V, 4) positions in a unit in which no product overflows, and padding.
        determinants, qualities: (T,) of the cells, see `measure_cells`.
        floor: Smallest quality of a new cell, unless one was worse before.
    """

    backend: Backend
    points: Any
    determinants: Any
    qualities: Any
    floor: Any

    def position(self, vertex: Any) -> Vector:
        """Position of a vertex."""
        return position(self.backend, self.points, vertex)

    def quality_before(self, cells: list[Any]) -> Any:
        """Quality of the worst of some cells."""
        return _least([dr.gather(self.backend.Float, self.qualities, cell) for cell in cells])

    def is_good(self, before: Any, after: Any) -> Any:
        """Whether cells of these least qualities may give way to each other."""
        return (after > quality.FLAT) & (after >= dr.fmin(before, self.floor))


@dataclass
class _Faces:
    """Faces and their cells, flat.

    Attributes:
        cells: (F,) the first cell of each face, and the second.
        corners: (F, 3) vertices.
        tets: (T, 4) vertices of cells.
    """

    cells: list[Any]
    corners: Any
    tets: Any


@dataclass
class _Flips:
    """Flips of one kind, a column for each of their cells, ends and vertices around, see `Flips`."""

    kind: int
    cells: list[Any]
    edge: list[Any]
    ring: list[Any]


def _good_faces(shapes: _Shapes, faces: _Faces) -> Any:
    """1 for inner faces whose flip leaves good cells, 0 for others."""
    backend, is_inner = shapes.backend, faces.cells[1] != NONE
    face = dr.arange(backend.UInt, dr.width(is_inner))
    ring = [dr.gather(backend.UInt, faces.corners, 3 * face + k, is_inner) for k in range(3)]
    cells = [dr.select(is_inner, cell, 0) for cell in faces.cells]
    apexes = []
    for cell in cells:
        corners = dr.gather(backend.UInt4, faces.tets, cell, is_inner)
        apexes.append(corners[0] + corners[1] + corners[2] + corners[3] - ring[0] - ring[1] - ring[2])
    _, after = _shapes_after(shapes, TWO_TO_THREE, apexes, ring)
    is_good = is_inner & shapes.is_good(shapes.quality_before(cells), after)
    result = dr.select(is_good, backend.Int(1), backend.Int(0))
    dr.eval(result)
    return result


def _are_good(shapes: _Shapes, flips: _Flips) -> Any:
    """1 for flips that leave good cells, 0 for others."""
    _, after = _shapes_after(shapes, flips.kind, flips.edge, flips.ring)
    is_good = shapes.is_good(shapes.quality_before(flips.cells), after)
    result = dr.select(is_good, shapes.backend.Int(1), shapes.backend.Int(0))
    dr.eval(result)
    return result


def _described(shapes: _Shapes, flips: _Flips) -> list[Any]:
    """`weight`, the `face_weights`, and both qualities of `Flips`."""
    determinants, after = _shapes_after(shapes, flips.kind, flips.edge, flips.ring)
    before = [dr.gather(shapes.backend.Float, shapes.determinants, cell) for cell in flips.cells]
    result = [*_crossing(flips.kind, before, determinants), shapes.quality_before(flips.cells), after]
    dr.eval(result)
    return result


def _shapes_after(shapes: _Shapes, kind: int, edge: list[Any], ring: list[Any]) -> tuple[list[Any], Any]:
    """Determinants of the cells that appear, and quality of the worst."""
    determinants, qualities = [], []
    for corners in cells_after(kind, [shapes.position(v) for v in edge], [shapes.position(v) for v in ring]):
        first, *others = corners
        determinant, quality_of_cell = measured(*([x - y for x, y in zip(p, first, strict=True)] for p in others))
        determinants.append(determinant)
        qualities.append(quality_of_cell)
    return determinants, _least(qualities)


def _least(qualities: list[Any]) -> Any:
    """What cannot be computed is as bad as can be."""
    least = dr.inf
    for value in qualities:
        value = dr.select(dr.isfinite(value), value, -dr.inf)
        least = dr.select(value < least, value, least)
    return least


def _crossing(kind: int, before: list[Any], after: list[Any]) -> list[Any]:
    """Where the edge of flips pierces their face: `weight` and `face_weights` of `Flips`.

    The edge is divided as the volumes of the cells that join the face to its ends, and the face as those of the cells
    that join the edge to its sides.

    Args:
        kind: Kind of the flips.
        before: Determinants of the cells that vanish.
        after: Determinants of the cells that appear.
    """
    # An old cell may be so thin that rounding takes its volume for negative.
    before = [dr.fmax(determinant, 0.0) for determinant in before]
    at_ends, at_sides = (after, before) if kind == THREE_TO_TWO else (before[:2], after)
    length = at_ends[0] + at_ends[1]
    ab, bc, ca = at_sides[:3]
    if kind == FOUR_TO_FOUR:
        # The cell between the two edges is none of the mesh's, and has no volume where they cross.
        ca = dr.fmax(length - ab - bc, 0.0)
    # A corner weighs as much as the side opposite it.
    area = ab + bc + ca
    return [at_ends[0] / length, bc / area, ca / area, ab / area]
