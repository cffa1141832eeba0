"""From crossings to an image: emission and absorption along rays (Dr.Jit kernel)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.rendering.traversal.crossing import Rays, Span, Step, Tracer, corner_of, read_vertex
from difftetvr.rendering.traversal.walk import Corner, Face


@dataclass
class Radiance:
    """What a ray has gathered.

    Attributes:
        color: Premultiplied radiance, three components.
        distance: Integral of the distance at which light is absorbed.
        optical_depth: Optical depth; beside the transmittance, since 1 - exp(-x) of a thin medium needs it.
        transmittance: Its exponential, the part of light still to come.
    """

    color: list[Any]
    distance: Any
    optical_depth: Any
    transmittance: Any


def render_forward(tracer: Tracer) -> tuple[Any, Any]:
    """Render a view.

    Returns:
        Flat arrays: (H, W, 4) premultiplied radiance and optical depth, (H, W) integral of the distance.
    """
    view = tracer.view
    real, pixels = view.backend.Float, view.camera.width * view.camera.height
    light, distance = dr.empty(real, 4 * pixels), dr.empty(real, pixels)
    tracer.trace(lambda rays: _ForwardKernel(tracer, rays, light, distance))
    view.backend.run(light, distance)
    return light, distance


class _ForwardKernel:
    """Gathers light; see :class:`difftetvr.rendering.traversal.crossing.Kernel`."""

    def __init__(self, tracer: Tracer, rays: Rays, light: Any, distance: Any) -> None:
        self.view, self.rays, self.light, self.distance = tracer.view, rays, light, distance
        self.span = Span.of(tracer, rays)

    def start(self) -> Radiance:
        real, lanes = self.view.backend.Float, dr.width(self.rays.pixel)
        zeros = [dr.zeros(real, lanes) for _ in range(5)]
        return Radiance(zeros[:3], zeros[3], zeros[4], dr.ones(real, lanes))

    def read(self, vertex: Any, active: Any) -> Corner:
        position, attributes = read_vertex(self.view, vertex, active)
        return corner_of(self.rays.frame, vertex, position, attributes, 0)

    def visit(self, step: Step, ray: Radiance) -> Radiance:
        entry, leaving = step.entry, step.leaving
        if self.view.transfer is not None:
            entry = self.view.transfer.bounded(entry, step.face)
            leaving = self.view.transfer.bounded(leaving, step.next_face)
        if self.span is not None:
            clip = self.span.clip(entry[0], leaving[0])
            entry, leaving = clip.start(entry, leaving), clip.end(entry, leaving)
        if self.view.cells is not None:
            record = dr.gather(self.view.backend.Float4, self.view.cells, step.cell)
            entry, leaving = ([values[0], record[3], record[0], record[1], record[2]] for values in (entry, leaving))
        if self.view.transfer is not None:
            pass_piece = lambda piece, ray: self._gather(piece.start_values, piece.end_values, ray)  # noqa: E731
            return self.view.transfer.cut(entry, leaving, pass_piece, ray)
        return self._gather(entry, leaving, ray)

    def _gather(self, entry: list[Any], leaving: list[Any], ray: Radiance) -> Radiance:
        """Pass a segment with linear density and colour: distance, density and linear RGB at both ends."""
        length = dr.fmax(leaving[0] - entry[0], 0.0)
        w0, w1, transmittance = self.view.optics.weights(length, entry[1], leaving[1])
        w0, w1 = w0 * ray.transmittance, w1 * ray.transmittance
        color = [dr.fma(w0, c0, dr.fma(w1, c1, c)) for c0, c1, c in zip(entry[2:], leaving[2:], ray.color, strict=True)]
        distance = dr.fma(w0, entry[0], dr.fma(w1, leaving[0], ray.distance))
        half = 0.5 * length
        optical_depth = dr.fma(half, entry[1], dr.fma(half, leaving[1], ray.optical_depth))
        return Radiance(color, distance, optical_depth, ray.transmittance * transmittance)

    def goes_on(self, ray: Radiance) -> Any:
        # With a threshold of 0 the line integral is complete, however little light is left to see it by.
        return (ray.transmittance > self.view.threshold) | (self.view.threshold == 0)

    def leave(self, face: Face, ray: Radiance, active: Any) -> Radiance:
        return ray

    def finish(self, ray: Radiance) -> None:
        float4, pixel, valid = self.view.backend.Float4, self.rays.pixel, self.rays.valid
        dr.scatter(self.light, float4(*ray.color, ray.optical_depth), pixel, valid)
        dr.scatter(self.distance, ray.distance, pixel, valid)
