"""What lenses do to coordinates: the models of OpenCV, COLMAP and nerfstudio, their derivatives and their inverse."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from difftetvr.rendering.cameras.lens_models import LENS_MODELS

_NEWTON_STEPS = 40
_CONVERGED = 1e-9
_FOUND = 1e-6  # by which points that were found may miss those that were asked for
_WIDEST = math.radians(89.5)  # of the angles at which folds of lenses that are no fisheyes are looked for
_RADII, _TURNS = 512, 16

Jacobian = tuple[Any, Any, Any, Any]
"""Derivatives du'/du, du'/dv, dv'/du, dv'/dv."""


@dataclass(frozen=True)
class Distortion:
    """What a lens does beyond a pinhole, in the formulas of :class:`difftetvr.LensCamera`.

    Where coefficients are tensors of no dimension, results are differentiable in them.

    Attributes:
        model: One of `LENS_MODELS`.
        coefficients: The first ones of the model, numbers or tensors; those that are left out are 0.
    """

    model: str = "opencv"
    coefficients: tuple[Any, ...] = ()

    @staticmethod
    def named(model: str, values: Mapping[str, float]) -> Distortion:
        """The lens with coefficients by their names in the model; others are 0.

        Args:
            model: One of `LENS_MODELS`.
            values: Coefficients by name.
        """
        names = LENS_MODELS[model].coefficients
        last = max((names.index(name) + 1 for name in values), default=0)
        count = min(count for count in (0, *LENS_MODELS[model].counts) if count >= last)
        return Distortion(model, tuple(float(values.get(name, 0.0)) for name in names[:count]))

    @property
    def values(self) -> dict[str, Any]:
        """Coefficients by their names in the model."""
        return dict(zip(LENS_MODELS[self.model].coefficients, self.coefficients, strict=False))

    @property
    def is_fisheye(self) -> bool:
        """Whether angles are bent, not coordinates in the plane at distance 1."""
        return LENS_MODELS[self.model].is_fisheye

    @property
    def is_none(self) -> bool:
        """Whether the lens is a pinhole."""
        return not self.is_fisheye and not any(self.coefficients)

    @property
    def _terms(self) -> dict[str, Any]:
        return dict(zip(LENS_MODELS[self.model].terms, self.coefficients, strict=False))

    def distort(self, points: torch.Tensor) -> torch.Tensor:
        """(..., 2) where undistorted coordinates, (..., 2), are seen."""
        c = self._terms
        x, y = points.unbind(-1)
        r2 = x * x + y * y
        g, _ = _radial(r2, c)
        p1, p2, s1, s2, s3, s4 = (c.get(name, 0.0) for name in ("p1", "p2", "s1", "s2", "s3", "s4"))
        across = g * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2)
        down = g * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2)
        return torch.stack([across, down], dim=-1)

    def jacobian(self, points: torch.Tensor) -> Jacobian:
        """Derivatives of :meth:`distort` at undistorted coordinates, (..., 2); each is (...)."""
        c = self._terms
        x, y = points.unbind(-1)
        r2 = x * x + y * y
        g, slope = _radial(r2, c)
        p1, p2, s1, s2, s3, s4 = (c.get(name, 0.0) for name in ("p1", "p2", "s1", "s2", "s3", "s4"))
        mixed = 2 * slope * x * y + 2 * (p1 * x + p2 * y)
        across, down = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
        return (
            g + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x + across * x,
            mixed + across * y,
            mixed + down * x,
            g + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x + down * y,
        )

    def keeps_orientation(self, points: torch.Tensor) -> torch.Tensor:
        """(...) bool, whether the lens is one-to-one around undistorted coordinates, neither mirrored nor turned."""
        a, b, c, d = self.jacobian(points)
        return (a * d - b * c > 0) & (a + d > 0)

    def undistort(self, seen: torch.Tensor) -> torch.Tensor:
        """(..., 2) undistorted coordinates of what is seen at (..., 2), by Newton's method; differentiable.

        NaN where the lens cannot have made a point, be it that nothing is seen there or only beyond a fold.
        """
        fixed = Distortion(self.model, tuple(map(_number, self.coefficients)))
        target, found = seen.detach(), seen.detach().clone()
        with torch.no_grad():
            for _ in range(_NEWTON_STEPS):
                residual = fixed.distort(found) - target
                if not bool((residual.abs() > _CONVERGED).any()):
                    break
                found = found - _solved(fixed.jacobian(found), residual)
            is_sound = ((fixed.distort(found) - target).abs() < _FOUND).all(-1) & fixed.keeps_orientation(found)
            is_sound &= found.square().sum(-1) < _fold(fixed) ** 2
            # Where there are none, derivatives must be finite all the same.
            found = torch.where(is_sound[..., None], found, 0.0)
        # One more step that autograd sees: its derivatives are those of the implicit function.
        exact = found - _solved(fixed.jacobian(found), self.distort(found) - seen)
        return torch.where(is_sound[..., None], exact, torch.nan)

    def directions(self, points: torch.Tensor) -> torch.Tensor:
        """(..., 3) unit directions in camera space of undistorted coordinates, (..., 2); differentiable."""
        if not self.is_fisheye:
            return through_plane(points)
        squares = points.square().sum(-1, keepdim=True)
        # Near the axis the quotient is its series, so that it has a derivative there.
        is_near = squares < 1e-12
        theta = torch.where(is_near, 1.0, squares).sqrt()
        quotient = torch.where(is_near, 1.0 - squares / 6.0, torch.sin(theta) / theta)
        cosine = torch.where(is_near, 1.0 - 0.5 * squares, torch.cos(theta))
        return torch.cat([quotient * points, cosine], dim=-1)

    def coordinates(self, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Undistorted coordinates of places in camera space; differentiable.

        Args:
            places: (..., 3).

        Returns:
            (..., 2) coordinates, and (...) the number by which x and y were multiplied: by how much a step across the
            line of sight is enlarged, at most. Of lenses that are no fisheyes it is negative behind the camera.
        """
        across, depth = places[..., :2], places[..., 2]
        if not self.is_fisheye:
            quotient = 1.0 / depth
            return across / depth[..., None], quotient
        squares = across.square().sum(-1)
        is_near = (squares < 1e-12 * depth.square()) & (depth > 0)
        rho = torch.where(is_near, 1.0, squares).sqrt()
        quotient = torch.where(is_near, 1.0 / torch.where(is_near, depth, 1.0), torch.atan2(rho, depth) / rho)
        return quotient[..., None] * across, quotient


def through_plane(points: torch.Tensor) -> torch.Tensor:
    """(..., 3) unit directions through (..., 2) points of the plane at distance 1; differentiable."""
    directions = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)
    return directions / directions.norm(dim=-1, keepdim=True)


@lru_cache(maxsize=1024)
def _fold(lens: Distortion) -> float:
    """Radius beyond which a lens is one-to-one in no direction any more, or has been so before; may be infinite."""
    angles = torch.linspace(0.0, math.pi if lens.is_fisheye else _WIDEST, _RADII + 1, dtype=torch.float64)[1:]
    radii = angles if lens.is_fisheye else torch.tan(angles)
    turns = torch.linspace(0.0, 2.0 * math.pi, _TURNS + 1, dtype=torch.float64)[1:]
    around = torch.stack([torch.cos(turns), torch.sin(turns)], dim=-1)
    folded = ~lens.keeps_orientation(radii[:, None, None] * around).any(dim=1)
    if bool(folded.any()):
        return float(radii[int(folded.int().argmax())])
    return math.pi if lens.is_fisheye else math.inf


def _radial(r2: torch.Tensor, c: Mapping[str, Any]) -> tuple[Any, Any]:
    """The factor g and its derivative by r2."""
    above, above_slope = _series(r2, [c[name] for name in ("k1", "k2", "k3", "k4") if name in c])
    below, below_slope = _series(r2, [c[name] for name in ("d1", "d2", "d3") if name in c])
    g = above / below
    return g, (above_slope - g * below_slope) / below


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


def _number(value: Any) -> float:
    return value.item() if isinstance(value, torch.Tensor) else float(value)


def _solved(jacobian: Jacobian, residual: torch.Tensor) -> torch.Tensor:
    """The step that removes a residual to first order."""
    a, b, c, d = jacobian
    determinant = a * d - b * c
    x, y = residual.unbind(-1)
    return torch.stack([(d * x - b * y) / determinant, (a * y - c * x) / determinant], dim=-1)
