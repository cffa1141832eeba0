"""The article's approximation: sub-segments of constant density."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.errors import DiffTetError, shown
from difftetvr.inputs import as_whole
from difftetvr.optics.model import Adjoint, Weights
from difftetvr.optics.special import constant_density, depth_of


@dataclass(frozen=True)
class SubSegments:
    """N sub-segments of constant density, taken at their centres, with linear colour (article, Algorithms 1 and 3).

    Unlike the article's equation (2), colour runs over each sub-segment's own length, not over world length.
    The code of the sub-segments is unrolled: compile time grows with their number.

    Attributes:
        count: Number of sub-segments, from 1 to 256.

    Raises:
        DiffTetError: The count is no such number.
    """

    count: int = 4

    def __post_init__(self) -> None:
        count = as_whole(self.count, "The count of SubSegments", DiffTetError)
        if not 1 <= count <= 256:
            raise DiffTetError(f"SubSegments needs a count from 1 to 256, not {shown(count)}.")

    def weights(self, length: Any, s0: Any, s1: Any) -> Weights:
        """See :meth:`OpticalModel.weights`."""
        reached = type(length)(1.0)
        w0 = w1 = type(length)(0.0)
        for i in range(self.count):
            near, far, transmittance, _ = constant_density(self._depth(i, length, s0, s1))
            # Of what the sub-segment sends, the part that is the exit colour of the whole crossing.
            exit_part = dr.fma(near, i / self.count, far * ((i + 1) / self.count))
            w1 = dr.fma(reached, exit_part, w1)
            w0 = dr.fma(reached, near + far - exit_part, w0)
            reached *= transmittance
        return w0, w1, reached

    def adjoint(self, length: Any, s0: Any, s1: Any, g0: Any, g1: Any, gt: Any) -> Adjoint:
        """See :meth:`OpticalModel.adjoint`."""
        w0, w1, transmittance = self.weights(length, s0, s1)
        # From the last sub-segment to the first: ``behind`` is what the ray gathers from a sub-segment's end on, per
        # unit of light that gets there, minus the derivative that the total transmittance brings, kept apart.
        behind = d_length = d_s0 = d_s1 = type(length)(0.0)
        reached = self._prefix_transmittances(length, s0, s1)
        for i in reversed(range(self.count)):
            near, far, passed, moment = constant_density(self._depth(i, length, s0, s1))
            g_near = dr.lerp(g0, g1, i / self.count)
            g_far = dr.lerp(g0, g1, (i + 1) / self.count)
            d_depth = dr.fma(g_near - g_far, moment, passed * (g_far - behind))
            d_depth = dr.fma(reached[i], d_depth, -gt) / self.count
            behind = dr.fma(near, g_near, dr.fma(far, g_far, passed * behind))
            center = (i + 0.5) / self.count
            d_length = dr.fma(d_depth, dr.lerp(s0, s1, center), d_length)
            d_s0 = dr.fma(d_depth, 1.0 - center, d_s0)
            d_s1 = dr.fma(d_depth, center, d_s1)
        return w0, w1, transmittance, d_length, length * d_s0, length * d_s1

    def _depth(self, i: int, length: Any, s0: Any, s1: Any) -> Any:
        return depth_of(length, dr.lerp(s0, s1, (i + 0.5) / self.count)) / self.count

    def _prefix_transmittances(self, length: Any, s0: Any, s1: Any) -> list[Any]:
        result = [type(length)(1.0)]
        for i in range(self.count - 1):
            result.append(result[-1] * dr.exp(-self._depth(i, length, s0, s1)))
        return result
