"""The integrals behind the optical models, as Dr.Jit functions that are accurate for every optical depth.

A crossing is described by ``a = length * s0`` and ``b = length * s1``, or by its optical depth ``tau = (a + b) / 2``
and its slope ``v = (b - a) / 2``, ``|v| <= tau``. The transmittance up to the fraction x is
``T(x) = exp(-(a x + v x^2)) = h exp(-tau y) exp(v (1/4 - y^2))`` with ``y = x - 1/2`` and ``h = exp(-tau / 2)``: about
the middle of the crossing the integrals of T are ``h`` times functions of ``tau^2`` and ``v``, which short polynomials
approximate (thin cells). Where T decays a lot (thick cells) they are evaluated by other means.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from math import factorial, gamma
from typing import Any

import drjit as dr
import numpy as np

#: Optical depth up to which the polynomials of thin cells hold.
THIN = 1.0
#: Optical depth beyond which nothing of a cell is seen, at either precision: exp(-44) = 8e-20.
_OPAQUE = 44.0
_QUADRATURE_NODES = 32


def is_double(value: Any) -> bool:
    """Whether a Dr.Jit array holds float64 values; decides at trace time."""
    return bool(dr.type_v(value) == dr.VarType.Float64)


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
    tables = _thin_tables(is_double(a))
    tau, v = (a + b) * 0.5, (b - a) * 0.5
    square = tau * tau
    h = polynomial(tables["h"], tau)
    sinh = tau * polynomial(tables["sinh"], square)
    q = dr.fma(square, polynomial(tables["p"], square), -2.0 * v * bivariate(tables["u"], square, v))
    return h * (sinh + q), h * (sinh - q), dr.fma(-2.0 * h, sinh, 1.0)


def thin_derivatives(a: Any, b: Any) -> tuple[Any, Any, Any, Any, Any]:
    """``(w0, w1, T1, dw0/da, dw0/db)`` of a cell of optical depth at most THIN.

    The derivatives of ``w1 = 1 - T1 - w0`` follow from ``dT1/da = dT1/db = -T1/2``.
    """
    tables = _thin_tables(is_double(a))
    tau, v = (a + b) * 0.5, (b - a) * 0.5
    square = tau * tau
    h = polynomial(tables["h"], tau)
    sinh_over_tau = polynomial(tables["sinh"], square)
    sinh = tau * sinh_over_tau
    u = bivariate(tables["u"], square, v)
    vu = 2.0 * v * u
    q = dr.fma(square, polynomial(tables["p"], square), -vu)
    half_s = dr.fma(0.5, vu, sinh_over_tau)
    along_tau = dr.fma(-tau, u, half_s)
    along_v = bivariate(tables["n"], square, v)
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
    # Gauss-Legendre up to where the optical depth is _OPAQUE: tau(x) = a x + v x^2 solved for x without cancellation.
    tau, v = (a + b) * 0.5, (b - a) * 0.5
    seen = dr.fmin(tau, _OPAQUE)
    root = dr.sqrt(dr.fmax(dr.fma(a, a, 4.0 * v * seen), 0.0))
    reach = dr.select(tau > _OPAQUE, 2.0 * seen / dr.fmax(a + root, 1e-30), 1.0)
    slope, curve = -a * reach, -v * reach * reach
    m0 = m1 = m2 = type(a)(0.0)
    nodes, node_weights = np.polynomial.legendre.leggauss(_QUADRATURE_NODES)
    for node, weight in zip((nodes + 1.0) / 2.0, node_weights / 2.0, strict=True):
        transmittance = dr.exp(dr.fma(curve, node * node, slope * node))
        m0 = dr.fma(transmittance, weight, m0)
        m1 = dr.fma(transmittance, weight * node, m1)
        m2 = dr.fma(transmittance, weight * node * node, m2)
    square = reach * reach
    return m0 * reach, m1 * square, m2 * square * reach, dr.exp(-tau)


def constant_density(tau: Any) -> tuple[Any, Any, Any, Any]:
    """``(w0, w1, T1, dw0/dtau)`` of a cell of constant density and linear colour, for every optical depth.

    ``dw0/dtau`` is the first moment ``M = (1 - (1 + tau) exp(-tau)) / tau^2`` of T, and ``w1 = tau M``.
    """
    transmittance = dr.exp(-tau)
    thick = tau > THIN
    safe = dr.select(thick, tau, 1.0)
    closed = dr.fma(-transmittance, 1.0 + safe, 1.0) / (safe * safe)
    moment = dr.select(thick, closed, polynomial(_constant_table(is_double(tau)), tau))
    w1 = tau * moment
    w0 = tau * polynomial(_constant_table(is_double(tau)), -tau) * transmittance
    w0 = dr.select(thick, 1.0 - transmittance - w1, w0)
    return w0, w1, transmittance, moment


def _beta_moment(m: int, k: int) -> float:
    """Integral over [-1/2, 1/2] of ``y^(2m) (1/4 - y^2)^k``."""
    return 0.5 ** (2 * m + 2 * k + 1) * gamma(m + 0.5) * gamma(k + 1) / gamma(m + k + 1.5)


def _taylor(term: Callable[[int, int], float], tolerance: float) -> list[list[float]]:
    """Coefficients ``term(j, k)`` of ``tau^(2j) v^k`` without those that stay below the tolerance for thin cells."""
    rows = []
    for k in range(24):
        row: list[float] = []
        while abs(term(len(row), k)) * THIN ** (2 * len(row) + k) > tolerance:
            row.append(term(len(row), k))
        if row:
            rows.append(row)
    return rows


@cache
def _thin_tables(double: bool) -> dict[str, Any]:
    tolerance = 1e-18 if double else 3e-9
    return {
        "sinh": _taylor(lambda j, k: 0.5 ** (2 * j + 1) / factorial(2 * j + 1) if k == 0 else 0.0, tolerance)[0],
        "p": _taylor(lambda j, k: 0.25 ** (j + 1) * (2 * j + 2) / factorial(2 * j + 3) if k == 0 else 0.0, tolerance)[
            0
        ],
        "u": _taylor(lambda j, k: _beta_moment(j + 1, k) / factorial(k) / factorial(2 * j + 1), tolerance),
        "n": _taylor(lambda j, k: _beta_moment(j, k + 1) / factorial(k) / factorial(2 * j), tolerance),
    } | {"h": [row[0] for row in _taylor(lambda j, k: (-0.5) ** k / factorial(k) if j == 0 else 0.0, tolerance)]}


@cache
def _constant_table(double: bool) -> list[float]:
    # M(tau) = sum of (-tau)^k (k + 1) / (k + 2)!
    tolerance = 1e-18 if double else 3e-9
    return [
        row[0] for row in _taylor(lambda j, k: (-1.0) ** k * (k + 1) / factorial(k + 2) if j == 0 else 0.0, tolerance)
    ]
