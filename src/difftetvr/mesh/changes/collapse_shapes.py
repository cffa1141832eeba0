"""What half-edge collapses do to the shapes of cells, a candidate a lane (Dr.Jit kernel)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend, get_backend
from difftetvr.mesh import quality
from difftetvr.mesh.shapes import length_scale, measured, position, scaled_points
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.lookup import Stars, is_corner
from difftetvr.recording import replayed


@dataclass
class Collapses:
    """Half-edge collapses as kernels read them, a candidate a lane, flat.

    Attributes:
        backend: Array types, float64.
        removed, kept: (N,) vertices.
        stars: The cells around vertices.
        points: (V, 4) positions in a unit in which no product overflows, and padding.
    """

    backend: Backend
    removed: Any
    kept: Any
    stars: Stars
    points: Any

    @staticmethod
    def of(backend: Backend, mesh: TetMesh, removed: torch.Tensor, kept: torch.Tensor) -> Collapses:
        """Upload collapses of (N,) vertices into (N,) others."""
        points = backend.floats(scaled_points(mesh.vertices, length_scale(mesh.vertices)))
        stars = Stars.of(backend, mesh.topology)
        return Collapses(backend, backend.uints(removed), backend.uints(kept), stars, points)

    def star(self) -> tuple[Any, Any]:
        """First of the places that stand for the cells around the removed vertex, and the one behind the last."""
        return self.stars.around(self.removed)

    def tet(self, place: Any) -> tuple[Any, Any]:
        """Vertices of the cell at a place, and whether it vanishes."""
        tet = self.stars.tet(place)
        return tet, is_corner(tet, self.kept)

    def position(self, vertex: Any) -> list[Any]:
        """Position of a vertex."""
        return position(self.backend, self.points, vertex)


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
    removed, kept = half_edges.t().contiguous()
    backend = get_backend(str(mesh.vertices.device), torch.float64)
    with backend.exclusive():
        collapses = Collapses.of(backend, mesh, removed, kept)
        keeps, vanishing = replayed(_keeps_shapes, collapses, backend.opaque(max(min_quality, quality.FLAT)))
        return backend.tensor(keeps) > 0, backend.tensor(vanishing).long()


def _keeps_shapes(collapses: Collapses, floor: Any) -> tuple[Any, Any]:
    """Whether cells stay good, 1 or 0, and how many vanish."""
    backend, lanes = collapses.backend, dr.width(collapses.removed)
    begin, end = collapses.star()
    there = collapses.position(collapses.kept)

    def look(place: Any, worst: Any, worst_before: Any, vanishing: Any) -> tuple[Any, Any, Any, Any]:
        tet, vanishes = collapses.tet(place)
        before = [collapses.position(tet[k]) for k in range(4)]
        after = [
            [dr.select(tet[k] == collapses.removed, new, old) for new, old in zip(there, before[k], strict=True)]
            for k in range(4)
        ]
        # What cannot be computed is as bad as can be.
        now, old = (dr.select(dr.isfinite(q), q, -dr.inf) for q in (_quality(after), _quality(before)))
        return (
            place + 1,
            dr.select(~vanishes & (now < worst), now, worst),
            dr.select(old < worst_before, old, worst_before),
            vanishing + dr.select(vanishes, backend.Int(1), backend.Int(0)),
        )

    most = [dr.full(backend.Float, dr.inf, lanes) for _ in range(2)]
    state = (begin, *most, dr.zeros(backend.Int, lanes))
    _, worst, worst_before, vanishing = dr.while_loop(state, lambda place, *_: place < end, look)
    keeps = (worst >= floor) | ((worst > quality.FLAT) & (worst >= worst_before))
    result = dr.select(keeps, backend.Int(1), backend.Int(0))
    dr.eval(result, vanishing)
    return result, vanishing


def _quality(corners: list[list[Any]]) -> Any:
    first, *others = corners
    a, b, c = ([x - y for x, y in zip(other, first, strict=True)] for other in others)
    return measured(a, b, c)[1]
