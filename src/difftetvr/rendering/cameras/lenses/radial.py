"""How far from the principal point lenses put things: the factor g of each family, its derivative, and a guess back.

Each function takes (...) squares r2 of radii and coefficients by their names, numbers or tensors of no dimension, in
which its results are differentiable.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

Coefficients = Mapping[str, Any]

_NEAR = 1e-3  # below which squares of arguments have the arctangent's series instead of itself
_SERIES = (1.0, -1.0 / 3.0, 1.0 / 5.0, -1.0 / 7.0, 1.0 / 9.0, -1.0 / 11.0)
_NARROW = 1e-4  # radians below which a field of view has the tangent's series


@dataclass(frozen=True)
class Profile:
    """A family of radial functions: what is at radius r is seen at g(r^2) r.

    Attributes:
        factor: (...) g of (...) squares of radii, and (...) its derivative by the squares.
        guess: (...) by what to divide radii that are seen for a start of Newton's method, of their (...) squares; None
            for nothing.
    """

    factor: Callable[[torch.Tensor, Coefficients], tuple[Any, Any]]
    guess: Callable[[torch.Tensor, Coefficients], torch.Tensor] | None


def as_tensor(value: Any, like: torch.Tensor) -> torch.Tensor:
    """A coefficient as a tensor beside others."""
    return value if isinstance(value, torch.Tensor) else like.new_tensor(value)


def rational(r2: torch.Tensor, c: Coefficients) -> tuple[Any, Any]:
    """(1 + k1 r2 + ... + k6 r2^6) / (1 + d1 r2 + d2 r2^2 + d3 r2^3), by the names of `LensModel.terms`."""
    above, above_slope = _series(r2, [c[name] for name in ("k1", "k2", "k3", "k4", "k5", "k6") if name in c])
    below, below_slope = _series(r2, [c[name] for name in ("d1", "d2", "d3") if name in c])
    g = above / below
    return g, (above_slope - g * below_slope) / below


def field_of_view(r2: torch.Tensor, c: Coefficients) -> tuple[Any, Any]:
    """atan(2 r tan(omega / 2)) / (r omega), of Devernay and Faugeras, Straight lines have to be straight, 2001."""
    omega = as_tensor(c.get("omega", 0.0), r2)
    is_narrow = omega.abs() < _NARROW
    widened = torch.where(is_narrow, 1.0, omega)
    share = torch.where(is_narrow, 1.0 + omega.square() / 12.0, 2.0 * torch.tan(0.5 * widened) / widened)
    bend = (share * omega).square()
    z = bend * r2
    is_near = z < _NEAR
    root = torch.where(is_near, 1.0, z).sqrt()
    quotient = torch.where(is_near, _polynomial(z, _SERIES), torch.atan(root) / root)
    far_slope = (1.0 / (1.0 + z) - quotient) / (2.0 * torch.where(is_near, 1.0, z))
    near_slope = _polynomial(z, [order * factor for order, factor in enumerate(_SERIES)][1:])
    return share * quotient, share * bend * torch.where(is_near, near_slope, far_slope)


def division(r2: torch.Tensor, c: Coefficients) -> tuple[Any, Any]:
    """2 / (1 + sqrt(1 - 4 k r2)): what is seen at radius s is at s / (1 + k s^2), of Fitzgibbon, 2001."""
    k = as_tensor(c.get("k", 0.0), r2)
    root = (1.0 - 4.0 * k * r2).sqrt()
    g = 2.0 / (1.0 + root)
    return g, k * g.square() / root


def unified(r2: torch.Tensor, c: Coefficients) -> tuple[Any, Any]:
    """1 / (alpha sqrt(1 + beta r2) + 1 - alpha), of Khomutenko et al., An enhanced unified camera model, 2016."""
    alpha, beta = as_tensor(c.get("alpha", 0.0), r2), as_tensor(c.get("beta", 0.0), r2)
    root = (1.0 + beta * r2).sqrt()
    g = 1.0 / (alpha * root + 1.0 - alpha)
    return g, -0.5 * alpha * beta * g.square() / root


def _guess_of_field(s2: torch.Tensor, c: Coefficients) -> torch.Tensor:
    omega, seen = as_tensor(c.get("omega", 0.0), s2), s2.sqrt()
    angle = seen * omega
    return torch.where(angle.abs() < _NARROW, 1.0, 2.0 * seen * (0.5 * omega).tan() / angle.tan())


def _guess_of_division(s2: torch.Tensor, c: Coefficients) -> torch.Tensor:
    return 1.0 + as_tensor(c.get("k", 0.0), s2) * s2


def _guess_of_unified(s2: torch.Tensor, c: Coefficients) -> torch.Tensor:
    alpha, beta = as_tensor(c.get("alpha", 0.0), s2), as_tensor(c.get("beta", 0.0), s2)
    root = (1.0 - (2.0 * alpha - 1.0) * beta * s2).sqrt()
    return (1.0 - alpha * alpha * beta * s2) / (alpha * root + 1.0 - alpha)


PROFILES = {
    "rational": Profile(rational, None),
    "fov": Profile(field_of_view, _guess_of_field),
    "division": Profile(division, _guess_of_division),
    "eucm": Profile(unified, _guess_of_unified),
}
"""Families by name."""


def _series(r2: torch.Tensor, factors: Sequence[Any]) -> tuple[Any, Any]:
    """1 + f1 r2 + f2 r2^2 + ..., and its derivative by r2."""
    slopes = [order * factor for order, factor in enumerate(factors, 1)]
    return _polynomial(r2, [1.0, *factors]), _polynomial(r2, slopes)


def _polynomial(r2: torch.Tensor, factors: Sequence[Any]) -> Any:
    """f0 + f1 r2 + f2 r2^2 + ..."""
    total = factors[-1] if factors else 0.0
    for factor in reversed(factors[:-1]):
        total = total * r2 + factor
    return total
