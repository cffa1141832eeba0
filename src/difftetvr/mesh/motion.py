"""How far the vertices of a mesh may move so that it stays a valid mesh of well-shaped cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import get_backend
from difftetvr.mesh.arrays import all_of_three, true_indices
from difftetvr.mesh.limits import MotionLimits
from difftetvr.mesh.shapes import (
    CellShapes,
    CellSource,
    cell_source,
    dot,
    length_scale,
    measure_cells,
    measured,
    scaled_points,
)
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import corner_columns, stars
from difftetvr.mesh.topology.topology import Topology
from difftetvr.recording import eager, replayed

_CERTAIN_QUALITY = 1e-13
"""Above this, rounding cannot have changed the sign of a volume: its error is below 4.6e-14 in units of Q."""
_SMALLEST = torch.finfo(torch.float64).tiny


@dataclass(frozen=True)
class GuardedMove:
    """The part of a proposed move that leaves every cell valid.

    Attributes:
        vertices: (V, 3) positions after the allowed part, in the precision of the mesh; the very bits of the old ones
            where a move was refused.
        halvings: (V,) int32 how often each vertex's move was halved; -1 where it was refused.
        halved: () int64, number of vertices that move by a part of what was proposed only.
        refused: () int64, number of vertices that were to move, but stay.
    """

    vertices: torch.Tensor
    halvings: torch.Tensor
    halved: torch.Tensor
    refused: torch.Tensor

    @property
    def fraction(self) -> torch.Tensor:
        """(V,) float64 how much of each vertex's move is allowed: 1, 1/2, 1/4, ... or 0."""
        return torch.where(self.halvings < 0, 0.0, torch.exp2(-self.halvings.double()))


def measure(mesh: TetMesh) -> CellShapes:
    """Volumes and qualities that moves are judged against.

    Args:
        mesh: The mesh before it moves.

    Returns:
        Its cells' shapes.
    """
    scale = length_scale(mesh.vertices)
    return CellShapes(scale, *measure_cells(corner_columns(mesh.topology), scaled_points(mesh.vertices, scale)))


@eager
def cap_move(move: torch.Tensor, altitudes: torch.Tensor, fraction: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Shortens moves that are longer than a fraction of the smallest altitude around their vertex.

    Args:
        move: (V, 3) proposed moves in units of length.
        altitudes: (V,) smallest altitude of the cells around each vertex.
        fraction: Longest move in altitudes; as long as it is below 1/4, all volumes stay positive.

    Returns:
        The (V, 3) moves in the same directions, and () int64 how many were shortened.
    """
    if not len(move):
        return move, altitudes.new_zeros((), dtype=torch.int64)
    backend = get_backend(str(move.device), torch.float64)
    with backend.exclusive():
        found = replayed(_capped, backend.floats(move), backend.floats(altitudes), backend.constant(float(fraction)))
        backend.run(found)
        *columns, is_capped = (backend.tensor(column) for column in found)
    return torch.stack(columns, 1).to(move.dtype), is_capped.sum()


@eager
def guard_move(
    mesh: TetMesh, move: torch.Tensor, limits: MotionLimits | None = None, before: CellShapes | None = None
) -> GuardedMove:
    """The part of a proposed move that inverts no cell and lets none fall under its floors.

    A cell is bad if it would have less than `limits.volume_ratio` of its volume, or a quality below `limits.quality`
    that falls. The moves of a bad cell's vertices are halved, after `limits.halvings` times set to zero, until no cell
    is bad: this always ends, as a mesh that does not move has no bad cell. Volumes are those of the positions as they
    will be stored, computed in float64. Cells so thin that float64 cannot tell the sign of their volume hold their
    vertices fast, unless the move makes them thicker.

    Args:
        mesh: Valid mesh.
        move: (V, 3) proposed moves in units of length, float32 or float64. A move that leads to no finite position is
            refused.
        limits: The floors; default: `MotionLimits()`.
        before: What `measure` says about the mesh, where the caller knows it already.

    Returns:
        The new positions, and what became of the moves.
    """
    limits = limits or MotionLimits()
    before = before or measure(mesh)
    old = mesh.vertices.detach()
    start, wanted = old.double(), move.detach().double()
    new = (start + wanted).to(old.dtype)
    refused = ~all_of_three(torch.isfinite(new))
    nowhere = true_indices(refused)
    new[nowhere] = old[nowhere]
    moving = ~all_of_three(new == old)
    halvings = torch.zeros(mesh.num_vertices, dtype=torch.int32, device=old.device)
    points = scaled_points(new, before.scale)

    cells: torch.Tensor | None = None
    while cells is None or cells.numel():
        bad = _bad_cells(mesh.topology, points, limits, before, cells)
        vertices = torch.unique(mesh.tets.index_select(0, bad)).long()
        vertices = vertices[moving[vertices] & (halvings[vertices] <= limits.halvings)]
        halvings[vertices] += 1
        part = torch.exp2(-halvings[vertices].double())
        part = torch.where(halvings[vertices] > limits.halvings, 0.0, part)
        new[vertices] = (start[vertices] + part[:, None] * wanted[vertices]).to(old.dtype)
        points[vertices] = scaled_points(new[vertices], before.scale)
        cells = torch.unique(stars(mesh.topology, vertices)[1])

    refused |= halvings > limits.halvings
    halvings = halvings.masked_fill_(refused, -1)
    return GuardedMove(new, halvings, (halvings > 0).sum(), refused.sum())


def _bad_cells(
    topology: Topology, points: torch.Tensor, limits: MotionLimits, before: CellShapes, cells: torch.Tensor | None
) -> torch.Tensor:
    """Indices of the bad ones among some cells, None for all."""
    if cells is not None and not cells.shape[0]:
        return cells
    corners, old = corner_columns(topology), (before.determinants, before.qualities)
    if cells is not None:
        corners, old = corners.index_select(1, cells), (old[0][cells], old[1][cells])
    backend = get_backend(str(points.device), torch.float64)
    with backend.exclusive():
        floors = backend.constant(float(limits.volume_ratio)), backend.constant(float(limits.quality))
        source = cell_source(backend, corners, points)
        is_bad = backend.tensor(replayed(_are_bad, source, *map(backend.floats, old), *floors))
    bad = true_indices(is_bad > 0)
    return bad if cells is None else cells[bad]


# ---- Kernels


def _are_bad(source: CellSource, old_determinant: Any, old_quality: Any, volume_ratio: Any, least: Any) -> Any:
    """1 for cells that would be bad, 0 for others."""
    determinant, quality = measured(*source.edges())
    # Comparisons with NaN are false, so what cannot be computed is bad.
    well_shaped = (quality >= least) | ((quality >= old_quality) & (quality > _CERTAIN_QUALITY))
    is_good = well_shaped & (determinant >= volume_ratio * old_determinant)
    integer = source.backend.Int
    result = dr.select(is_good, integer(0), integer(1))
    dr.eval(result)
    return result


def _capped(move: Any, altitudes: Any, fraction: Any) -> list[Any]:
    """The components of moves that are no longer than a fraction of altitudes, and 1 where they were."""
    real, integer = type(move), dr.int32_array_t(type(altitudes))
    vertex = dr.arange(dr.uint32_array_t(real), dr.width(altitudes))
    parts = [dr.gather(real, move, dr.fma(vertex, 3, k)) for k in range(3)]
    # The largest component as the unit: squares of very long moves would overflow, of very short ones vanish.
    unit = dr.fmax(dr.fmax(dr.abs(parts[0]), dr.abs(parts[1])), dr.fmax(dr.abs(parts[2]), _SMALLEST))
    scaled = [part / unit for part in parts]
    length, longest = unit * dr.sqrt(dot(scaled, scaled)), fraction * altitudes
    is_too_long = length > longest
    factor = dr.select(is_too_long, longest / length, 1.0)
    result = [*(part * factor for part in parts), dr.select(is_too_long, integer(1), integer(0))]
    dr.eval(result)
    return result
