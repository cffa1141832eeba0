"""Cameras with lenses that bend straight lines: photographs need not be resampled."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch

from difftetvr.errors import CameraError, shown
from difftetvr.inputs import as_reals
from difftetvr.rendering.cameras.pinhole import Camera, through_plane
from difftetvr.rendering.cameras.rigid import pencil

if TYPE_CHECKING:
    from difftetvr.rendering.rays import Rays

_NEWTON_STEPS = 40
_CONVERGED = 1e-9

_ORDERS = {
    "opencv": ("k1", "k2", "p1", "p2", "k3", "d1", "d2", "d3", "s1", "s2", "s3", "s4"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "thin-prism-fisheye": ("k1", "k2", "p1", "p2", "k3", "k4", "s1", "s3"),
}
_COUNTS = {"opencv": (2, 4, 5, 8, 12), "fisheye": (1, 2, 4), "thin-prism-fisheye": (8,)}

LENS_MODELS = tuple(_ORDERS)


@dataclass(frozen=True)
class LensCamera(Camera):
    """A camera whose lens distorts, of the models of OpenCV, COLMAP and nerfstudio.

    A direction (x, y, z) of camera space has the undistorted coordinates (u, v) = (x / z, y / z); with a fisheye's
    (u, v) = theta (x, y) / rho, theta being its angle with the axis and rho the length of (x, y). With
    r2 = u^2 + v^2 and

        g = (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) / (1 + d1 r2 + d2 r2^2 + d3 r2^3)

    it is seen at the pixel (fx u' + cx, fy v' + cy), where

        u' = g u + 2 p1 u v + p2 (r2 + 2 u^2) + s1 r2 + s2 r2^2
        v' = g v + p1 (r2 + 2 v^2) + 2 p2 u v + s3 r2 + s4 r2^2

    The order of the coefficients is that of the model's own source: ``"opencv"`` has k1, k2, p1, p2, k3, then d1, d2,
    d3 (called k4, k5, k6 there), then s1 to s4, and 2, 4, 5, 8 or 12 of them; ``"fisheye"`` has 1, 2 or 4 of k1 to k4;
    ``"thin-prism-fisheye"`` has COLMAP's k1, k2, p1, p2, k3, k4, sx1 (s1), sy1 (s3). COLMAP's SIMPLE_RADIAL, RADIAL,
    OPENCV and FULL_OPENCV are ``"opencv"``, its models of fisheyes are the others. Sources: OpenCV's manual, modules
    calib3d and fisheye; https://colmap.github.io/cameras.html.

    Attributes:
        model: One of `LENS_MODELS`.
        coefficients: (N,) as above; images are differentiable in them.

    Raises:
        CameraError: As of `Camera`, or the model is unknown, or has another number of coefficients.
    """

    model: str = "opencv"
    coefficients: torch.Tensor = field(default_factory=lambda: torch.zeros(2))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.model, str) or self.model not in _ORDERS:
            raise CameraError(f"There is no lens model {shown(self.model)}; choose one of {', '.join(LENS_MODELS)}.")
        values = as_reals(self.coefficients, "The lens's coefficients", CameraError).reshape(-1)
        if len(values) not in _COUNTS[self.model]:
            counts = " or ".join(str(count) for count in _COUNTS[self.model])
            raise CameraError(f"The lens has {len(values)} coefficients; the model '{self.model}' takes {counts}.")
        if not bool(torch.isfinite(values.detach()).all()):
            raise CameraError("A coefficient of the lens is not finite; give finite numbers.")
        object.__setattr__(self, "coefficients", values)

    def ray_directions(self) -> torch.Tensor:
        """(H, W, 3) unit directions of the pixels' rays in camera space, float64; differentiable in all parameters.

        NaN where the lens cannot have made a pixel.
        """
        return _directions(self._undistorted(self.plane_points()), "fisheye" in self.model)

    def rays(self) -> Rays:
        """The rays of all pixels in world space, (H, W); of pixels that the lens cannot have made nothing is seen."""
        from difftetvr.rendering.rays import Rays  # late: it needs cameras' errors, not cameras

        seen = self.ray_directions()
        known = torch.isfinite(seen.detach()).all(-1)
        seen = torch.where(known[..., None], seen, seen.new_tensor([0.0, 0.0, 1.0]))
        origins, directions = pencil(self.world_to_camera, seen)
        return Rays(origins, directions, 0.0, torch.where(known, math.inf, 0.0).to(directions.device))

    def _undistorted(self, seen: torch.Tensor) -> torch.Tensor:
        """(H, W, 2) undistorted coordinates, by Newton's method; NaN where there are none."""
        names = _ORDERS[self.model]
        c = dict(zip(names, self.coefficients.double().cpu().unbind(), strict=False))
        fixed = {name: value.detach() for name, value in c.items()}
        target, found = seen.detach(), seen.detach().clone()
        with torch.no_grad():
            for _ in range(_NEWTON_STEPS):
                residual = _distorted(found, fixed) - target
                if not bool((residual.abs() > _CONVERGED).any()):
                    break
                found = found - _solved(_jacobian(found, fixed), residual)
            jacobian = _jacobian(found, fixed)
            determinant = jacobian[0] * jacobian[3] - jacobian[1] * jacobian[2]
            is_sound = ((_distorted(found, fixed) - target).abs() < 1e-6).all(-1) & (determinant > 0)
            if "fisheye" in self.model:
                is_sound &= found.square().sum(-1) < math.pi**2
        # One more step that autograd sees: its derivatives are those of the implicit function.
        exact = found - _solved(jacobian, _distorted(found, c) - seen)
        return torch.where(is_sound[..., None], exact, torch.nan)


def _series(r2: torch.Tensor, factors: list[torch.Tensor | None]) -> tuple[torch.Tensor, torch.Tensor]:
    """1 + f1 r2 + f2 r2^2 + ..., and its derivative by r2."""
    value, slope, power = torch.ones_like(r2), torch.zeros_like(r2), torch.ones_like(r2)
    for order, factor in enumerate(factors, 1):
        if factor is not None:
            slope = slope + order * factor * power
            value = value + factor * power * r2
        power = power * r2
    return value, slope


def _radial(r2: torch.Tensor, c: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """The factor g and its derivative by r2."""
    above, above_slope = _series(r2, [c.get(name) for name in ("k1", "k2", "k3", "k4")])
    below, below_slope = _series(r2, [c.get(name) for name in ("d1", "d2", "d3")])
    g = above / below
    return g, (above_slope - g * below_slope) / below


def _distorted(points: torch.Tensor, c: dict[str, torch.Tensor]) -> torch.Tensor:
    """(..., 2) where undistorted coordinates are seen."""
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    g, _ = _radial(r2, c)
    p1, p2, s1, s2, s3, s4 = (c.get(name, 0.0) for name in ("p1", "p2", "s1", "s2", "s3", "s4"))
    across = g * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2)
    down = g * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2)
    return torch.stack([across, down], dim=-1)


def _jacobian(points: torch.Tensor, c: dict[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
    """Derivatives du'/du, du'/dv, dv'/du, dv'/dv."""
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


def _solved(jacobian: tuple[torch.Tensor, ...], residual: torch.Tensor) -> torch.Tensor:
    """The step that removes a residual to first order."""
    a, b, c, d = jacobian
    determinant = a * d - b * c
    x, y = residual.unbind(-1)
    return torch.stack([(d * x - b * y) / determinant, (a * y - c * x) / determinant], dim=-1)


def _directions(points: torch.Tensor, is_fisheye: bool) -> torch.Tensor:
    """(..., 3) unit directions of undistorted coordinates."""
    if not is_fisheye:
        return through_plane(points)
    squares = points.square().sum(-1, keepdim=True)
    # Near the axis the quotient is its series, so that it has a derivative there.
    is_near = squares < 1e-12
    theta = torch.where(is_near, 1.0, squares).sqrt()
    quotient = torch.where(is_near, 1.0 - squares / 6.0, torch.sin(theta) / theta)
    cosine = torch.where(is_near, 1.0 - 0.5 * squares, torch.cos(theta))
    return torch.cat([quotient * points, cosine], dim=-1)
