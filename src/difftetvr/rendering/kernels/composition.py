"""From what rays gather to what callers get, and the derivatives on the way back (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend

_THIN = 1.0  # optical depth up to which one minus the transmittance would lose digits


@dataclass
class Composition:
    """How an image is composed.

    Attributes:
        background: (C,) channels behind the volume; None for 0.
        shift: (N,) how far kernels' origins are from the rays' true ones, in world units; None where they are these.
        unit: Unit of length of kernels, in world units.
    """

    background: Any | None
    shift: Any | None
    unit: float


def opacity(optical_depth: Any) -> Any:
    """One minus the transmittance, with all digits of a small one."""
    half = 0.5 * optical_depth
    thin = 2.0 * dr.sinh(dr.fmin(half, _THIN)) * dr.exp(-half)
    return dr.select(optical_depth < _THIN, thin, 1.0 - dr.exp(-optical_depth))


def expected_distance(distance: Any, alpha: Any, shift: Any, unit: float) -> Any:
    """Mean distance from the true origin at which light is absorbed, in world units; 0 where none is.

    Args:
        distance: Integral of the distance from the kernels' origin.
        alpha: Opacity.
        shift: How far that origin is from the true one, in world units.
        unit: Unit of the integral, in world units.
    """
    return dr.select(alpha > 0, distance * unit / dr.select(alpha > 0, alpha, 1.0) + shift, 0.0)


@dataclass
class Pixels:
    """An image, as flat arrays: (N, C) channels, (N,) opacity, expected distance and optical depth."""

    color: Any
    alpha: Any
    depth: Any
    optical_depth: Any

    @staticmethod
    def empty(real: Any, channels: int, count: int) -> Pixels:
        """Room for an image."""
        return Pixels(*(dr.empty(real, size) for size in (max(channels, 1) * count, count, count, count)))

    def write(
        self, backend: Backend, how: Composition, gathered: tuple[list[Any], Any, Any], pixel: Any, valid: Any
    ) -> None:
        """Store what some rays have gathered: channels, integral of the distance and optical depth."""
        channels, distance, optical_depth = gathered
        real = backend.Float
        alpha, transmittance = opacity(optical_depth), dr.exp(-optical_depth)
        if how.background is not None:
            behind = (dr.gather(real, how.background, type(pixel)(k)) for k in range(len(channels)))
            channels = [dr.fma(transmittance, b, c) for b, c in zip(behind, channels, strict=True)]
        if channels:
            dr.scatter(self.color, backend.Floats(channels), pixel, valid)
        shift = real(0) if how.shift is None else real(dr.gather(type(how.shift), how.shift, pixel, valid))
        dr.scatter(self.alpha, alpha, pixel, valid)
        dr.scatter(self.depth, expected_distance(distance, alpha, shift, how.unit), pixel, valid)
        dr.scatter(self.optical_depth, optical_depth, pixel, valid)


@dataclass
class PixelAdjoint:
    """Derivatives of the loss with respect to what one ray gathers; ``distance`` is None where it does not depend."""

    color: list[Any]
    optical_depth: Any
    distance: Any | None


def pixel_adjoint(
    image: Pixels, how: Composition, channels: int, gathered: tuple[Any, Any], pixel: Any, valid: Any
) -> PixelAdjoint:
    """Derivatives with respect to what rays gather, from those with respect to the image.

    Args:
        image: Derivatives of the loss; None for those that are 0.
        how: How the image was composed.
        channels: Number of channels.
        gathered: Optical depth of each ray, and its integral of the distance.
        pixel: Numbers of the rays.
        valid: Which of them there are.
    """
    optical_depth, distance = gathered
    real, transmittance = type(optical_depth), dr.exp(-optical_depth)
    color, by_depth, by_distance = [real(0) for _ in range(channels)], optical_depth * 0.0, None
    if image.color is not None:
        color = [dr.gather(real, image.color, channels * pixel + k, valid) for k in range(channels)]
        if how.background is not None:
            for k, derivative in enumerate(color):
                behind = dr.gather(real, how.background, type(pixel)(k))
                by_depth = dr.fma(-derivative * behind, transmittance, by_depth)
    if image.alpha is not None:
        by_depth = dr.fma(dr.gather(real, image.alpha, pixel, valid), transmittance, by_depth)
    if image.optical_depth is not None:
        by_depth += dr.gather(real, image.optical_depth, pixel, valid)
    if image.depth is not None:
        alpha = opacity(optical_depth)
        inverse = dr.select(alpha > 0, 1.0 / dr.select(alpha > 0, alpha, 1.0), 0.0)
        by_distance = dr.gather(real, image.depth, pixel, valid) * how.unit * inverse
        by_depth -= by_distance * (distance * inverse) * transmittance
    return PixelAdjoint(color, by_depth, by_distance)
