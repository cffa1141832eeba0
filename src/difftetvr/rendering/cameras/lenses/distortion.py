"""What lenses do to coordinates: the models of OpenCV, COLMAP and nerfstudio, their derivatives and their inverse."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from difftetvr.rendering.cameras.lenses.models import LENS_MODELS
from difftetvr.rendering.cameras.lenses.radial import PROFILES, Coefficients, as_tensor

_NEWTON_STEPS = 40
_STEPS_UNSEEN = 8
_CONVERGED = 1e-9
_FOUND = 1e-6  # by which points that were found may miss those that were asked for
_WIDEST = math.radians(89.5)  # of the angles at which folds of lenses that are no fisheyes are looked for
_RADII, _TURNS = 512, 16
_DECENTRED = ("p1", "p2", "s1", "s2", "s3", "s4")

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

    @property
    def _numbers(self) -> Distortion:
        """The same lens with numbers for coefficients, which are waited for once."""
        held = [value for value in self.coefficients if isinstance(value, torch.Tensor)]
        numbers = iter(torch.stack(held).tolist() if held else [])
        return Distortion(
            self.model, tuple(next(numbers) if isinstance(c, torch.Tensor) else float(c) for c in self.coefficients)
        )

    def distort(self, points: torch.Tensor) -> torch.Tensor:
        """(..., 2) where undistorted coordinates, (..., 2), are seen."""
        return self._bent(points)[0]

    def jacobian(self, points: torch.Tensor) -> Jacobian:
        """Derivatives of :meth:`distort` at undistorted coordinates, (..., 2); each is (...)."""
        return self._bent(points)[1]

    def _bent(self, points: torch.Tensor) -> tuple[torch.Tensor, Jacobian]:
        """Where points are seen, and the derivatives of that."""
        lens, c = LENS_MODELS[self.model], self._terms
        x, y = points.unbind(-1)
        g, slope = PROFILES[lens.profile].factor(x * x + y * y, c)
        mixed = 2 * slope * x * y
        seen = torch.stack([g * x, g * y], dim=-1)
        jacobian: Jacobian = (g + 2 * slope * x * x, mixed, mixed, g + 2 * slope * y * y)
        if any(name in c for name in _DECENTRED):
            shift, change = _decentred(seen if lens.is_chained else points, c)
            seen = seen + shift
            moved = _product(change, jacobian) if lens.is_chained else change
            jacobian = tuple(one + other for one, other in zip(jacobian, moved, strict=True))
        if "t1" in c:
            seen, change = _tilted(seen, _tilt(c["t1"], c["t2"], points))
            jacobian = _product(change, jacobian)
        return seen, jacobian

    def keeps_orientation(self, points: torch.Tensor) -> torch.Tensor:
        """(...) bool, whether the lens is one-to-one around undistorted coordinates, neither mirrored nor turned."""
        return _keeps_orientation(self.jacobian(points))

    def undistort(self, seen: torch.Tensor) -> torch.Tensor:
        """(..., 2) undistorted coordinates of what is seen at (..., 2), by Newton's method; differentiable.

        NaN where the lens cannot have made a point, be it that nothing is seen there or only beyond a fold.
        """
        fixed, target = self._numbers, seen.detach()
        with torch.no_grad():
            found = fixed._newton(target)
            ends, jacobian = fixed._bent(found)
            is_sound = ((ends - target).abs() < _FOUND).all(-1) & _keeps_orientation(jacobian)
            is_sound &= found.square().sum(-1) < _fold(fixed) ** 2
            # Where there are none, derivatives must be finite all the same.
            found = torch.where(is_sound[..., None], found, 0.0)
            jacobian = fixed.jacobian(found)
        # One more step that autograd sees: its derivatives are those of the implicit function.
        exact = found - _solved(jacobian, self.distort(found) - seen)
        return torch.where(is_sound[..., None], exact, torch.nan)

    def _newton(self, target: torch.Tensor) -> torch.Tensor:
        """Undistorted coordinates of what is seen at target, where there are any."""
        guess = PROFILES[LENS_MODELS[self.model].profile].guess
        found = target if guess is None else target / guess(target.square().sum(-1), self._terms)[..., None]
        for step in range(_NEWTON_STEPS):
            ends, jacobian = self._bent(found)
            residual = ends - target
            # Whether all have converged is waited for on a GPU, so it is asked for seldom there.
            if (target.is_cpu or step % _STEPS_UNSEEN == _STEPS_UNSEEN - 1) and not bool(
                (residual.abs() > _CONVERGED).any()
            ):
                break
            found = found - _solved(jacobian, residual)
        return found

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


def _decentred(points: torch.Tensor, c: Coefficients) -> tuple[torch.Tensor, Jacobian]:
    """(..., 2) by how much lenses that are not centred, and thin prisms, shift points, and the derivatives of that."""
    p1, p2, s1, s2, s3, s4 = (c.get(name, 0.0) for name in _DECENTRED)
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    across = 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2)
    down = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2)
    mixed = 2 * (p1 * x + p2 * y)
    across_slope, down_slope = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
    return torch.stack([across, down], dim=-1), (
        2 * p1 * y + 6 * p2 * x + across_slope * x,
        mixed + across_slope * y,
        mixed + down_slope * x,
        6 * p1 * y + 2 * p2 * x + down_slope * y,
    )


def _tilt(about_x: Any, about_y: Any, like: torch.Tensor) -> torch.Tensor:
    """(3, 3) map between planes that tilting the sensor by two angles, in radians, makes. Source: OpenCV, calib3d."""
    one, two = (as_tensor(angle, like) for angle in (about_x, about_y))
    sx, cx, sy, cy, zero = one.sin(), one.cos(), two.sin(), two.cos(), torch.zeros_like(one)
    turned = torch.stack([cy, sy * sx, -sy * cx, zero, cx, sx, sy, -cy * sx, cy * cx]).reshape(3, 3)
    depth = turned[2, 2]
    back = torch.stack([depth, zero, -turned[0, 2], zero, depth, -turned[1, 2], zero, zero, torch.ones_like(zero)])
    return back.reshape(3, 3) @ turned


def _tilted(points: torch.Tensor, plane: torch.Tensor) -> tuple[torch.Tensor, Jacobian]:
    """Points of one plane, (..., 2), on another, by a (3, 3) map between them, and the derivatives of that."""
    x, y = points.unbind(-1)
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind() for row in plane.unbind())
    scale = 1.0 / (g * x + h * y + i)
    across, down = (a * x + b * y + c) * scale, (d * x + e * y + f) * scale
    slopes = ((a - across * g), (b - across * h), (d - down * g), (e - down * h))
    one, two, three, four = (slope * scale for slope in slopes)
    return torch.stack([across, down], dim=-1), (one, two, three, four)


def _product(outer: Jacobian, inner: Jacobian) -> Jacobian:
    """Derivatives of one map after another."""
    a, b, c, d = outer
    e, f, g, h = inner
    return a * e + b * g, a * f + b * h, c * e + d * g, c * f + d * h


def _keeps_orientation(jacobian: Jacobian) -> torch.Tensor:
    a, b, c, d = jacobian
    return (a * d - b * c > 0) & (a + d > 0)


def _solved(jacobian: Jacobian, residual: torch.Tensor) -> torch.Tensor:
    """The step that removes a residual to first order."""
    a, b, c, d = jacobian
    determinant = a * d - b * c
    x, y = residual.unbind(-1)
    return torch.stack([(d * x - b * y) / determinant, (a * y - c * x) / determinant], dim=-1)
