"""Rays counted anew from where they are nearest to a mesh: there, float32 resolves most (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.rendering.traversal.sums import raise_to

_OUTSIDE = 1.001
"""Distance from a mesh's centre, in radii, from which on a ray surely sees all of the mesh."""

_DENORMAL_UNITS = {dr.VarType.Float32: -149, dr.VarType.Float64: -1074}
"""Exponents of the least numbers above 0, whose multiples kernels take for 0."""

_REACH = 8
"""Floats of the greatest x, -x, y, -y, z and -z, and two more: one packet."""


@dataclass
class Rows:
    """(N, width) numbers of rays in one flat array; or one row that serves all of them.

    Attributes:
        array: The numbers, in their own precision.
        step: Rows from one ray's to the next one's: 1, or 0 where all have the same.
        width: Numbers in a row.
    """

    array: Any
    step: int
    width: int

    def of(self, wide: Any, ray: Any) -> list[Any]:
        """The rows of some rays in a precision."""
        return [wide(value) for value in self.exact(ray)]

    def exact(self, ray: Any) -> list[Any]:
        """The rows of some rays in their own precision."""
        first = self.step * self.width * ray
        return [dr.gather(type(self.array), self.array, first + k) for k in range(self.width)]


@dataclass
class GivenRays:
    """Rays as callers give them, and the mesh that they may meet.

    Attributes:
        backend: Array types of the result.
        wide: Float type to count in.
        lane: (N,) numbers of the rays.
        count: N.
        origins, directions: (N, 3), the directions of any length but 0.
        near, far: (N, 1) distances from the origins between which rays are looked at.
        vertices: Flat (V, 3) positions, in their own precision.
        vertex: (V,) numbers of the vertices, in any order.
        unit: (1,) the unit of the result in that of all others.
    """

    backend: Backend
    wide: Any
    lane: Any
    count: int
    origins: Rows
    directions: Rows
    near: Rows
    far: Rows
    vertices: Any
    vertex: Any
    unit: Any


@dataclass
class CountedRays:
    """The rays, counted from where they are nearest to the centre of the mesh's bounding box.

    Attributes:
        lines: Flat (N, 6) these points in the unit of the result, and unit directions.
        limits: Flat (N, 2) distances from there between which rays are looked at, in that unit.
        shift: (N,) how far these points are from the given origins, in their unit.
        length: (N,) of the given directions.
        flags: (2,) 1 if no ray begins or ends near the mesh, and 1 if all are looked at from one point on; else 0.
    """

    lines: Any
    limits: Any
    shift: Any
    length: Any
    flags: Any


def recount(given: GivenRays) -> CountedRays:
    """Count rays anew, for :func:`difftetvr.recording.replayed`."""
    backend, wide, ray = given.backend, given.wide, given.lane
    center, radius = _sphere(given)
    lines, limits = (dr.empty(backend.Float, width * given.count) for width in (6, 2))
    doubts = dr.zeros(backend.Float, 2)
    origin, (near,), (far,) = (rows.of(wide, ray) for rows in (given.origins, given.near, given.far))
    direction, length = _unit_vector(wide, given.directions.exact(ray))
    shift = sum((c - o) * d for c, o, d in zip(center, origin, direction, strict=True))
    inverse = 1.0 / given.unit
    nearest = [dr.fma(shift, d, o) * inverse for o, d in zip(origin, direction, strict=True)]
    dr.scatter(lines, backend.Floats([backend.Float(value) for value in (*nearest, *direction)]), ray)
    ends = [backend.Float((end - shift) * inverse) for end in (near, far)]
    dr.scatter(limits, backend.Float2(ends), ray)
    # The distance of the end from the origin is rounded as these are, whose difference it is.
    away = dr.fmin(shift - near, far - (1.0 + 1e-5) * dr.abs(shift))
    _doubt(backend, doubts, 0, away > _OUTSIDE * radius)
    begin, first = _begin(origin, near, direction), _begin_of_first(given)
    is_one = dr.mask_t(wide)(True)
    for value, other in zip(begin, first, strict=True):
        is_one &= value == other
    _doubt(backend, doubts, 1, is_one)
    dr.eval(lines, limits, shift, length, doubts)
    flags = 1.0 - doubts
    dr.eval(flags)
    return CountedRays(lines, limits, shift, length, flags)


def _doubt(backend: Backend, doubts: Any, place: int, holds: Any) -> None:
    raise_to(backend, doubts, dr.select(holds, backend.Float(0), backend.Float(1)), place)


def _sphere(given: GivenRays) -> tuple[list[Any], Any]:
    """Centre of the bounding box of the mesh, and distance of its corners from there."""
    wide, uint = given.wide, given.backend.UInt
    reach = dr.full(wide, -dr.inf, _REACH)
    for axis in range(3):
        value = wide(dr.gather(type(given.vertices), given.vertices, 3 * given.vertex + axis))
        raise_to(given.backend, reach, value, 2 * axis)
        raise_to(given.backend, reach, -value, 2 * axis + 1)
    dr.eval(reach)
    high, negative = ([dr.gather(wide, reach, uint(2 * axis + side)) for axis in range(3)] for side in range(2))
    center = [0.5 * h - 0.5 * n for h, n in zip(high, negative, strict=True)]
    half = [0.5 * h + 0.5 * n for h, n in zip(high, negative, strict=True)]
    scaled, scale = _in_range(wide, half)
    return center, _length(scaled) / scale


def _unit_vector(wide: Any, vector: list[Any]) -> tuple[list[Any], Any]:
    """A vector of length 1 in a precision, of one of any length but 0; and that length."""
    scaled, scale = _in_range(wide, vector)
    length = _length(scaled)
    return [value / length for value in scaled], length / scale


def _in_range(wide: Any, vector: list[Any]) -> tuple[list[Any], Any]:
    """A vector in a precision, times a scale for which its square is a number and, unless the vector is 0, not 0."""
    values, multiples = [wide(value) for value in vector], [_denormal_multiple(value) for value in vector]
    real = type(vector[0])
    scale, short_unit = wide(1), wide(2.0 ** _DENORMAL_UNITS[dr.type_v(real)])
    if real is wide:  # float64 holds the squares of all numbers of float32
        edge = 400 if dr.type_v(wide) == dr.VarType.Float64 else 50
        largest = dr.fmax(dr.fmax(dr.abs(values[0]), dr.abs(values[1])), dr.abs(values[2]))
        is_short, is_long = largest < 2.0**-edge, largest > 2.0**edge
        # Powers of two: vectors of common lengths come to the very bits they would come to without.
        step = 2.0 ** (2 * edge)
        scale = dr.select(is_short, wide(step), dr.select(is_long, wide(1 / step), wide(1)))
        # Beside numbers that are not as short, denormal ones are 0.
        short_unit = dr.select(is_short, wide(2.0 ** (2 * edge + _DENORMAL_UNITS[dr.type_v(real)])), wide(0))
    scaled = [
        dr.select(multiple == 0, scale * value, short_unit * wide(multiple))
        for value, multiple in zip(values, multiples, strict=True)
    ]
    return scaled, scale


def _denormal_multiple(value: Any) -> Any:
    """What a denormal number is in units of the least one, as an integer; 0 where a number is none.

    By its bits, for kernels take such numbers for 0.
    """
    is_double = dr.type_v(type(value)) == dr.VarType.Float64
    integer: Any = (dr.int64_array_t if is_double else dr.int32_array_t)(value)
    bits: Any = dr.reinterpret_array(integer, value)
    size = bits & (2**63 - 1 if is_double else 2**31 - 1)
    multiple = dr.select(size < (2**52 if is_double else 2**23), size, 0)
    return dr.select(bits < 0, -multiple, multiple)


def _length(vector: list[Any]) -> Any:
    return dr.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


def _begin(origin: list[Any], near: Any, direction: list[Any]) -> list[Any]:
    return [dr.fma(near, d, o) for o, d in zip(origin, direction, strict=True)]


def _begin_of_first(given: GivenRays) -> list[Any]:
    first = given.backend.UInt(0)
    wide = given.wide
    (near,), direction = given.near.of(wide, first), _unit_vector(wide, given.directions.exact(first))[0]
    return _begin(given.origins.of(wide, first), near, direction)
