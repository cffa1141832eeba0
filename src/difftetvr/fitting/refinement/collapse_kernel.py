"""What half-edge collapses would cost, a candidate a lane (Dr.Jit kernel)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import get_backend
from difftetvr.mesh import TetMesh
from difftetvr.mesh.changes.collapse_shapes import Collapses
from difftetvr.mesh.shapes import cross, dot
from difftetvr.recording import replayed
from difftetvr.rendering.gauss_newton import HatDerivatives

_ON_A_FACE = 1e-6  # so far outside of a cell, in barycentric coordinates, a point still counts as inside


@dataclass
class _Prices:
    """What the kernel reads beside the collapses, flat.

    Attributes:
        values: (V, 4) parameters.
        colors: (V, 4) second derivatives by each colour, and mixed ones by colours and density.
        absorption: (V,) second derivatives by density.
    """

    values: Any
    colors: Any
    absorption: Any


def costs_of_collapses(
    mesh: TetMesh, values: torch.Tensor, hats: HatDerivatives, removed: torch.Tensor, kept: torch.Tensor
) -> torch.Tensor:
    """What merging vertices into neighbours would cost, see `difftetvr.fitting.refinement.gains.collapse_costs`.

    Args:
        mesh: The mesh.
        values: (V, 4) parameters.
        hats: Derivatives by the hats of all vertices.
        removed: (N,) vertices that go.
        kept: (N,) the neighbours that take their cells.

    Returns:
        (N,) float64; NaN where no cell would hold the place of the removed vertex.
    """
    if not len(removed):
        return values.new_zeros(0, dtype=torch.float64)
    backend = get_backend(str(mesh.vertices.device), torch.float64)
    colors = torch.cat((hats.emission[:, None], hats.coupling), 1)
    with backend.exclusive():
        collapses = Collapses.of(backend, mesh, removed, kept)
        prices = _Prices(*(backend.floats(table) for table in (values, colors, hats.absorption)))
        return backend.tensor(replayed(_costs, collapses, prices))


def _costs(collapses: Collapses, prices: _Prices) -> Any:
    cost = _Star(collapses, prices).cost()
    dr.eval(cost)
    return cost


class _Star:
    """The cells around a vertex that is merged into another, as they would be."""

    def __init__(self, collapses: Collapses, prices: _Prices) -> None:
        self.collapses, self.prices, self.real = collapses, prices, collapses.backend.Float
        self.first, self.end = collapses.star()
        self.place, self.apex = (collapses.position(vertex) for vertex in (collapses.removed, collapses.kept))
        self.old, self.apex_values = (self._values(vertex) for vertex in (collapses.removed, collapses.kept))

    def cost(self) -> Any:
        """Cost of giving the vertex the value that is interpolated there afterwards, and of the bends."""
        nowhere = dr.full(self.real, -dr.inf, dr.width(self.collapses.removed))

        def find_holder(place: Any, least: Any, after: list[Any]) -> Any:
            corners, is_left = self._corners(place)
            weights, _ = self._weights(corners)
            smallest = dr.fmin(dr.fmin(weights[0], weights[1]), dr.fmin(weights[2], weights[3]))
            is_better = is_left & dr.isfinite(smallest) & (smallest > least)
            here = self._extrapolated(corners, weights)
            return place + 1, dr.select(is_better, smallest, least), _select(is_better, here, after)

        state = (self.first, nowhere, [dr.zeros_like(nowhere) for _ in range(4)])
        _, least, after = dr.while_loop(state, lambda place, *_: place < self.end, find_holder)

        def add_bend(place: Any, bends: Any, volumes: Any) -> Any:
            corners, is_left = self._corners(place)
            weights, volume = self._weights(corners)
            # The old and the new cell at a face overlap down to this share of the way to the apex. There, the other
            # new cells differ from what the hat explains by how much their functions differ, seen from the place.
            side = dr.fmax(dr.fmax(weights[0], weights[1]), dr.fmax(weights[2], 0.0))
            reach = 1.0 / dr.fmax(weights[3] + 3.0 * side, _ON_A_FACE)
            deviation = [reach * (x - y) for x, y in zip(self._extrapolated(corners, weights), after, strict=True)]
            bend = self._curvature(deviation) * volume
            return place + 1, bends + dr.select(is_left, bend, 0.0), volumes + dr.select(is_left, volume, 0.0)

        begin = (self.first, dr.zeros_like(nowhere), dr.zeros_like(nowhere))
        _, bends, volumes = dr.while_loop(begin, lambda place, *_: place < self.end, add_bend)
        own = self._curvature([x - y for x, y in zip(after, self.old, strict=True)])
        return dr.select(least > -_ON_A_FACE, 0.5 * (bends / volumes + own), dr.nan)

    def _values(self, vertex: Any) -> list[Any]:
        return list(dr.gather(self.collapses.backend.Float4, self.prices.values, vertex))

    def _corners(self, place: Any) -> tuple[list[Any], Any]:
        """Vertices of the face opposite the removed vertex, and whether the cell is still there afterwards."""
        tet, vanishes = self.collapses.tet(place)
        # The last corner stands in for the removed one, except where that is the last.
        return [dr.select(tet[k] == self.collapses.removed, tet[3], tet[k]) for k in range(3)], ~vanishes

    def _weights(self, corners: list[Any]) -> tuple[list[Any], Any]:
        """Barycentric coordinates of the place in a new cell, the apex last, and six times the cell's volume."""
        a, b, c = ([x - y for x, y in zip(self.collapses.position(k), self.apex, strict=True)] for k in corners)
        normals = (cross(b, c), cross(c, a), cross(a, b))
        volume = dot(a, normals[0])
        place = [x - y for x, y in zip(self.place, self.apex, strict=True)]
        sides = [dot(place, normal) / volume for normal in normals]
        return [*sides, 1.0 - (sides[0] + sides[1] + sides[2])], dr.abs(volume)

    def _extrapolated(self, corners: list[Any], weights: list[Any]) -> list[Any]:
        """What the linear function of a new cell is at the place."""
        total = [weights[3] * value for value in self.apex_values]
        for corner, weight in zip(corners, weights, strict=False):
            total = [dr.fma(weight, value, t) for value, t in zip(self._values(corner), total, strict=True)]
        return total

    def _curvature(self, step: list[Any]) -> Any:
        """See :meth:`difftetvr.rendering.gauss_newton.HatDerivatives.curvature`."""
        emission, *coupling = dr.gather(self.collapses.backend.Float4, self.prices.colors, self.collapses.removed)
        absorption = dr.gather(self.real, self.prices.absorption, self.collapses.removed)
        color, density = step[:3], step[3]
        return emission * dot(color, color) + density * (absorption * density + 2.0 * dot(coupling, color))


def _select(mask: Any, one: list[Any], other: list[Any]) -> list[Any]:
    return [dr.select(mask, x, y) for x, y in zip(one, other, strict=True)]
