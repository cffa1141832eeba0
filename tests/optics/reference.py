"""What the optical models are held against: mpmath, and graded Gauss-Legendre quadrature in float64."""

from __future__ import annotations

import itertools

import mpmath
import numpy as np

_PANELS = np.concatenate([[0.0], 2.0 ** np.arange(-20, 1)])
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(40)


def quadrature(length: np.ndarray, s0: np.ndarray, s1: np.ndarray) -> dict[str, np.ndarray]:
    """Weights, transmittance and the derivatives of the weights, all integrals of positive functions."""
    length, s0, s1 = (np.asarray(x, dtype=np.float64)[:, None] for x in (length, s0, s1))
    a, b = length * s0, length * s1
    w0 = w1 = w0_a = w0_b = np.zeros(len(length))
    for lower, upper in itertools.pairwise(_PANELS):
        x = lower + (upper - lower) * (_POINTS + 1) / 2
        scale = _WEIGHTS * (upper - lower) / 2
        transmittance = np.exp(-x * (a + (b - a) / 2 * x)) * scale
        emitted = transmittance * (a + (b - a) * x)
        w0, w1 = w0 + (emitted * (1 - x)).sum(1), w1 + (emitted * x).sum(1)
        w0_a, w0_b = w0_a + (transmittance * (x - x * x / 2)).sum(1), w0_b + (transmittance * x * x / 2).sum(1)
    passed = np.exp(-(a + b) / 2)[:, 0]
    length, s0, s1 = length[:, 0], s0[:, 0], s1[:, 0]
    w1_a, w1_b = passed / 2 - w0_a, passed / 2 - w0_b
    return {
        "w0": w0,
        "w1": w1,
        "T1": passed,
        "w0_length": s0 * w0_a + s1 * w0_b,
        "w0_s0": length * w0_a,
        "w0_s1": length * w0_b,
        "w1_length": s0 * w1_a + s1 * w1_b,
        "w1_s0": length * w1_a,
        "w1_s1": length * w1_b,
    }


def exact(length: float, s0: float, s1: float) -> dict[str, float]:
    """The same by the closed form with error functions at a precision that its cancellation cannot spoil."""
    with mpmath.workdps(150):
        length, s0, s1 = mpmath.mpf(length), mpmath.mpf(s0), mpmath.mpf(s1)
        # Nudged apart: the closed form divides by their difference.
        if s0 == s1:
            s1 = s0 * (1 + mpmath.mpf(10) ** -15)

        def psi(x: mpmath.mpf, d0: mpmath.mpf, d1: mpmath.mpf) -> mpmath.mpf:
            u, v = x * d0, x * (d1 - d0) / 2
            root = mpmath.sqrt(v)
            z0, z1 = u / (2 * root), (u + 2 * v) / (2 * root)
            between = mpmath.erfc(z0) - mpmath.erfc(z1) if v > 0 else mpmath.erf(z1) - mpmath.erf(z0)
            return mpmath.re(mpmath.sqrt(mpmath.pi) / (2 * root) * mpmath.exp(z0 * z0) * between)

        u, v, passed = length * s0, length * (s1 - s0) / 2, mpmath.exp(-length * (s0 + s1) / 2)
        m0 = psi(length, s0, s1)
        m1 = (1 - passed - u * m0) / (2 * v)
        m2 = (m0 - passed - u * m1) / (2 * v)
        result = {
            "w0": 1 - m0,
            "w1": m0 - passed,
            "T1": passed,
            "w0_length": s0 * (m1 - m2 / 2) + s1 * m2 / 2,
            "w0_s0": length * (m1 - m2 / 2),
            "w0_s1": length * m2 / 2,
        }
        return {name: float(value) for name, value in result.items()}


def crossings(count: int, seed: int, dtype: type) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lengths and end densities, optical depths from 1e-8 to 1e4: random, zero, equal and nearly equal ends."""
    random = np.random.default_rng(seed)
    depth = 10.0 ** random.uniform(-8, 4, count)
    s0, s1 = random.uniform(0, 1, (2, count))
    kind = random.integers(0, 8, count)
    tiny = 10.0 ** random.uniform(-7, 0, count)
    s0 = np.select([kind == 0, kind == 4], [0.0, s1 * tiny], s0)
    s1 = np.select([kind == 1, kind == 2, kind == 3, kind == 5], [0.0, s0, s0 * (1 + tiny), s0 * tiny], s1)
    length = 2 * depth / (s0 + s1)
    return length.astype(dtype), s0.astype(dtype), s1.astype(dtype)
