"""Optical depth as a function of the distance along each ray, and the distance as one of it (Dr.Jit kernels).

Each ray is asked K questions in ascending order, all answered in one walk that ends with the last answer. Both
functions have one adjoint, since that of the inverse follows from that of the function itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.optics.special import depth_of
from difftetvr.recording import replayed
from difftetvr.rendering.kernels.gradients import Gradients, GradientSums, Wanted
from difftetvr.rendering.kernels.segments import SegmentKernel
from difftetvr.rendering.kernels.walk_adjoint import AdjointRay, Asked, WalkAdjoint, gradients_by
from difftetvr.rendering.traversal.crossing import Tracer, inverse_length
from difftetvr.rendering.traversal.rays import Lanes


@dataclass
class Table:
    """One row of K values for each ray, flat.

    Attributes:
        values: (N, K).
        width: K, as a device value.
    """

    values: Any
    width: Any

    def at(self, rays: Lanes, index: Any) -> Any:
        """Values by their number in the rays' rows; 0 behind the last one."""
        real = type(self.values)
        return dr.gather(real, self.values, rays.pixel * self.width + index, (index < self.width) & rays.valid)


@dataclass
class Answers:
    """What a walk found, flat (N, K): the answers, and the density where they were found, 0 where no matter was."""

    values: Any
    density: Any


@dataclass
class Weighed:
    """Distances, and what the optical depths there are worth to the loss.

    Attributes:
        distances: Distances, ascending in each row.
        weights: Derivatives of the loss with respect to the optical depths.
        ahead: Sums of each weight with those behind it in its row.
    """

    distances: Table
    weights: Table
    ahead: Table


@dataclass
class Reached:
    """State of a ray: the number of its next question, and the optical depth so far."""

    index: Any
    optical_depth: Any


@dataclass
class Segment:
    """A segment of linear density.

    Attributes:
        near, far: Distances of its ends.
        density: Density where it starts.
        change: Density where it ends less that.
        before: Optical depth where it starts.
        behind: Optical depth where it ends.
    """

    near: Any
    far: Any
    density: Any
    change: Any
    before: Any
    behind: Any


def ask_depths(tracer: Tracer, distances: Table, count: int) -> Answers:
    """Optical depths at distances along the rays of a view.

    Args:
        tracer: The view, without channels.
        distances: Distances, ascending in each row.
        count: Number of all values.
    """
    answers: Answers = replayed(_ask, _DepthsKernel, tracer, distances, count)
    return answers


def ask_distances(tracer: Tracer, depths: Table, count: int) -> Answers:
    """Distances at which the rays of a view reach optical depths; infinite where they never do.

    Args:
        tracer: The view, without channels.
        depths: Optical depths greater than 0, ascending in each row.
        count: Number of all values.
    """
    answers: Answers = replayed(_ask, _DistancesKernel, tracer, depths, count)
    return answers


def depths_adjoint(
    tracer: Tracer, depths: Weighed, vertex_count: int, wanted: Wanted, in_order: bool = False
) -> Gradients:
    """Gradients of optical depths at distances with respect to all but the distances.

    Args:
        tracer: The tracer that the walk before saw.
        depths: Where they are looked at, and what they are worth.
        vertex_count: Number of vertices V.
        wanted: What needs gradients beside the field.
        in_order: Whether sums over rays have a certain order, see :mod:`difftetvr.rendering.kernels.shares`.
    """
    return gradients_by(_DepthsAdjoint, tracer, depths, Asked(vertex_count, wanted, in_order))


def _ask(kernel: type[_ProfileKernel], tracer: Tracer, questions: Table, count: int) -> Answers:
    real = tracer.view.backend.Float
    answers = Answers(dr.empty(real, count), dr.empty(real, count))
    tracer.trace(lambda rays: kernel(tracer, rays, questions, answers))
    dr.eval(answers)
    return answers


class _ProfileKernel(SegmentKernel):
    """Answers questions in the segments in which they are decided."""

    def __init__(self, tracer: Tracer, rays: Lanes, questions: Table, answers: Answers) -> None:
        super().__init__(tracer, rays)
        self.questions, self.answers = questions, answers

    def is_in(self, question: Any, segment: Segment) -> Any:
        """Whether a question that no segment before has answered is decided in this one."""
        raise NotImplementedError

    def solve(self, question: Any, segment: Segment) -> tuple[Any, Any]:
        """The answer, and the density where it lies."""
        raise NotImplementedError

    def without_answer(self, ray: Reached) -> Any:
        """The answer to what no segment has decided."""
        raise NotImplementedError

    def start(self) -> Reached:
        backend, lanes = self.view.backend, dr.width(self.rays.pixel)
        return Reached(dr.zeros(backend.UInt, lanes), dr.zeros(backend.Float, lanes))

    def pass_segment(self, entry: list[Any], leaving: list[Any], ray: Reached) -> Reached:
        (t0, s0), (t1, s1) = entry, leaving
        half = 0.5 * dr.fmax(t1 - t0, 0.0)
        behind = dr.fma(half, s0, dr.fma(half, s1, ray.optical_depth))
        segment = Segment(t0, t1, s0, s1 - s0, ray.optical_depth, behind)

        def is_next(index: Any) -> Any:
            return (index < self.questions.width) & self.is_in(self.questions.at(self.rays, index), segment)

        def answer(index: Any) -> tuple[Any]:
            self._store(index, *self.solve(self.questions.at(self.rays, index), segment), True)
            return (index + 1,)

        (index,) = dr.while_loop((ray.index,), is_next, answer)
        return Reached(index, behind)

    def goes_on(self, ray: Reached) -> Any:
        return ray.index < self.questions.width

    def finish(self, ray: Reached) -> None:
        def answer(index: Any) -> tuple[Any]:
            value = self.without_answer(ray)
            self._store(index, value, dr.zeros_like(value), self.rays.valid)
            return (index + 1,)

        dr.while_loop((ray.index,), lambda index: index < self.questions.width, answer)

    def _store(self, index: Any, value: Any, density: Any, active: Any) -> None:
        place = self.rays.pixel * self.questions.width + index
        dr.scatter(self.answers.values, value, place, active)
        dr.scatter(self.answers.density, density, place, active)


class _DepthsKernel(_ProfileKernel):
    """Optical depths at distances."""

    def is_in(self, question: Any, segment: Segment) -> Any:
        return question <= segment.far

    def solve(self, question: Any, segment: Segment) -> tuple[Any, Any]:
        place = _place(question, segment.near, segment.far)
        length = dr.fmax(segment.far - segment.near, 0.0)
        mean = dr.fma(0.5 * place, segment.change, segment.density)
        density = dr.fma(place, segment.change, segment.density)
        # A distance in the gap before the segment lies in no matter.
        return dr.fma(place * length, mean, segment.before), dr.select(question >= segment.near, density, 0.0)

    def without_answer(self, ray: Reached) -> Any:
        return ray.optical_depth


class _DistancesKernel(_ProfileKernel):
    """Distances at optical depths."""

    def is_in(self, question: Any, segment: Segment) -> Any:
        return question <= segment.behind

    def solve(self, question: Any, segment: Segment) -> tuple[Any, Any]:
        # a x + (b - a) x^2 / 2 = rest: of the two forms of the root, the one that loses nothing where a = b or a is
        # great. Its square root is b where x is 1.
        length = dr.fmax(segment.far - segment.near, 0.0)
        a, b = (depth_of(length, density) for density in (segment.density, segment.density + segment.change))
        rest = question - segment.before
        root = dr.sqrt(dr.fmax(dr.fma(a, a, 2.0 * (b - a) * rest), 0.0))
        below = a + root
        place = dr.fmin(2.0 * rest / dr.select(below > 0, below, 1.0), 1.0)
        return dr.fma(place, length, segment.near), dr.fma(place, segment.change, segment.density)

    def without_answer(self, ray: Reached) -> Any:
        return dr.full(self.view.backend.Float, dr.inf, dr.width(ray.optical_depth))


class _DepthsAdjoint(WalkAdjoint):
    """The adjoint of optical depths at distances: of the density, weighed by all distances that are still ahead."""

    def __init__(self, tracer: Tracer, rays: Lanes, depths: Weighed, gradients: GradientSums) -> None:
        super().__init__(tracer, rays, gradients, [])
        self.distances, self.weights, self.ahead = depths.distances, depths.weights, depths.ahead

    def begin(self) -> Any:
        return dr.zeros(self.view.backend.UInt, dr.width(self.rays.pixel))

    def cross(
        self, start: list[Any], end: list[Any], progress: Any, is_crossed: Any
    ) -> tuple[Any, list[Any], list[Any]]:
        (t0, s0, _), (t1, s1, _) = start, end
        length, change = dr.fmax(t1 - t0, 0.0), s1 - s0

        def is_next(index: Any, *_: Any) -> Any:
            return (index < self.distances.width) & (self.distances.at(self.rays, index) <= t1)

        def add(index: Any, total: Any, first: Any, second: Any) -> tuple[Any, ...]:
            distance, weight = self.distances.at(self.rays, index), self.weights.at(self.rays, index)
            weight = dr.select(distance >= t0, weight, 0.0)  # one in the gap before the segment sees nothing of it
            place = _place(distance, t0, t1)
            half_square = 0.5 * place * place
            first = dr.fma(weight, place - half_square, first)
            return index + 1, total + weight, first, dr.fma(weight, half_square, second)

        # Up to the place x the optical depth is L ((x - x^2 / 2) s0 + x^2 / 2 s1), with x = (distance - t0) / L.
        zeros = [dr.zeros_like(length) for _ in range(3)]
        index, total, first, second = dr.while_loop((progress, *zeros), is_next, add)
        rest = self.ahead.at(self.rays, index)
        d_s0, d_s1 = length * dr.fma(0.5, rest, first), length * dr.fma(0.5, rest, second)
        of_rest = rest * dr.fma(0.5, s0, 0.5 * s1)
        d_t0 = -dr.fma(total, s0, dr.fma(change, first, of_rest))
        d_t1 = dr.fma(-change, second, of_rest)
        d_t0, d_t1 = dr.select(is_crossed, d_t0, 0.0), dr.select(is_crossed, d_t1, 0.0)
        none = dr.zeros_like(length)
        return index, [d_t0, d_s0, none], [d_t1, d_s1, none]

    def goes_on(self, ray: AdjointRay) -> Any:
        return ray.progress < self.distances.width


def _place(distance: Any, near: Any, far: Any) -> Any:
    """Where a distance lies between two, in [0, 1]."""
    return dr.fmin(dr.fmax((distance - near) * inverse_length(near, far), 0.0), 1.0)
