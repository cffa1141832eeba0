"""Constant density and linear colour along a crossing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.optics.model import Adjoint, Weights
from difftetvr.optics.special import constant_density, depth_of


@dataclass(frozen=True)
class ConstantPerCell:
    """One density per cell (article, appendix 12, which has one colour as well: ``c0 == c1``).

    Only the density at the entry is read; the caller guarantees that the one at the exit equals it, and the adjoint
    reports the whole derivative as ``d_s0`` and zero as ``d_s1``.
    """

    def weights(self, length: Any, s0: Any, s1: Any) -> Weights:
        """See :meth:`OpticalModel.weights`."""
        w0, w1, transmittance, _ = constant_density(depth_of(length, s0))
        return w0, w1, transmittance

    def adjoint(self, length: Any, s0: Any, s1: Any, g0: Any, g1: Any, gt: Any) -> Adjoint:
        """See :meth:`OpticalModel.adjoint`."""
        w0, w1, transmittance, moment = constant_density(depth_of(length, s0))
        d_tau = dr.fma(g0 - g1, moment, dr.fma(g1, transmittance, -gt))
        return w0, w1, transmittance, s0 * d_tau, length * d_tau, type(d_tau)(0.0)
