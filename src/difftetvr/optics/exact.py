"""Linear density and linear colour along a crossing, integrated exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.optics.model import Adjoint, Weights
from difftetvr.optics.special import (
    THIN,
    depth_of,
    thick_derivatives,
    thick_weights,
    thin_derivatives,
    thin_weights,
)


@dataclass(frozen=True)
class ExactLinear:
    """The emission-absorption integral of linear density and linear colour, without approximation.

    With x in [0, 1] along the crossing, optical depth ``tau(x)`` and ``T(x) = exp(-tau(x))``, integrating
    ``c(x) (-T'(x))`` by parts gives ``w0 = integral of 1 - T`` and ``w1 = integral of T - T1``. Equation (1) of the
    article with the colour parameter running to the end of the segment.
    """

    def weights(self, length: Any, s0: Any, s1: Any) -> Weights:
        """See :meth:`OpticalModel.weights`."""
        a, b = depth_of(length, s0), depth_of(length, s1)
        return dr.if_stmt((a, b), a + b > 2.0 * THIN, thick_weights, thin_weights)

    def adjoint(self, length: Any, s0: Any, s1: Any, g0: Any, g1: Any, gt: Any) -> Adjoint:
        """See :meth:`OpticalModel.adjoint`."""
        a, b = depth_of(length, s0), depth_of(length, s1)
        w0, w1, transmittance, w0_a, w0_b = dr.if_stmt((a, b), a + b > 2.0 * THIN, thick_derivatives, thin_derivatives)
        difference = g0 - g1
        common = 0.5 * dr.fma(g1, transmittance, -gt)
        d_a = dr.fma(difference, w0_a, common)
        d_b = dr.fma(difference, w0_b, common)
        return w0, w1, transmittance, dr.fma(s0, d_a, s1 * d_b), length * d_a, length * d_b
