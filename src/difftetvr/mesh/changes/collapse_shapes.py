"""What half-edge collapses do to the shapes of cells, a candidate a lane (Dr.Jit kernel)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend, get_backend
from difftetvr.mesh import quality
from difftetvr.mesh.shapes import length_scale, measured, scaled_points
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.recording import replayed


@dataclass
class _Collapses:
    """What the kernel reads, flat.

    Attributes:
        backend: Array types, float64.
        removed, kept: (N,) vertices.
        tets: (T, 4) vertices of cells.
        offsets, cells: Cells around vertices.
        points: (V, 4) positions, and padding.
        floor: Least quality that cells may get, unless they had less.
    """

    backend: Backend
    removed: Any
    kept: Any
    tets: Any
    offsets: Any
    cells: Any
    points: Any
    floor: Any


def keeps_shapes(mesh: TetMesh, half_edges: torch.Tensor, min_quality: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Which collapses leave good cells, see `difftetvr.mesh.collapse_edges`.

    Args:
        mesh: The mesh.
        half_edges: (N, 2) int32, [vertex to remove, vertex to keep].
        min_quality: Smallest quality of a changed cell, or none worse than before.

    Returns:
        (N,) bool, and (N,) int64 how many cells vanish.
    """
    if not half_edges.shape[0]:
        return torch.zeros_like(half_edges[:, 0], dtype=torch.bool), half_edges[:, 0].long()
    backend = get_backend(str(mesh.vertices.device), torch.float64)
    points = scaled_points(mesh.vertices, length_scale(mesh.vertices))
    removed, kept = half_edges.t().contiguous()
    with backend.exclusive():
        tables = [backend.uints(table) for table in (removed, kept, mesh.tets, *mesh.topology.vertex_cells)]
        removed_, kept_, tets, offsets, cells = tables
        floor = backend.opaque(max(min_quality, quality.FLAT))
        source = _Collapses(backend, removed_, kept_, tets, offsets, cells, backend.floats(points), floor)
        keeps, vanishing = replayed(_keeps_shapes, source)
        return backend.tensor(keeps) > 0, backend.tensor(vanishing).long()


def _keeps_shapes(source: _Collapses) -> tuple[Any, Any]:
    """Whether cells stay good, 1 or 0, and how many vanish."""
    backend, removed, kept = source.backend, source.removed, source.kept
    begin, end = (dr.gather(backend.UInt, source.offsets, removed + k) for k in range(2))
    there = _position(source, kept)

    def look(place: Any, worst: Any, worst_before: Any, vanishing: Any) -> tuple[Any, Any, Any, Any]:
        tet = dr.gather(backend.UInt4, source.tets, dr.gather(backend.UInt, source.cells, place))
        before = [_position(source, tet[k]) for k in range(4)]
        after = [
            [dr.select(tet[k] == removed, new, old) for new, old in zip(there, before[k], strict=True)]
            for k in range(4)
        ]
        vanishes = (tet[0] == kept) | (tet[1] == kept) | (tet[2] == kept) | (tet[3] == kept)
        now, old = _quality(after), _quality(before)
        # What cannot be computed is as bad as can be.
        now, old = (dr.select(dr.isfinite(value), value, -dr.inf) for value in (now, old))
        return (
            place + 1,
            dr.select(~vanishes & (now < worst), now, worst),
            dr.select(old < worst_before, old, worst_before),
            vanishing + dr.select(vanishes, backend.Int(1), backend.Int(0)),
        )

    lanes = dr.width(removed)
    most = [dr.full(backend.Float, dr.inf, lanes) for _ in range(2)]
    state = (begin, *most, dr.zeros(backend.Int, lanes))
    _, worst, worst_before, vanishing = dr.while_loop(state, lambda place, *_: place < end, look)
    keeps = (worst >= source.floor) | ((worst > quality.FLAT) & (worst >= worst_before))
    result = dr.select(keeps, backend.Int(1), backend.Int(0))
    dr.eval(result, vanishing)
    return result, vanishing


def _position(source: _Collapses, vertex: Any) -> list[Any]:
    packet = dr.gather(source.backend.Float4, source.points, vertex)
    return [packet[k] for k in range(3)]


def _quality(corners: list[list[Any]]) -> Any:
    first, *others = corners
    a, b, c = ([x - y for x, y in zip(other, first, strict=True)] for other in others)
    return measured(a, b, c)[1]
