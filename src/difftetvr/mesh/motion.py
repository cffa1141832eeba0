"""How far the vertices of a mesh may move so that it stays a valid mesh of well-shaped cells."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.limits import MotionLimits
from difftetvr.mesh.shapes import CellShapes, corner_columns, length_scale, measure_cells, scaled_points
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import stars
from difftetvr.mesh.topology.topology import Topology

_CERTAIN_QUALITY = 1e-13
"""Above this, rounding cannot have changed the sign of a volume: its error is below 4.6e-14 in units of Q."""


@dataclass(frozen=True)
class GuardedMove:
    """The part of a proposed move that leaves every cell valid.

    Attributes:
        vertices: (V, 3) positions after the allowed part, in the precision of the mesh; the very bits of the old ones
            where a move was refused.
        fraction: (V,) float64 how much of each vertex's move is allowed: 1, 1/2, 1/4, ... or 0.
        halved: () int64, number of vertices that move by a part of what was proposed only.
        refused: () int64, number of vertices that were to move, but stay.
    """

    vertices: torch.Tensor
    fraction: torch.Tensor
    halved: torch.Tensor
    refused: torch.Tensor


def measure(mesh: TetMesh) -> CellShapes:
    """Volumes and qualities that moves are judged against.

    Args:
        mesh: The mesh before it moves.

    Returns:
        Its cells' shapes.
    """
    scale = length_scale(mesh.vertices)
    return CellShapes(scale, *measure_cells(corner_columns(mesh.topology), scaled_points(mesh.vertices, scale)))


def cap_move(move: torch.Tensor, altitudes: torch.Tensor, fraction: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Shortens moves that are longer than a fraction of the smallest altitude around their vertex.

    Args:
        move: (V, 3) proposed moves in units of length.
        altitudes: (V,) smallest altitude of the cells around each vertex.
        fraction: Longest move in altitudes; as long as it is below 1/4, all volumes stay positive.

    Returns:
        The (V, 3) moves in the same directions, and () int64 how many were shortened.
    """
    longest = fraction * altitudes.to(move.dtype)
    # The largest component as the unit: squares of very long moves would overflow, of very short ones vanish.
    unit = move.abs().amax(1).clamp_min(torch.finfo(move.dtype).tiny)
    length = unit * torch.linalg.vector_norm(move / unit[:, None], dim=1)
    too_long = length > longest
    return torch.where(too_long[:, None], move * (longest / length)[:, None], move), too_long.sum()


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
    finite = torch.isfinite(new).all(1)
    new = torch.where(finite[:, None], new, old)
    moving = (new != old).any(1)
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

    refused = (halvings > limits.halvings) | ~finite
    fraction = torch.where(refused, 0.0, torch.exp2(-halvings.double()))
    return GuardedMove(new, fraction, ((halvings > 0) & ~refused).sum(), refused.sum())


def _bad_cells(
    topology: Topology, points: torch.Tensor, limits: MotionLimits, before: CellShapes, cells: torch.Tensor | None
) -> torch.Tensor:
    """Indices of the bad ones among some cells, None for all."""
    corners = corner_columns(topology)
    if cells is not None:
        corners = corners.index_select(1, cells)
    determinant, quality = measure_cells(corners, points)
    old_determinant, old_quality = before.determinants, before.qualities
    if cells is not None:
        old_determinant, old_quality = old_determinant[cells], old_quality[cells]
    well_shaped = (quality >= limits.quality) | ((quality >= old_quality) & (quality > _CERTAIN_QUALITY))
    # Comparisons with NaN are false, so what cannot be computed is bad.
    bad = true_indices(~(well_shaped & (determinant >= limits.volume_ratio * old_determinant)))
    return bad if cells is None else cells[bad]
