"""What the adjoints of all integrals along rays share (Dr.Jit kernel).

They run through the same crossings again, front to back. Channels enter only as <dL/dchannels, channels>: two numbers a
vertex are carried. Each step of a walk drops exactly one vertex, so exactly one record is scattered.

Derivatives by the rays themselves come along: moving a ray is moving all it meets the other way, and turning it moves
what lies at distance t by t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.recording import replayed
from difftetvr.rendering.kernels.gradients import BufferSizes, Gradients, GradientSums, Wanted
from difftetvr.rendering.kernels.shares import Deal
from difftetvr.rendering.traversal.crossing import (
    Clip,
    Span,
    Step,
    Tracer,
    corner_of,
    inverse_length,
    read_channels,
    read_vertex,
)
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.sums import Copies
from difftetvr.rendering.traversal.transfer import CrossingAdjoint, Piece, PieceAdjoint
from difftetvr.rendering.traversal.walk import Corner, Face


@dataclass
class AdjointRay:
    """State of a ray in an adjoint walk.

    Attributes:
        progress: What a crossing's derivatives need of those before it, a PyTree of the integral's own.
        carry: Derivatives with respect to distance, density and radiance at the crossing, from the cell in front.
        limits: Derivatives with respect to the ends of the span that is looked at; empty where none are wanted.
        line: Derivatives with respect to the ray, in its frame: by moving it along a, b and t, and by turning it
            towards a and b; empty where none are wanted.
    """

    progress: Any
    carry: list[Any]
    limits: list[Any]
    line: list[Any]


class WalkAdjoint:
    """Gathers derivatives; see :class:`difftetvr.rendering.traversal.crossing.Kernel`.

    An integral says, in :meth:`cross`, what it depends on in one segment of linear density; all that leads from there
    to vertices, cells, knots, limits and rays is here.
    """

    def __init__(self, tracer: Tracer, rays: Lanes, gradients: GradientSums, color: list[Any]) -> None:
        """Begin.

        Args:
            tracer: The tracer that the forward kernel saw.
            rays: The rays.
            gradients: What to add to.
            color: Derivatives of the loss by each ray's channels, as many as are seen.
        """
        self.view, self.gradients, self.rays, self.color = tracer.view, gradients, rays, color
        self.span = Span.of(tracer, rays)
        # Accumulators of a vertex: its density or scalar, and radiance if it has channels, then its position in the
        # ray's frame.
        self.field_slots = 0 if self.view.has_cell_density else 2 if self.view.has_vertex_channels else 1
        self.slots = self.field_slots + (3 if gradients.vertices is not None else 0)

    def begin(self) -> Any:
        """The progress of rays before their first crossing."""
        raise NotImplementedError

    def cross(
        self, start: list[Any], end: list[Any], progress: Any, is_crossed: Any
    ) -> tuple[Any, list[Any], list[Any]]:
        """Adjoint of a segment of linear density and radiance.

        Args:
            start: Distance, density and radiance, <``color``, channels>, where it starts.
            end: The same where it ends.
            progress: What is known from the crossings before.
            is_crossed: Mask; where it is not set, rounding has left nothing of the cell, and distances do not matter.

        Returns:
            The new progress, and derivatives with respect to ``start`` and ``end``.
        """
        raise NotImplementedError

    def goes_on(self, ray: AdjointRay) -> Any:
        """Whether derivatives are still ahead of a ray."""
        raise NotImplementedError

    def start(self) -> AdjointRay:
        """State of the rays before their first crossing."""
        real, lanes = self.view.backend.Float, dr.width(self.rays.pixel)
        limits = 2 if self.gradients.limits is not None else 0
        line = 5 if self.gradients.lines is not None else 0
        zeros = ([dr.zeros(real, lanes) for _ in range(count)] for count in (3, limits, line))
        return AdjointRay(self.begin(), *zeros)

    def read(self, vertex: Any, active: Any) -> Corner:
        """A vertex with what it is worth to the loss, and its accumulators."""
        position, attributes = read_vertex(self.view, vertex, active)
        if self.view.has_vertex_channels:
            attributes = [*attributes, self._radiance(read_channels(self.view, vertex, active))]
        return corner_of(self.rays.frame, vertex, position, attributes, self.slots)

    def _radiance(self, channels: list[Any]) -> Any:
        """What channels are worth to the loss."""
        total = None
        for g, c in zip(reversed(self.color), reversed(channels), strict=True):
            total = g * c if total is None else dr.fma(g, c, total)
        return self.view.backend.Float(0) if total is None else total

    def visit(self, step: Step, ray: AdjointRay) -> AdjointRay:
        """Add a crossing's derivatives, and scatter those of the vertex that is dropped."""
        view, start, end = self.view, step.entry, step.leaving
        if view.transfer is not None:
            start = view.transfer.bounded(start, step.face)
            end = view.transfer.bounded(end, step.next_face)
        clip = None if self.span is None else self.span.clip(start[0], end[0])
        if clip:
            start, end = clip.start(start, end), clip.end(start, end)
        density, radiance = self._of_cell(step.cell)
        if view.transfer is None:
            known = [value for value in (density, radiance) if value is not None]
            start, end = [*start, *known], [*end, *known]
            progress, at_start, at_end = self.cross(start, end, ray.progress, end[0] > start[0])
        else:
            progress, at_start, at_end = self._cut(start, end, ray.progress, radiance)
        if view.cells is not None:
            of_density = at_start[1] + at_end[1] if view.has_cell_density else dr.zeros_like(at_start[1])
            self._scatter_record(self.gradients.cells, step.cell, of_density, at_start[2] + at_end[2], True)
        at_start, at_end = at_start[: 1 + self.field_slots], at_end[: 1 + self.field_slots]
        limits = ray.limits
        if clip:
            at_start, at_end, at_limits = _unclip(clip, step, at_start, at_end)
            limits = [old + new for old, new in zip(limits, at_limits, strict=False)]
        line = self._distribute(step.face, [c + g for c, g in zip(ray.carry, at_start, strict=False)], ray.line)
        self._scatter(
            step.exit.vertex(step.face),
            [step.exit.pick([corner.adjoints[i] for corner in step.face.corners]) for i in range(self.slots)],
            True,
        )
        step.exit.carry_adjoints(step.face, step.next_face)
        unused = [dr.zeros_like(at_end[0]) for _ in range(3 - len(at_end))]
        return AdjointRay(progress, at_end + unused, limits, line)

    def _of_cell(self, cell: Any) -> tuple[Any | None, Any | None]:
        """Density and radiance that are constant in a cell; None for what vertices or a transfer function know."""
        view = self.view
        if view.cells is None:
            return None, self._radiance([]) if view.channels == 0 else None
        *channels, density = view.records.gather(view.backend, view.cells, cell)
        return density if view.has_cell_density else None, self._radiance(channels)

    def _cut(
        self, start: list[Any], end: list[Any], progress: Any, radiance: Any | None
    ) -> tuple[Any, list[Any], list[Any]]:
        """Adjoint of one cell, piece by piece.

        Args:
            start, end: Distance and scalar at the crossing's ends.
            progress: What is known from the crossings before.
            radiance: Radiance of the cell; None for that of the transfer function.

        Returns:
            The new progress, and derivatives with respect to distance, scalar and the cell's radiance at both ends.
        """
        transfer = self.view.transfer
        assert transfer is not None
        # A jump's piece has no length, but moves with the jump.
        is_crossed = end[0] > start[0]
        color = self.color if radiance is None else []

        def visit(piece: Piece, state: tuple[Any, CrossingAdjoint, Any]) -> tuple[Any, CrossingAdjoint, Any]:
            progress, total, seen = state
            ends = [
                [v[0], v[1], self._radiance(v[2:]) if radiance is None else radiance]
                for v in (piece.start_values, piece.end_values)
            ]
            progress, at_start, at_end = self.cross(ends[0], ends[1], progress, is_crossed)
            adjoint = PieceAdjoint(transfer, piece, start, end, self.gradients.knots)
            return progress, adjoint.add(at_start, at_end, color, total), seen + at_start[2] + at_end[2]

        zeros = [[dr.zeros_like(start[0]) for _ in range(2)] for _ in range(2)]
        state = (progress, CrossingAdjoint(*zeros), dr.zeros_like(start[0]))
        progress, total, seen = transfer.cut(start, end, visit, state)
        return progress, [*total.entry, seen], [*total.leaving, dr.zeros_like(seen)]

    def leave(self, face: Face, ray: AdjointRay, active: Any) -> AdjointRay:
        """Scatter the derivatives of the vertices of a face behind which there is no cell."""
        carry = ray.carry[: 1 + self.field_slots]
        line = self._distribute(face, carry, ray.line)
        for corner in face.corners:
            self._scatter(corner.vertex, corner.adjoints, active)
        line = [dr.select(active, new, old) for new, old in zip(line, ray.line, strict=True)]
        return AdjointRay(ray.progress, [dr.zeros_like(c) for c in ray.carry], ray.limits, line)

    def finish(self, ray: AdjointRay) -> None:
        """Store the derivatives by the rays and their limits."""
        if self.gradients.limits is not None:
            packet = self.view.backend.Float2(*ray.limits)
            dr.scatter(self.gradients.limits, packet, self.rays.pixel, self.rays.valid)
        if self.gradients.lines is not None:
            moved, turned = self.rays.frame.unproject(*ray.line[:3]), (*ray.line[3:], ray.line[0] * 0.0)
            values = [*moved, *self.rays.frame.unproject(*turned)]
            dr.scatter(self.gradients.lines, self.view.backend.Floats(values), self.rays.pixel, self.rays.valid)

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
        value, position = adjoints[: self.field_slots], adjoints[self.field_slots :]
        if self.field_slots == 2:
            self._scatter_record(self.gradients.field, vertex, value[0], value[1], active)
        elif self.gradients.field is not None:
            self.gradients.field.add(self.view.backend.Float2(*value, 0.0), vertex, active)
        if self.gradients.vertices is not None:
            beside = value[0] if self.field_slots == 1 else 0.0
            record = self.view.backend.Float4(*self.rays.frame.unproject(*position), beside)
            self.gradients.vertices.add(record, vertex, active)

    def _scatter_record(self, sums: Any, index: Any, density: Any, radiance: Any, active: Any) -> None:
        record = [radiance * g for g in self.color] + [density]
        self.view.records.add(self.view.backend, sums, record, index, active)


@dataclass(frozen=True)
class Asked:
    """What a backward pass is to find.

    Attributes:
        vertex_count: Number of vertices V.
        wanted: What needs gradients beside the field.
        in_order: Whether sums over rays have a certain order, see :mod:`difftetvr.rendering.kernels.shares`.
    """

    vertex_count: int
    wanted: Wanted
    in_order: bool


def gradients_by(kernel: Any, tracer: Tracer, derivatives: Any, asked: Asked) -> Gradients:
    """What an adjoint gathers from all rays.

    Args:
        kernel: Class of a :class:`WalkAdjoint`, made of tracer, rays, derivatives and sums.
        tracer: The tracer that the walk before saw.
        derivatives: Of the loss by what that walk had found; made of what :func:`difftetvr.recording.replayed` takes.
        asked: What is to be found.
    """
    backend, sizes = tracer.view.backend, BufferSizes.of(tracer.view, asked.vertex_count, asked.wanted)
    deal = Deal.of(tracer, sizes.floats, asked.in_order)
    places = sizes.places(backend, deal.copies)
    with backend.on_threads(deal.threads):
        gradients: Gradients = replayed(_gather, kernel, tracer, derivatives, deal, sizes, places)
    return gradients


def _gather(
    kernel: Any, tracer: Tracer, derivatives: Any, deal: Deal, sizes: BufferSizes, copies: list[Copies | None]
) -> Gradients:
    sums = GradientSums.zeros(tracer.view.backend, sizes, copies, deal.mode)

    def run(part: Tracer, copy: Any | None) -> None:
        part.trace(lambda rays: kernel(part, rays, derivatives, sums.of_copy(copy)))

    deal.trace(tracer, run)
    gradients = sums.total()
    dr.eval(gradients)
    return gradients


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
