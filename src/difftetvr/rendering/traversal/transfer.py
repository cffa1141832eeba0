"""Scalars seen through a piecewise-linear transfer function, without approximation (Dr.Jit).

Inside a cell the scalar is linear along a ray. Where it passes a knot of the transfer function the crossing is cut: on
every piece density and colour are linear again, and the optical model integrates them as it does those of a mesh's
field. Two knots at one scalar are a jump; the piece between them has no length, but derivatives: the earlier knot can
only move down and the later one up, and then the jump becomes a slope. At the jump itself the later knot counts, so
scalars that lie on it can only move up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.rendering.traversal.sums import Sums
from difftetvr.rendering.traversal.walk import Face


@dataclass
class Transfer:
    """A transfer function as kernels read it.

    Attributes:
        backend: Array types.
        knots: (K,) scalars, not decreasing.
        values: (K, 4) density and linear RGB.
        count: K, as a device value.
        bits: Steps of a binary search among the knots.
    """

    backend: Backend
    knots: Any
    values: Any
    count: Any
    bits: int

    @staticmethod
    def of(backend: Backend, knots: torch.Tensor, values: torch.Tensor) -> Transfer:
        """Upload (K,) knots and (K, 4) densities and colours."""
        count = knots.shape[0]
        # A copy: the backward pass wants the knots as they are now, whatever becomes of the caller's tensor.
        arrays = backend.floats(knots.clone()), backend.floats(values)
        return Transfer(backend, *arrays, dr.opaque(backend.Int, count), count.bit_length())

    def knot(self, index: Any, active: Any = True) -> Any:
        """Scalar of a knot."""
        return dr.gather(self.backend.Float, self.knots, self.backend.UInt(index), active)

    def at(self, scalar: Any) -> list[Any]:
        """Density and linear RGB of a scalar."""
        uint, float4 = self.backend.UInt, self.backend.Float4
        interval = self.interval(scalar, True)
        lower = uint(dr.select(interval < 0, 0, interval))
        upper = uint(dr.select(interval + 1 < self.count, interval + 1, self.count - 1))
        low = self.knot(lower)
        weight = dr.fmin(dr.fmax((scalar - low) * _inverse(self.knot(upper) - low), 0.0), 1.0)
        below, above = (dr.gather(float4, self.values, index) for index in (lower, upper))
        return [dr.fma(weight, above[k] - below[k], below[k]) for k in range(4)]

    def bounded(self, values: list[Any], face: Face) -> list[Any]:
        """Distance and scalar at a face, the scalar within those of its corners.

        Where these are all one number, rounding must not carry it across a jump at that number.
        """
        first, second, third = (corner.values[1] for corner in face.corners)
        low, high = dr.fmin(dr.fmin(first, second), third), dr.fmax(dr.fmax(first, second), third)
        return [values[0], dr.fmin(dr.fmax(values[1], low), high)]

    def interval(self, scalar: Any, inclusive: Any) -> Any:
        """Last knot below a scalar, or at it where ``inclusive``; -1 where there is none."""
        integer = self.backend.Int
        low, high = dr.zeros(integer, dr.width(scalar)), self.count + dr.zeros(integer, dr.width(scalar))
        for _ in range(self.bits):
            open_ = low < high
            middle = (low + high) >> 1
            knot = self.knot(middle, open_)
            below = open_ & ((knot < scalar) | (inclusive & (knot == scalar)))
            low, high = dr.select(below, middle + 1, low), dr.select(open_ & ~below, middle, high)
        return low - 1

    def cut(self, entry: list[Any], leaving: list[Any], visit: Callable[[Piece, Any], Any], state: Any) -> Any:
        """Visit the pieces of a crossing in their order.

        Knots at one of its ends cut it, too, unless its scalar is constant: pieces without a length matter to the
        derivatives by these knots.

        Args:
            entry: Distance and scalar where it begins.
            leaving: Distance and scalar where it ends.
            visit: ``visit(piece, state)`` returns the new state.
            state: A PyTree.

        Returns:
            The final state.
        """
        (_, f0), (_, f1) = entry, leaving
        rises, varies = f1 >= f0, f1 != f0
        rise = dr.select(varies, f1 - f0, 1.0)

        def advance(_: Any, begin: PieceEnd, interval: Any, state: Any) -> tuple[Any, ...]:
            ahead = dr.select(rises, interval + 1, interval)
            is_knot = (ahead >= 0) & (ahead < self.count)
            knot = self.knot(ahead, is_knot)
            cuts = is_knot & varies & dr.select(rises, knot <= f1, knot >= f1)
            x = dr.select(cuts & (knot != f1), dr.fmax(dr.fmin((knot - f0) / rise, 1.0), begin.x), 1.0)
            end = PieceEnd(x, dr.select(cuts, knot, f1), cuts, ahead)
            state = visit(Piece.of(self, entry, leaving, interval, begin, end), state)
            return cuts, end, interval + dr.select(rises, 1, -1), state

        zero = dr.zeros_like(f0)
        interval = self.interval(f0, ~(rises & varies))
        first = PieceEnd(zero, f0, dr.zeros(dr.mask_t(f0), dr.width(f0)), interval)
        start = (dr.full(dr.mask_t(f0), True, dr.width(f0)), first, interval, state)
        return dr.while_loop(start, lambda more, *_: more, advance)[3]


@dataclass
class PieceEnd:
    """An end of a piece.

    Attributes:
        x: Its place in [0, 1] along the crossing.
        scalar: Its scalar.
        at_knot: Whether a knot decides both.
        knot: Index of that knot.
    """

    x: Any
    scalar: Any
    at_knot: Any
    knot: Any


@dataclass
class Piece:
    """Part of a crossing between two knots.

    Attributes:
        lower, upper: The knots; the same one outside of the first and last.
        change: Values of the upper knot less those of the lower, density and linear RGB.
        inverse_width: One over the distance of the knots; 0 where there is none.
        begin, end: The ends.
        weights: Place of each end between the knots, 0 at the lower.
        start_values, end_values: Distance, density and linear RGB at the ends.
    """

    lower: Any
    upper: Any
    change: list[Any]
    inverse_width: Any
    begin: PieceEnd
    end: PieceEnd
    weights: tuple[Any, Any]
    start_values: list[Any]
    end_values: list[Any]

    @staticmethod
    def of(
        transfer: Transfer, entry: list[Any], leaving: list[Any], interval: Any, begin: PieceEnd, end: PieceEnd
    ) -> Piece:
        """The piece of a crossing in an interval of the knots."""
        uint, float4 = transfer.backend.UInt, transfer.backend.Float4
        lower = uint(dr.select(interval < 0, 0, interval))
        upper = uint(dr.select(interval + 1 < transfer.count, interval + 1, transfer.count - 1))
        below, above = (dr.gather(float4, transfer.values, index) for index in (lower, upper))
        low = transfer.knot(lower)
        width = transfer.knot(upper) - low
        inverse_width = _inverse(width)
        change = [above[k] - below[k] for k in range(4)]
        weights, ends = [], []
        for place in (begin, end):
            weight = dr.fmin(dr.fmax((place.scalar - low) * inverse_width, 0.0), 1.0)
            # At a jump the scalar does not tell on which side of it an end is.
            is_upper = place.at_knot & (place.knot > interval)
            weight = dr.select(inverse_width > 0, weight, dr.select(is_upper, 1.0, 0.0))
            distance = dr.fma(place.x, leaving[0] - entry[0], entry[0])
            weights.append(weight)
            ends.append(
                [
                    dr.select(place.x < 1.0, distance, leaving[0]),
                    *(dr.fma(weight, change[k], below[k]) for k in range(4)),
                ]
            )
        return Piece(lower, upper, change, inverse_width, begin, end, (weights[0], weights[1]), ends[0], ends[1])


KNOT_RECORD = 8
"""Floats of the sums of a knot: derivatives by its place, its density and linear RGB, and padding."""


@dataclass
class CrossingAdjoint:
    """Derivatives by distance and scalar at both ends of a crossing, summed over its pieces."""

    entry: list[Any]
    leaving: list[Any]


class PieceAdjoint:
    """Hands the derivatives at a piece's ends on to knots, and to the ends of its crossing."""

    def __init__(
        self,
        transfer: Transfer,
        piece: Piece,
        entry: list[Any],
        leaving: list[Any],
        gradients: Sums | None,
    ) -> None:
        """Begin.

        Args:
            transfer: The function.
            piece: A piece of a crossing.
            entry: Distance and scalar where the crossing begins.
            leaving: The same where it ends.
            gradients: What to add to for the knots; None where they need none.
        """
        self.transfer, self.piece, self.gradients = transfer, piece, gradients
        (t0, f0), (t1, f1) = entry, leaving
        self.speed = (t1 - t0) * _inverse(f1 - f0)
        self.lowest, self.highest = dr.fmin(f0, f1), dr.fmax(f0, f1)

    def add(self, at_start: list[Any], at_end: list[Any], pixel: list[Any], total: CrossingAdjoint) -> CrossingAdjoint:
        """Add a piece's part.

        Args:
            at_start: Derivatives by distance, density and radiance <pixel, RGB> where the piece starts.
            at_end: The same where it ends.
            pixel: Derivatives by the pixel's linear RGB; none where the colours are not seen.
            total: Sums so far.

        Returns:
            The new sums.
        """
        piece = self.piece
        low, high = [at_start[0] * 0.0] * 2, [at_start[0] * 0.0] * 2
        knot_low, knot_high = at_start[0] * 0.0, at_start[0] * 0.0
        entry, leaving = list(total.entry), list(total.leaving)
        change = [piece.change[0], sum((g * c for g, c in zip(pixel, piece.change[1:], strict=False)), low[0])]
        places = ((piece.begin, piece.weights[0], at_start), (piece.end, piece.weights[1], at_end))
        for is_end, (place, weight, gradient) in enumerate(places):
            low = [dr.fma(1.0 - weight, g, s) for g, s in zip(gradient[1:], low, strict=True)]
            high = [dr.fma(weight, g, s) for g, s in zip(gradient[1:], high, strict=True)]
            # A knot's value does not depend on where the knot is, a value between knots does.
            slope = dr.fma(gradient[1], change[0], gradient[2] * change[1]) * piece.inverse_width
            slope_by_knots = dr.select(place.at_knot, 0.0, slope)
            knot_low = dr.fma(weight - 1.0, slope_by_knots, knot_low)
            knot_high = dr.fma(-weight, slope_by_knots, knot_high)
            # Where a knot cuts the crossing, on the other hand, it decides the distance.
            moved = gradient[0] * self.speed
            moved_by_knot = dr.select(place.at_knot & ~self._is_held(place), moved, 0.0)
            at_upper = weight > 0.5
            knot_high += dr.select(at_upper, moved_by_knot, 0.0)
            knot_low += dr.select(at_upper, 0.0, moved_by_knot)
            entry[0] = dr.fma(1.0 - place.x, gradient[0], entry[0])
            leaving[0] = dr.fma(place.x, gradient[0], leaving[0])
            # A scalar that is at the knot moves up, where the knot is none of the crossing's.
            is_passed = place.at_knot & (place.scalar > self.lowest)
            moved = dr.select(is_passed, moved, 0.0)
            entry[1] = dr.fma(place.x - 1.0, moved, entry[1])
            leaving[1] = dr.fma(-place.x, moved, leaving[1])
            slope = dr.select(is_passed, 0.0, slope)
            if is_end:
                leaving[1] += slope
            else:
                entry[1] += slope
        if self.gradients is not None:
            self._scatter(self.gradients, piece.lower, [knot_low, *low], pixel)
            self._scatter(self.gradients, piece.upper, [knot_high, *high], pixel)
        return CrossingAdjoint(entry, leaving)

    def _is_held(self, place: PieceEnd) -> Any:
        """Whether a knot, where it can move to, is none of the crossing's: that of a jump at the crossing's very end.

        The first knot of a jump can only move down, where the crossing is not if the jump is at its least scalar; the
        last one only up.
        """
        at_least, at_greatest = place.scalar == self.lowest, place.scalar == self.highest
        reads, transfer = place.at_knot & (at_least | at_greatest), self.transfer
        before, after = reads & (place.knot > 0), reads & (place.knot + 1 < transfer.count)
        follows = before & (transfer.knot(place.knot - 1, before) == place.scalar)
        precedes = after & (transfer.knot(place.knot + 1, after) == place.scalar)
        return (at_least & precedes & ~follows) | (at_greatest & follows & ~precedes)

    def _scatter(self, gradients: Sums, knot: Any, values: list[Any], pixel: list[Any]) -> None:
        """Add derivatives by a knot's place, its density, and the radiance <pixel, RGB> there."""
        place, density, radiance = values
        record = [place, density, *(radiance * g for g in pixel)]
        record += [dr.zeros_like(place)] * (KNOT_RECORD - len(record))
        gradients.add(self.transfer.backend.Floats(record), knot)


def _inverse(difference: Any) -> Any:
    """One over a difference; 0 where it is none, or so small that its inverse overflows."""
    least = 4.0 * dr.smallest(difference)
    return dr.select(dr.abs(difference) > least, 1.0 / difference, 0.0)
