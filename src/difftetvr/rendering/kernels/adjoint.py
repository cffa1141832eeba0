"""The adjoint of rendering (Dr.Jit kernel).

It runs through the same crossings again, front to back. ``rest`` is the part of <dL/dimage, image> still ahead of the
ray, so the derivative with respect to a cell's optical depth needs nothing from behind it (the inversion trick of Weiss
and Westermann without its division). Channels enter only as <dL/dchannels, channels>: two numbers a vertex are carried.
Each step of a walk drops exactly one vertex, so exactly one record is scattered.

Derivatives by the rays themselves come along: moving a ray is moving all it meets the other way, and turning it moves
what lies at distance t by t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.recording import few_lengths, replayed
from difftetvr.rendering.kernels.composition import Composition, Pixels, pixel_adjoint
from difftetvr.rendering.traversal.crossing import (
    Clip,
    Span,
    Step,
    Tracer,
    View,
    corner_of,
    inverse_length,
    read_channels,
    read_vertex,
)
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.transfer import CrossingAdjoint, Piece, PieceAdjoint, TransferGradients
from difftetvr.rendering.traversal.walk import Corner, Face

_EXPAND_BUDGET = 1 << 30  # bytes of per-thread gradient copies; beyond it threads share one copy through atomics


@dataclass
class ImageAdjoint:
    """Derivatives of the loss with respect to an image, and what was gathered for it.

    Attributes:
        image: The derivatives; None for those that are all zero.
        how: How the image was composed.
        light: (N, width) records of channels and optical depth.
        distance: (N,) integral of distance.
    """

    image: Pixels
    how: Composition
    light: Any
    distance: Any


@dataclass
class Gradients:
    """Flat gradient buffers.

    Attributes:
        field: (M, width) records: channels and density of at least V vertices or T cells; or (M,) scalars of vertices.
        vertices: (M, 4): x, y, z in the space of the vertices and padding; None if positions need no gradient.
        limits: (N, 2): the distances between which rays are looked at; None if they need no gradient.
        lines: (N, 6): the rays' origins and directions; None if they need no gradient.
        transfer: The transfer function; None if there is none.
        mode: How additions of several rays to one record are reduced.
    """

    field: Any
    vertices: Any | None
    limits: Any | None
    lines: Any | None
    transfer: TransferGradients | None
    mode: dr.ReduceMode


@dataclass
class AdjointRay:
    """State of a ray in the adjoint walk.

    Attributes:
        transmittance: Transmittance up to the current crossing.
        rest: Part of <dL/dimage, image> that lies behind it.
        carry: Derivatives with respect to distance, density and radiance at the crossing, from the cell in front.
        limits: Derivatives with respect to the ends of the span that is looked at; empty where none are wanted.
        line: Derivatives with respect to the ray, in its frame: by moving it along a, b and t, and by turning it
            towards a and b; empty where none are wanted.
    """

    transmittance: Any
    rest: Any
    carry: list[Any]
    limits: list[Any]
    line: list[Any]


def reduce_mode(view: View, floats: int) -> dr.ReduceMode:
    """On CPUs one gradient copy a thread beats atomics, as long as the copies fit a budget."""
    if view.backend.name != "llvm":
        return dr.ReduceMode.Auto
    size = floats * (8 if view.backend.is_double else 4) * dr.thread_count()
    return dr.ReduceMode.Expand if size <= _EXPAND_BUDGET else dr.ReduceMode.Local


@dataclass(frozen=True)
class Wanted:
    """Which gradients are wanted beside the field's; the kernel is cheaper without them."""

    vertices: bool
    limits: bool
    lines: bool = False


def render_adjoint(tracer: Tracer, image: ImageAdjoint, vertex_count: int, wanted: Wanted) -> Gradients:
    """Gradients of a view with respect to the field and, if asked, the vertices, the rays and their limits.

    Args:
        tracer: The tracer that ``render_forward`` saw.
        image: Derivatives with respect to the image, and the image.
        vertex_count: Number of vertices V.
        wanted: What else needs gradients.
    """
    view = tracer.view
    width = 1 if view.transfer is not None else view.records.width
    field_count = few_lengths(vertex_count if view.cells is None else dr.width(view.cells) // width)
    transfer = view.transfer
    sizes = BufferSizes(
        width * field_count,
        4 * few_lengths(vertex_count) if wanted.vertices else None,
        2 * view.rays.count if wanted.limits else None,
        6 * view.rays.count if wanted.lines else None,
        None if transfer is None else (dr.width(transfer.knots), dr.width(transfer.values)),
    )
    mode = reduce_mode(view, sizes.field + (sizes.vertices or 0))
    gradients: Gradients = replayed(_adjoint, tracer, image, sizes, mode)
    return gradients


@dataclass(frozen=True)
class BufferSizes:
    """Floats in each of the buffers of :class:`Gradients`; None for those that are not wanted."""

    field: int
    vertices: int | None
    limits: int | None
    lines: int | None
    transfer: tuple[int, int] | None


def _adjoint(tracer: Tracer, image: ImageAdjoint, sizes: BufferSizes, mode: dr.ReduceMode) -> Gradients:
    real = tracer.view.backend.Float
    field, vertices, limits, lines = (
        None if size is None else dr.zeros(real, size)
        for size in (sizes.field, sizes.vertices, sizes.limits, sizes.lines)
    )
    transfer = None if sizes.transfer is None else TransferGradients(*(dr.zeros(real, size) for size in sizes.transfer))
    gradients = Gradients(field, vertices, limits, lines, transfer, mode)
    tracer.trace(lambda rays: _AdjointKernel(tracer, rays, image, gradients))
    dr.eval(field, vertices, limits, lines, transfer)
    return gradients


class _AdjointKernel:
    """Gathers derivatives; see :class:`difftetvr.rendering.traversal.crossing.Kernel`."""

    def __init__(self, tracer: Tracer, rays: Lanes, image: ImageAdjoint, gradients: Gradients) -> None:
        self.view, self.gradients, self.rays = tracer.view, gradients, rays
        self.span = Span.of(tracer, rays)
        backend, pixel, valid = self.view.backend, rays.pixel, rays.valid
        *seen, optical_depth = self.view.records.gather(backend, image.light, pixel, valid)
        distance = dr.gather(backend.Float, image.distance, pixel, valid)
        gathered = optical_depth, distance
        self.pixel = pixel_adjoint(image.image, image.how, self.view.channels, gathered, pixel, valid)
        pairs = zip(self.pixel.color, seen, strict=True)
        self.rest = sum((g * c for g, c in pairs), dr.zeros(backend.Float, dr.width(pixel)))
        if self.pixel.distance is not None:
            self.rest = dr.fma(self.pixel.distance, distance, self.rest)
        # Accumulators of a vertex: its scalar, or density and radiance, then its position in the ray's frame; for
        # fields on cells only the position.
        self.field_slots = 0 if self.view.cells is not None else 2 if self.view.has_vertex_channels else 1
        self.slots = self.field_slots + (3 if gradients.vertices is not None else 0)

    def start(self) -> AdjointRay:
        real, lanes = self.view.backend.Float, dr.width(self.rays.pixel)
        limits = 2 if self.gradients.limits is not None else 0
        line = 5 if self.gradients.lines is not None else 0
        zeros = ([dr.zeros(real, lanes) for _ in range(count)] for count in (3, limits, line))
        return AdjointRay(dr.ones(real, lanes), self.rest, *zeros)

    def read(self, vertex: Any, active: Any) -> Corner:
        position, attributes = read_vertex(self.view, vertex, active)
        if self.view.has_vertex_channels:
            attributes = [*attributes, self._radiance(read_channels(self.view, vertex, active))]
        return corner_of(self.rays.frame, vertex, position, attributes, self.slots)

    def _radiance(self, channels: list[Any]) -> Any:
        """What channels are worth to the loss."""
        total = None
        for g, c in zip(reversed(self.pixel.color), reversed(channels), strict=True):
            total = g * c if total is None else dr.fma(g, c, total)
        return self.view.backend.Float(0) if total is None else total

    def visit(self, step: Step, ray: AdjointRay) -> AdjointRay:
        start, end = step.entry, step.leaving
        if self.view.transfer is not None:
            start = self.view.transfer.bounded(start, step.face)
            end = self.view.transfer.bounded(end, step.next_face)
        clip = None if self.span is None else self.span.clip(start[0], end[0])
        if clip:
            start, end = clip.start(start, end), clip.end(start, end)
        if self.view.cells is not None:
            *channels, density = self.view.records.gather(self.view.backend, self.view.cells, step.cell)
            constant = [density, self._radiance(channels)]
            start, end = [start[0], *constant], [end[0], *constant]
        elif self.view.channels == 0:
            start, end = ([*values, self._radiance([])] for values in (start, end))
        ray, at_start, at_end = (
            self._cross(start, end, ray, end[0] > start[0])
            if self.view.transfer is None
            else self._cut(start, end, ray)
        )
        if self.view.cells is not None:
            self._scatter_field(step.cell, at_start[1] + at_end[1], at_start[2] + at_end[2], True)
        at_start, at_end = at_start[: 1 + self.field_slots], at_end[: 1 + self.field_slots]
        if clip:
            at_start, at_end, at_limits = _unclip(clip, step, at_start, at_end)
            ray.limits = [old + new for old, new in zip(ray.limits, at_limits, strict=False)]
        line = self._distribute(step.face, [c + g for c, g in zip(ray.carry, at_start, strict=False)], ray.line)
        self._scatter(
            step.exit.vertex(step.face),
            [step.exit.pick([corner.adjoints[i] for corner in step.face.corners]) for i in range(self.slots)],
            True,
        )
        step.exit.carry_adjoints(step.face, step.next_face)
        unused = [dr.zeros_like(ray.rest) for _ in range(3 - len(at_end))]
        return AdjointRay(ray.transmittance, ray.rest, at_end + unused, ray.limits, line)

    def _cross(
        self, start: list[Any], end: list[Any], ray: AdjointRay, is_crossed: Any
    ) -> tuple[AdjointRay, list[Any], list[Any]]:
        """Adjoint of one cell: derivatives with respect to (distance, density, radiance) at its start and end.

        Where ``is_crossed`` is false, rounding has left nothing of the cell, and distances do not matter.
        """
        (t0, s0, q0), (t1, s1, q1) = start, end
        far = self.pixel.distance
        if far is not None:  # to the weights, distance is one more colour
            q0, q1 = dr.fma(far, t0, q0), dr.fma(far, t1, q1)
        length = dr.fmax(t1 - t0, 0.0)
        g0, g1 = q0 * ray.transmittance, q1 * ray.transmittance
        w0, w1, transmittance, d_length, d_s0, d_s1 = self.view.optics.adjoint(length, s0, s1, g0, g1, type(length)(0))
        transmittance *= ray.transmittance
        # Where no light comes through, nothing is left but what rounding has left.
        rest = dr.select(transmittance > 0, ray.rest - dr.fma(w0, g0, w1 * g1), 0.0)
        # All that is still ahead is seen through this cell: its optical depth L (s0 + s1) / 2 dims the rest.
        half = 0.5 * (rest - self.pixel.optical_depth)
        d_length = dr.select(is_crossed, dr.fma(-half, s0, dr.fma(-half, s1, d_length)), 0.0)
        d_s0, d_s1 = dr.fma(-half, length, d_s0), dr.fma(-half, length, d_s1)
        w0, w1 = w0 * ray.transmittance, w1 * ray.transmittance
        d_t0, d_t1 = -d_length, d_length
        if far is not None:
            d_t0, d_t1 = dr.fma(far, w0, d_t0), dr.fma(far, w1, d_t1)
        at_start, at_end = [d_t0, d_s0, w0], [d_t1, d_s1, w1]
        return AdjointRay(transmittance, rest, ray.carry, ray.limits, ray.line), at_start, at_end

    def _cut(self, start: list[Any], end: list[Any], ray: AdjointRay) -> tuple[AdjointRay, list[Any], list[Any]]:
        """Adjoint of one cell, piece by piece: derivatives with respect to (distance, scalar) at its start and end."""
        transfer, gradients = self.view.transfer, self.gradients.transfer
        assert transfer is not None and gradients is not None

        # A jump's piece has no length, but moves with the jump.
        is_crossed = end[0] > start[0]

        def visit(piece: Piece, state: tuple[AdjointRay, CrossingAdjoint]) -> tuple[AdjointRay, CrossingAdjoint]:
            ray, total = state
            ends = [[v[0], v[1], self._radiance(v[2:])] for v in (piece.start_values, piece.end_values)]
            ray, at_start, at_end = self._cross(ends[0], ends[1], ray, is_crossed)
            adjoint = PieceAdjoint(transfer, piece, start, end, gradients, self.gradients.mode)
            return ray, adjoint.add(at_start, at_end, self.pixel.color, total)

        zeros = lambda: [dr.zeros_like(ray.rest) for _ in range(2)]  # noqa: E731
        ray, total = transfer.cut(start, end, visit, (ray, CrossingAdjoint(zeros(), zeros())))
        return ray, total.entry, total.leaving

    def goes_on(self, ray: AdjointRay) -> Any:
        integrates = (self.view.threshold == 0) & (self.pixel.optical_depth != 0)
        return (ray.transmittance > self.view.threshold) | integrates

    def leave(self, face: Face, ray: AdjointRay, active: Any) -> AdjointRay:
        carry = ray.carry[: 1 + self.field_slots]
        line = self._distribute(face, carry, ray.line)
        for corner in face.corners:
            self._scatter(corner.vertex, corner.adjoints, active)
        line = [dr.select(active, new, old) for new, old in zip(line, ray.line, strict=True)]
        return AdjointRay(ray.transmittance, ray.rest, [dr.zeros_like(c) for c in ray.carry], ray.limits, line)

    def finish(self, ray: AdjointRay) -> None:
        if self.gradients.limits is not None:
            packet = self.view.backend.Float2(*ray.limits)
            dr.scatter(self.gradients.limits, packet, self.rays.pixel, self.rays.valid)
        if self.gradients.lines is not None:
            moved, turned = self.rays.frame.unproject(*ray.line[:3]), (*ray.line[3:], ray.line[0] * 0.0)
            values = [*moved, *self.rays.frame.unproject(*turned)]
            for k in range(3):
                packet = self.view.backend.Float2(*values[2 * k : 2 * k + 2])
                dr.scatter(self.gradients.lines, packet, 3 * self.rays.pixel + k, self.rays.valid)

    def _distribute(self, face: Face, crossing: list[Any], line: list[Any]) -> list[Any]:
        """Add a crossing's derivatives to the accumulators of its face's corners; returns those of the ray."""
        weights = face.weights()
        for corner, weight in zip(face.corners, weights, strict=True):
            for slot in range(self.field_slots):
                corner.adjoints[slot] = dr.fma(weight, crossing[1 + slot], corner.adjoints[slot])
        if self.gradients.vertices is None and not line:
            return line
        slope_a, slope_b = _slope(face, crossing)
        if self.gradients.vertices is not None:
            for corner, weight in zip(face.corners, weights, strict=True):
                first = self.field_slots
                corner.adjoints[first] = dr.fma(-weight, slope_a, corner.adjoints[first])
                corner.adjoints[first + 1] = dr.fma(-weight, slope_b, corner.adjoints[first + 1])
                corner.adjoints[first + 2] = dr.fma(weight, crossing[0], corner.adjoints[first + 2])
        if not line:
            return line
        distance = sum((w * c.values[0] for w, c in zip(weights, face.corners, strict=True)), slope_a * 0.0)
        moved = [line[0] + slope_a, line[1] + slope_b, line[2] - crossing[0]]
        return [*moved, dr.fma(distance, slope_a, line[3]), dr.fma(distance, slope_b, line[4])]

    def _scatter(self, vertex: Any, adjoints: list[Any], active: Any) -> None:
        if self.field_slots == 1:
            dr.scatter_add(self.gradients.field, adjoints[0], vertex, active, mode=self.gradients.mode)
        elif self.field_slots:
            self._scatter_field(vertex, adjoints[0], adjoints[1], active)
        if self.gradients.vertices is not None:
            position = self.rays.frame.unproject(*adjoints[self.field_slots :])
            record = self.view.backend.Float4(*position, 0.0)
            dr.scatter_add(self.gradients.vertices, record, vertex, active, mode=self.gradients.mode)

    def _scatter_field(self, index: Any, density: Any, radiance: Any, active: Any) -> None:
        record = [radiance * g for g in self.pixel.color] + [density]
        self.view.records.scatter_add(
            self.view.backend, self.gradients.field, record, index, active, self.gradients.mode
        )


def _unclip(clip: Clip, step: Step, at_start: list[Any], at_end: list[Any]) -> tuple[list[Any], list[Any], list[Any]]:
    """Derivatives at a clipped crossing's true entry and exit, and by the ends of the span, which do not move with it.

    The part runs from x0 to x1: values there are V0 + x (V1 - V0), and x = (limit - t0) / (t1 - t0) at a limit.
    """
    t0, t1 = step.entry[0], step.leaving[0]
    inverse = inverse_length(t0, t1)
    change = [v1 - v0 for v0, v1 in zip(step.entry[1:], step.leaving[1:], strict=True)]
    slope0, slope1 = (
        sum((g * c for g, c in zip(values[1:], change, strict=False)), t0 * 0.0) * inverse
        for values in (at_start, at_end)
    )
    # A part of no length is no part: its ends do not matter, wherever the limits are.
    is_part = clip.last > clip.first
    slope0, slope1 = dr.select(clip.at_near & is_part, slope0, 0.0), dr.select(clip.at_far & is_part, slope1, 0.0)
    near = dr.select(clip.at_near & is_part, at_start[0] + slope0, 0.0)
    far = dr.select(clip.at_far & is_part, at_end[0] + slope1, 0.0)
    entry = dr.select(clip.at_near, 0.0, at_start[0]) - (1.0 - clip.first) * slope0 - (1.0 - clip.last) * slope1
    leaving = dr.select(clip.at_far, 0.0, at_end[0]) - clip.first * slope0 - clip.last * slope1
    entry_gradient, leaving_gradient = [entry], [leaving]
    for g0, g1 in zip(at_start[1:], at_end[1:], strict=True):
        entry_gradient.append(dr.fma(1.0 - clip.first, g0, (1.0 - clip.last) * g1))
        leaving_gradient.append(dr.fma(clip.first, g0, clip.last * g1))
    return entry_gradient, leaving_gradient, [near, far]


def _slope(face: Face, crossing: list[Any]) -> tuple[Any, Any]:
    """Slope over the ray's plane of the face's linear interpolant of <crossing, values>.

    Moving the face by (da, db) against the ray changes the crossing's value by minus this slope times the move, which
    is where the hit point's own motion enters: with this slope H a corner gets w_k (-H_a, -H_b, g_t).
    """
    a, b, c = face.corners
    inverse = face.inverse_area()
    # Differences of values, since the distances of a far mesh would cancel.
    change = []
    for corner in (b, c):
        pairs = zip(crossing, corner.values, a.values, strict=True)
        change.append(sum((g * (v1 - v0) for g, v1, v0 in pairs), inverse * 0.0))
    slope_a = (change[0] * (c.b - a.b) + change[1] * (a.b - b.b)) * inverse
    slope_b = (change[0] * (a.a - c.a) + change[1] * (b.a - a.a)) * inverse
    return slope_a, slope_b
