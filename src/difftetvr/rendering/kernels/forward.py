"""From crossings to an image: emission and absorption along rays (Dr.Jit kernel).

Channels of vertices are not interpolated: a ray carries, for the three vertices of the face it passes, the weights by
which it sees them, and adds a vertex's channels when it drops it. So their number costs next to nothing in the walk.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.recording import replayed
from difftetvr.rendering.kernels.composition import Composition, Pixels
from difftetvr.rendering.kernels.segments import SegmentKernel
from difftetvr.rendering.traversal.crossing import Step, Tracer, read_channels
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.walk import Face


@dataclass
class Radiance:
    """What a ray has gathered.

    Attributes:
        channels: Premultiplied radiance, or whatever the channels are.
        distance: Integral of the distance at which light is absorbed.
        optical_depth: Optical depth; beside the transmittance, since 1 - exp(-x) of a thin medium needs it.
        transmittance: Its exponential, the part of light still to come.
        carry: The weight of the face passed last, not yet given to its corners; only where vertices have channels.
    """

    channels: list[Any]
    distance: Any
    optical_depth: Any
    transmittance: Any
    carry: list[Any]


@dataclass
class Rendered:
    """What a view's rays gather, as flat arrays, and the image of it.

    Attributes:
        light: (N, width) records of premultiplied radiance and optical depth.
        distance: (N,) integral of the distance at which light is absorbed.
        image: The image.
    """

    light: Any
    distance: Any
    image: Pixels


def render_forward(tracer: Tracer, how: Composition) -> Rendered:
    """Render a view."""
    rendered: Rendered = replayed(_forward, tracer, how, tracer.view.rays.count)
    return rendered


def _forward(tracer: Tracer, how: Composition, count: int) -> Rendered:
    view = tracer.view
    real = view.backend.Float
    light, distance = dr.empty(real, view.records.width * count), dr.empty(real, count)
    rendered = Rendered(light, distance, Pixels.empty(real, view.channels, count))
    tracer.trace(lambda rays: _ForwardKernel(tracer, rays, rendered, how))
    dr.eval(rendered)
    return rendered


class _ForwardKernel(SegmentKernel):
    """Gathers light."""

    def __init__(self, tracer: Tracer, rays: Lanes, rendered: Rendered, how: Composition) -> None:
        super().__init__(tracer, rays, slots=1 if tracer.view.has_vertex_channels else 0)
        self.rendered, self.how = rendered, how

    def start(self) -> Radiance:
        real, lanes = self.view.backend.Float, dr.width(self.rays.pixel)
        channels, (distance, optical_depth), carry = (
            [dr.zeros(real, lanes) for _ in range(count)] for count in (self.view.channels, 2, self.slots)
        )
        return Radiance(channels, distance, optical_depth, dr.ones(real, lanes), carry)

    def visit(self, step: Step, ray: Radiance) -> Radiance:
        if not self.slots:
            return super().visit(step, ray)
        entry, leaving, clip = self.clipped(step)
        ray, w0, w1 = self._pass(entry, leaving, ray)
        if clip is not None:
            w0, w1 = clip.unclipped(w0, w1)
        _distribute(step.face, w0 + ray.carry[0])
        seen = step.exit.pick([corner.adjoints[0] for corner in step.face.corners])
        channels = self._add(ray.channels, seen, step.exit.vertex(step.face), True)
        step.exit.carry_adjoints(step.face, step.next_face)
        return Radiance(channels, ray.distance, ray.optical_depth, ray.transmittance, [w1])

    def _pass(self, entry: list[Any], leaving: list[Any], ray: Radiance) -> tuple[Radiance, Any, Any]:
        """Pass a segment of linear density, given distance and density at both ends; also the weights of its ends."""
        length = dr.fmax(leaving[0] - entry[0], 0.0)
        w0, w1, transmittance = self.view.optics.weights(length, entry[1], leaving[1])
        w0, w1 = w0 * ray.transmittance, w1 * ray.transmittance
        distance = dr.fma(w0, entry[0], dr.fma(w1, leaving[0], ray.distance))
        half = 0.5 * length
        optical_depth = dr.fma(half, entry[1], dr.fma(half, leaving[1], ray.optical_depth))
        passed = Radiance(ray.channels, distance, optical_depth, ray.transmittance * transmittance, ray.carry)
        return passed, w0, w1

    def pass_segment(self, entry: list[Any], leaving: list[Any], ray: Radiance) -> Radiance:
        ray, w0, w1 = self._pass(entry[:2], leaving[:2], ray)
        values = zip(entry[2:], leaving[2:], ray.channels, strict=True)
        channels = [dr.fma(w0, c0, dr.fma(w1, c1, c)) for c0, c1, c in values]
        return Radiance(channels, ray.distance, ray.optical_depth, ray.transmittance, ray.carry)

    def _add(self, channels: list[Any], weight: Any, vertex: Any, active: Any) -> list[Any]:
        values = read_channels(self.view, vertex, active)
        return [dr.fma(weight, value, sum_) for value, sum_ in zip(values, channels, strict=True)]

    def goes_on(self, ray: Radiance) -> Any:
        # With a threshold of 0 the line integral is complete, however little light is left to see it by.
        return (ray.transmittance > self.view.threshold) | (self.view.threshold == 0)

    def leave(self, face: Face, ray: Radiance, active: Any) -> Radiance:
        if not self.slots:
            return ray
        _distribute(face, ray.carry[0])
        channels = ray.channels
        for corner in face.corners:
            channels = self._add(channels, dr.select(active, corner.adjoints[0], 0.0), corner.vertex, active)
        carry = [dr.zeros_like(ray.carry[0])]
        return Radiance(channels, ray.distance, ray.optical_depth, ray.transmittance, carry)

    def finish(self, ray: Radiance) -> None:
        view, pixel, valid, rendered = self.view, self.rays.pixel, self.rays.valid, self.rendered
        view.records.scatter(view.backend, rendered.light, [*ray.channels, ray.optical_depth], pixel, valid)
        dr.scatter(rendered.distance, ray.distance, pixel, valid)
        gathered = ray.channels, ray.distance, ray.optical_depth
        rendered.image.write(view.backend, self.how, gathered, pixel, valid)


def _distribute(face: Face, weight: Any) -> None:
    """Give the weight of a face's crossing to its corners."""
    for corner, share in zip(face.corners, face.weights(), strict=True):
        corner.adjoints[0] = dr.fma(share, weight, corner.adjoints[0])
