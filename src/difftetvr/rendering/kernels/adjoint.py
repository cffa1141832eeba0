"""The adjoint of rendering (Dr.Jit kernel).

It runs through the same crossings again, front to back. ``rest`` is the part of <dL/dimage, image> still ahead of the
ray, so the derivative with respect to a cell's optical depth needs nothing from behind it (the inversion trick of Weiss
and Westermann without its division).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.rendering.kernels.composition import Composition, Pixels, pixel_adjoint
from difftetvr.rendering.kernels.gradients import Gradients, GradientSums, Wanted
from difftetvr.rendering.kernels.walk_adjoint import AdjointRay, Asked, WalkAdjoint, gradients_by
from difftetvr.rendering.traversal.crossing import Tracer
from difftetvr.rendering.traversal.rays import Lanes


@dataclass
class ImageAdjoint:
    """Derivatives of the loss with respect to an image, and what was gathered for it.

    Attributes:
        image: The derivatives; None for those that are all zero.
        how: How the image was composed.
        light: (N, width) records of channels and optical depth.
        distance: (N,) integral of distance.
        is_complete: Whether rays went on to their ends, however little light was left.
    """

    image: Pixels
    how: Composition
    light: Any
    distance: Any
    is_complete: bool


@dataclass
class LightAhead:
    """What a ray has still to see.

    Attributes:
        transmittance: Transmittance up to the current crossing.
        rest: Part of <dL/dimage, image> that lies behind it.
    """

    transmittance: Any
    rest: Any


def render_adjoint(
    tracer: Tracer, image: ImageAdjoint, vertex_count: int, wanted: Wanted, in_order: bool = False
) -> Gradients:
    """Gradients of a view with respect to the field and, if asked, the vertices, the rays and their limits.

    Args:
        tracer: The tracer that ``render_forward`` saw.
        image: Derivatives with respect to the image, and the image.
        vertex_count: Number of vertices V.
        wanted: What else needs gradients.
        in_order: Whether sums over rays have a certain order, see :mod:`difftetvr.rendering.kernels.shares`.
    """
    by = image.image
    # Where rays stopped early, only the same products of transmittances tell exactly where.
    sees_light = by.depth is not None or (by.color is not None and tracer.view.channels > 0)
    kernel = _LightAdjoint if sees_light or not image.is_complete else _DepthAdjoint
    return gradients_by(kernel, tracer, image, Asked(vertex_count, wanted, in_order))


class _DepthAdjoint(WalkAdjoint):
    """The adjoint of the optical depth alone, which opacity depends on, too: every crossing counts alike."""

    def __init__(self, tracer: Tracer, rays: Lanes, image: ImageAdjoint, gradients: GradientSums) -> None:
        view = tracer.view
        backend, pixel, valid = view.backend, rays.pixel, rays.valid
        *_, optical_depth = view.records.gather(backend, image.light, pixel, valid)
        gathered = optical_depth, dr.zeros_like(optical_depth)
        by_pixel = pixel_adjoint(image.image, image.how, view.channels, gathered, pixel, valid)
        super().__init__(tracer, rays, gradients, by_pixel.color)
        self.half = 0.5 * by_pixel.optical_depth

    def begin(self) -> None:
        return None

    def cross(
        self, start: list[Any], end: list[Any], progress: Any, is_crossed: Any
    ) -> tuple[Any, list[Any], list[Any]]:
        (t0, s0, _), (t1, s1, _) = start, end
        length, none = dr.fmax(t1 - t0, 0.0), dr.zeros_like(t0)
        d_density = self.half * length
        d_length = dr.select(is_crossed, self.half * (s0 + s1), 0.0)
        return None, [-d_length, d_density, none], [d_length, d_density, none]

    def goes_on(self, ray: AdjointRay) -> Any:
        return self.half != 0

    def _radiance(self, channels: list[Any]) -> Any:
        return self.view.backend.Float(0)


class _LightAdjoint(WalkAdjoint):
    """The adjoint of emission and absorption."""

    def __init__(self, tracer: Tracer, rays: Lanes, image: ImageAdjoint, gradients: GradientSums) -> None:
        view = tracer.view
        backend, pixel, valid = view.backend, rays.pixel, rays.valid
        *seen, optical_depth = view.records.gather(backend, image.light, pixel, valid)
        distance = dr.gather(backend.Float, image.distance, pixel, valid)
        gathered = optical_depth, distance
        by_pixel = pixel_adjoint(image.image, image.how, view.channels, gathered, pixel, valid)
        super().__init__(tracer, rays, gradients, by_pixel.color)
        pairs = zip(by_pixel.color, seen, strict=True)
        self.rest = sum((g * c for g, c in pairs), dr.zeros(backend.Float, dr.width(pixel)))
        self.optical_depth, self.distance = by_pixel.optical_depth, by_pixel.distance
        if self.distance is not None:
            self.rest = dr.fma(self.distance, distance, self.rest)

    def begin(self) -> LightAhead:
        return LightAhead(dr.ones(self.view.backend.Float, dr.width(self.rays.pixel)), self.rest)

    def cross(
        self, start: list[Any], end: list[Any], progress: LightAhead, is_crossed: Any
    ) -> tuple[LightAhead, list[Any], list[Any]]:
        (t0, s0, q0), (t1, s1, q1) = start, end
        far, reached = self.distance, progress.transmittance
        if far is not None:  # to the weights, distance is one more colour
            q0, q1 = dr.fma(far, t0, q0), dr.fma(far, t1, q1)
        length = dr.fmax(t1 - t0, 0.0)
        g0, g1 = q0 * reached, q1 * reached
        w0, w1, transmittance, d_length, d_s0, d_s1 = self.view.optics.adjoint(length, s0, s1, g0, g1, type(length)(0))
        transmittance *= reached
        # Where no light comes through, nothing is left but what rounding has left.
        rest = dr.select(transmittance > 0, progress.rest - dr.fma(w0, g0, w1 * g1), 0.0)
        # All that is still ahead is seen through this cell: its optical depth L (s0 + s1) / 2 dims the rest.
        half = 0.5 * (rest - self.optical_depth)
        d_length = dr.select(is_crossed, dr.fma(-half, s0, dr.fma(-half, s1, d_length)), 0.0)
        d_s0, d_s1 = dr.fma(-half, length, d_s0), dr.fma(-half, length, d_s1)
        w0, w1 = w0 * reached, w1 * reached
        d_t0, d_t1 = -d_length, d_length
        if far is not None:
            d_t0, d_t1 = dr.fma(far, w0, d_t0), dr.fma(far, w1, d_t1)
        return LightAhead(transmittance, rest), [d_t0, d_s0, w0], [d_t1, d_s1, w1]

    def goes_on(self, ray: AdjointRay) -> Any:
        integrates = (self.view.threshold == 0) & (self.optical_depth != 0)
        return (ray.progress.transmittance > self.view.threshold) | integrates
