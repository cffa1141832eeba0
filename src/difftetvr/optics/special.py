"""The integrals behind the optical models, as Dr.Jit functions that are accurate for every optical depth.

A crossing is described by ``a = length * s0`` and ``b = length * s1``, or by its optical depth ``tau = (a + b) / 2``
and its slope ``v = (b - a) / 2``, ``|v| <= tau``. The transmittance up to the fraction x is
``T(x) = exp(-(a x + v x^2)) = h exp(-tau y) exp(v (1/4 - y^2))`` with ``y = x - 1/2`` and ``h = exp(-tau / 2)``: about
the middle of the crossing the integrals of T are ``h`` times functions of ``tau^2`` and ``v``, which short polynomials
approximate (thin cells). Where T decays a lot (thick cells) they are evaluated by other means.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from math import factorial, gamma
from typing import Any

import drjit as dr
import numpy as np

from difftetvr.optics import coefficients

#: Optical depth up to which the polynomials of thin cells hold.
THIN = coefficients.THIN


@dataclass(frozen=True)
class _Tables:
    """Constants at one precision.

    Attributes:
        h: ``exp(-tau/2)`` in tau.
        sinh: ``sinh(tau/2) / tau`` in ``tau^2``.
        p: ``(cosh(tau/2) - 2 sinh(tau/2) / tau) / tau^2`` in ``tau^2``.
        u: ``U``, the integral of ``y sinh(tau y) / tau exp(v (1/4 - y^2))``; row k belongs to ``v^k``, in ``tau^2``.
        n: ``N``, the integral of ``(1/4 - y^2) cosh(tau y) exp(v (1/4 - y^2))``, likewise.
        nodes: Nodes in [0, 1] of the quadrature of thick cells.
        weights: Its weights.
        visible: Optical depth at which that quadrature stops.
    """

    h: Sequence[float]
    sinh: Sequence[float]
    p: Sequence[float]
    u: Sequence[Sequence[float]]
    n: Sequence[Sequence[float]]
    nodes: Sequence[float]
    weights: Sequence[float]
    visible: float


def depth_of(length: Any, density: Any) -> Any:
    """Optical depth of a crossing of constant density, or the greatest whose square does not overflow.

    Nothing shows beyond: all light is absorbed where the ray enters, long before.
    """
    return dr.fmin(length * density, 1e150 if dr.type_v(length) == dr.VarType.Float64 else 1e18)


def polynomial(coefficients: Sequence[float], x: Any) -> Any:
    """Polynomial by Horner's rule with fused multiply-adds, lowest coefficient first."""
    result = type(x)(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = dr.fma(result, x, coefficient)
    return result


def bivariate(rows: Sequence[Sequence[float]], x: Any, y: Any) -> Any:
    """Polynomial in x and y; row k holds the coefficients in x of ``y^k``."""
    result = polynomial(rows[-1], x)
    for row in reversed(rows[:-1]):
        result = dr.fma(result, y, polynomial(row, x))
    return result


def thin_weights(a: Any, b: Any) -> tuple[Any, Any, Any]:
    """``(w0, w1, T1)`` of a cell of optical depth at most THIN, with small relative error down to nothing.

    With ``sinh = sinh(tau/2)`` and ``Q = cosh(tau/2) - S``, S the integral of T divided by h, the weights are
    ``h (sinh + Q)`` and ``h (sinh - Q)``; integrating by parts, ``S = 2 sinh / tau + 2 v U``.
    """
    tables = _tables_for(a)
    tau, v = (a + b) * 0.5, (b - a) * 0.5
    square = tau * tau
    h = polynomial(tables.h, tau)
    sinh = tau * polynomial(tables.sinh, square)
    q = dr.fma(square, polynomial(tables.p, square), -2.0 * v * bivariate(tables.u, square, v))
    return h * (sinh + q), h * (sinh - q), dr.fma(-2.0 * h, sinh, 1.0)


def thin_derivatives(a: Any, b: Any) -> tuple[Any, Any, Any, Any, Any]:
    """``(w0, w1, T1, dw0/da, dw0/db)`` of a cell of optical depth at most THIN.

    The derivatives of ``w1 = 1 - T1 - w0`` follow from ``dT1/da = dT1/db = -T1/2``.
    """
    tables = _tables_for(a)
    tau, v = (a + b) * 0.5, (b - a) * 0.5
    square = tau * tau
    h = polynomial(tables.h, tau)
    sinh_over_tau = polynomial(tables.sinh, square)
    sinh = tau * sinh_over_tau
    u = bivariate(tables.u, square, v)
    vu = 2.0 * v * u
    q = dr.fma(square, polynomial(tables.p, square), -vu)
    half_s = dr.fma(0.5, vu, sinh_over_tau)
    along_tau = dr.fma(-tau, u, half_s)
    along_v = bivariate(tables.n, square, v)
    half_h = 0.5 * h
    return (
        h * (sinh + q),
        h * (sinh - q),
        dr.fma(-2.0 * h, sinh, 1.0),
        half_h * (along_tau + along_v),
        half_h * (along_tau - along_v),
    )


def thick_weights(a: Any, b: Any) -> tuple[Any, Any, Any]:
    """``(w0, w1, T1)`` of a cell of optical depth at least THIN."""
    m0, _, _, transmittance = _thick_moments(a, b)
    return 1.0 - m0, m0 - transmittance, transmittance


def thick_derivatives(a: Any, b: Any) -> tuple[Any, Any, Any, Any, Any]:
    """``(w0, w1, T1, dw0/da, dw0/db)`` of a cell of optical depth at least THIN."""
    m0, m1, m2, transmittance = _thick_moments(a, b)
    return 1.0 - m0, m0 - transmittance, transmittance, dr.fma(-0.5, m2, m1), 0.5 * m2


def _thick_moments(a: Any, b: Any) -> tuple[Any, Any, Any, Any]:
    """Integrals of T, x T and x^2 T, and T1.

    One quadrature rule on [0, reach], where ``tau(reach)`` is what is visible: solved for without cancellation, and for
    both signs of v.
    """
    tables = _tables_for(a)
    tau, v = (a + b) * 0.5, (b - a) * 0.5
    hidden = tau > tables.visible
    # The root is the density at ``reach`` times the length; a cell seen whole needs none (and b = 0 would spoil it).
    root = dr.sqrt(dr.fmax(dr.fma(a, a, 4.0 * tables.visible * v), 0.0))
    reach = dr.select(hidden, 2.0 * tables.visible / dr.select(hidden, a + root, 1.0), 1.0)
    slope, curve = -a * reach, -v * reach * reach
    m0 = m1 = m2 = type(a)(0.0)
    for node, weight in zip(tables.nodes, tables.weights, strict=True):
        transmittance = dr.exp(dr.fma(curve, node, slope) * node)
        m0 = dr.fma(transmittance, weight, m0)
        m1 = dr.fma(transmittance, weight * node, m1)
        m2 = dr.fma(transmittance, weight * node * node, m2)
    square = reach * reach
    return m0 * reach, m1 * square, m2 * (square * reach), dr.exp(-tau)


def constant_density(tau: Any) -> tuple[Any, Any, Any, Any]:
    """``(w0, w1, T1, dw0/dtau)`` of a cell of constant density and linear colour, for every optical depth.

    ``dw0/dtau`` is the first moment ``M = (1 - (1 + tau) exp(-tau)) / tau^2`` of T, and ``w1 = tau M``. The closed form
    cancels for small depths; there the polynomials of thin cells serve, at v = 0.
    """
    tables = _tables_for(tau)
    h = dr.exp(-0.5 * tau)
    square = tau * tau
    sinh_over_tau = polynomial(tables.sinh, square)
    moment = h * dr.fma(-tau, polynomial(tables.p, square), sinh_over_tau)
    half_opacity = h * sinh_over_tau * tau
    thick = tau > THIN
    transmittance = dr.select(thick, h * h, dr.fma(-2.0, half_opacity, 1.0))
    closed = dr.fma(-transmittance, 1.0 + tau, 1.0) / dr.select(thick, square, 1.0)
    moment = dr.select(thick, closed, moment)
    w1 = tau * moment
    w0 = dr.select(thick, 1.0 - transmittance, 2.0 * half_opacity) - w1
    return w0, w1, transmittance, moment


def _tables_for(value: Any) -> _Tables:
    # Decided at trace time, by the type of the Dr.Jit array.
    return _double_tables() if dr.type_v(value) == dr.VarType.Float64 else _SINGLE


_SINGLE = _Tables(
    h=coefficients.H,
    sinh=coefficients.SINH,
    p=coefficients.P,
    u=coefficients.U,
    n=coefficients.N,
    nodes=coefficients.NODES,
    weights=coefficients.WEIGHTS,
    visible=coefficients.VISIBLE,
)


@cache
def _double_tables() -> _Tables:
    """Taylor series to the last bit and a Gauss-Legendre rule: slower than the fitted constants, for checking."""
    points, weights = np.polynomial.legendre.leggauss(32)
    return _Tables(
        h=[row[0] for row in _taylor(lambda j, k: (-0.5) ** k / factorial(k) if j == 0 else 0.0)],
        sinh=_taylor(lambda j, k: 0.5 ** (2 * j + 1) / factorial(2 * j + 1) if k == 0 else 0.0)[0],
        p=_taylor(lambda j, k: 0.25 ** (j + 1) * (2 * j + 2) / factorial(2 * j + 3) if k == 0 else 0.0)[0],
        u=_taylor(lambda j, k: _beta_moment(j + 1, k) / factorial(k) / factorial(2 * j + 1)),
        n=_taylor(lambda j, k: _beta_moment(j, k + 1) / factorial(k) / factorial(2 * j)),
        nodes=((points + 1.0) / 2.0).tolist(),
        weights=(weights / 2.0).tolist(),
        visible=44.0,
    )


def _beta_moment(m: int, k: int) -> float:
    """Integral over [-1/2, 1/2] of ``y^(2m) (1/4 - y^2)^k``."""
    return 0.5 ** (2 * m + 2 * k + 1) * gamma(m + 0.5) * gamma(k + 1) / gamma(m + k + 1.5)


def _taylor(term: Callable[[int, int], float]) -> list[list[float]]:
    """Coefficients ``term(j, k)`` of ``tau^(2j) v^k``, without those that do not count in thin cells."""
    rows = []
    for k in range(40):
        row: list[float] = []
        while abs(term(len(row), k)) * THIN ** (2 * len(row) + k) > 1e-18:
            row.append(term(len(row), k))
        if row:
            rows.append(row)
    return rows
