"""Fit the float32 constants of the exact optics and print the module that holds them.

    python scripts/fit_optics_coefficients.py > src/difftetvr/optics/coefficients.py
    ruff format src/difftetvr/optics/coefficients.py

Polynomials: least squares on Chebyshev points, reweighted until the largest error is smallest (Lawson). Quadrature
rule: nodes and weights together by Levenberg-Marquardt, reweighted likewise (a generalised Gauss rule for the family of
transmittances that thick cells have). The largest errors go to standard error. Takes some seconds.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import least_squares

THIN = 1.5
VISIBLE = 22.0
RULE_NODES = 9
#: Relative errors of the integrals of T, x T and x^2 T that weigh the same in the fit of the rule.
RULE_TOLERANCES = (3e-8, 6e-7, 1.5e-6)

Array = np.ndarray
_GAUSS = tuple(
    (points + shift) / 2 for points, shift in zip(np.polynomial.legendre.leggauss(80), (1.0, 0.0), strict=True)
)


def integrate(function: Callable[[Array], Array]) -> Array:
    """Integral over [0, 1] along the last axis."""
    return np.sum(function(_GAUSS[0]) * _GAUSS[1], axis=-1)


def lawson(basis: Array, values: Array, scale: Array) -> tuple[Array, float]:
    """Coefficients whose largest error relative to ``scale`` is (nearly) the smallest possible, and that error."""
    column = np.abs(basis).max(axis=0)
    weight = np.ones_like(values)
    best, smallest = np.zeros(basis.shape[1]), np.inf
    for _ in range(300):
        root = np.sqrt(weight) / scale
        found = np.linalg.lstsq(basis / column * root[:, None], values * root, rcond=None)[0] / column
        error = np.abs((basis @ found - values) / scale)
        if error.max() < smallest:
            best, smallest = found, float(error.max())
        weight *= error / error.max() + 1e-3
        weight /= weight.max()
    return best, smallest


def fit_univariate(name: str, function: Callable[[Array], Array], upper: float, degree: int) -> list[float]:
    """Minimax polynomial on [0, upper] with respect to relative error."""
    x = upper * (1.0 - np.cos(np.linspace(0.0, np.pi, 200))) / 2.0 + 1e-9
    values = function(x)
    coefficients, error = lawson(x[:, None] ** np.arange(degree + 1), values, np.abs(values))
    print(f"{name}: relative error {error:.1e}", file=sys.stderr)
    return coefficients.tolist()


def fit_bivariate(name: str, function: Callable[[Array, Array], Array], counts: Sequence[int]) -> list[list[float]]:
    """Minimax polynomial in tau^2 and v over |v| <= tau <= THIN; ``counts[k]`` coefficients go with ``v^k``."""
    tau = THIN * (1.0 - np.cos(np.linspace(0.0, np.pi, 60))) / 2.0 + 1e-6
    tau, slope = (grid.ravel() for grid in np.meshgrid(tau, np.cos(np.linspace(0.0, np.pi, 60))))
    v = tau * slope
    values = function(tau[:, None], v[:, None])
    basis = np.stack([tau ** (2 * j) * v**k for k, count in enumerate(counts) for j in range(count)], axis=1)
    coefficients, error = lawson(basis, values, np.ones_like(values))
    print(f"{name}: absolute error {error:.1e} of {values.max():.3f}", file=sys.stderr)
    return [row.tolist() for row in np.split(coefficients, np.cumsum(counts)[:-1])]


def fit_rule() -> tuple[list[float], list[float]]:
    """Nodes and weights on [0, 1] for ``x^k exp(-(a x + v x^2))``, k = 0, 1, 2, of optical depth THIN to VISIBLE."""
    tau = np.exp(np.linspace(np.log(THIN), np.log(VISIBLE), 24))
    tau, slope = (grid.ravel() for grid in np.meshgrid(tau, np.sin(np.linspace(-np.pi / 2, np.pi / 2, 17))))
    v = (tau * slope)[:, None]
    a = tau[:, None] - v

    def moments(x: Array, weights: Array) -> Array:
        transmittance = np.exp(np.minimum(-(a + v * x) * x, 50.0)) * weights
        return np.concatenate([(transmittance * x**k).sum(axis=1) for k in range(3)])

    exact = moments(*_GAUSS) * np.repeat(RULE_TOLERANCES, len(tau))
    target = moments(*_GAUSS) / exact
    points, weights = np.polynomial.legendre.leggauss(RULE_NODES)
    points, weights = (points + 1.0) / 2.0, weights / 2.0
    # Start from a rule with more nodes where T is large.
    rule = np.concatenate([points * (0.4 + 0.6 * points), weights * (0.4 + 1.2 * points)])
    best, smallest, importance = rule, np.inf, np.ones_like(exact)
    for _ in range(20):
        root = np.sqrt(importance)
        rule = least_squares(
            lambda p, root=root: (moments(p[:RULE_NODES], p[RULE_NODES:]) / exact - target) * root,
            rule,
            method="lm",
            x_scale=np.abs(rule),
            max_nfev=4000,
        ).x
        error = np.abs(moments(rule[:RULE_NODES], rule[RULE_NODES:]) / exact - target)
        if error.max() < smallest:
            best, smallest = rule, float(error.max())
        importance *= (error / error.max() + 0.02) ** 0.7
        importance /= importance.max()
    print("rule: relative errors", *(f"{smallest * t:.1e}" for t in RULE_TOLERANCES), file=sys.stderr)
    order = np.argsort(best[:RULE_NODES])
    return best[:RULE_NODES][order].tolist(), best[RULE_NODES:][order].tolist()


def rounded(values: Sequence[float]) -> str:
    """Nine significant digits: enough to tell any two float32 apart."""
    return tuple_of([f"{value:.9g}" for value in values])


def tuple_of(items: Sequence[str]) -> str:
    """Source of a tuple."""
    return f"({items[0]},)" if len(items) == 1 else f"({', '.join(items)})"


def main() -> None:
    """Fit everything and print the module."""
    square = THIN**2

    def sinh_over_tau(x: Array) -> Array:
        return np.sinh(np.sqrt(x) / 2.0) / np.sqrt(x)

    def p(x: Array) -> Array:
        half_tau = np.sqrt(x)[:, None] / 2.0
        return integrate(lambda y: half_tau * y * np.sinh(half_tau * y)) / x

    def u(tau: Array, v: Array) -> Array:
        return integrate(lambda x: (y := x - 0.5) * np.sinh(tau * y) / tau * np.exp(v * (0.25 - y * y)))

    def n(tau: Array, v: Array) -> Array:
        return integrate(lambda x: np.cosh(tau * (y := x - 0.5)) * (q := 0.25 - y * y) * np.exp(v * q))

    counts = (3, 3, 2, 2, 1)
    nodes, weights = fit_rule()
    tables = {
        "H": rounded(fit_univariate("H", lambda x: np.exp(-x / 2.0), THIN, 5)),
        "SINH": rounded(fit_univariate("SINH", sinh_over_tau, square, 3)),
        "P": rounded(fit_univariate("P", p, square, 2)),
        "U": tuple_of([rounded(row) for row in fit_bivariate("U", u, counts)]),
        "N": tuple_of([rounded(row) for row in fit_bivariate("N", n, counts)]),
        "NODES": rounded(nodes),
        "WEIGHTS": rounded(weights),
    }
    print('"""Constants of the float32 optics, from scripts/fit_optics_coefficients.py; not to be edited by hand."""')
    print(f"\nTHIN = {THIN}\nVISIBLE = {VISIBLE}")
    for name, value in tables.items():
        print(f"{name} = {value}")


if __name__ == "__main__":
    main()
