"""By what cells are sorted front to back, and whether that is right for the whole view (Dr.Jit).

In one recording with the laying out of a mesh: nothing here waits for the host.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import NONE, Backend
from difftetvr.mesh.shapes import Vector, cross, dot
from difftetvr.rendering.search.scene import Cells
from difftetvr.rendering.traversal.sums import raise_to

UNSETTLED, DENTED, BEHIND = 1, 2, 4
"""What the host hears: keys are not settled yet, the boundary has dents, cells may begin behind the camera."""

_SURE = 0.05
"""How far, in units of its longest edge, rounding may move the centre of a cell's circumsphere for it to count."""

_SIGN_CERTAIN = 16.0 * 2.0**-52
"""Rounding of a face's distance from the eye, times the face's area, in units of edge length times distance squared."""

_ROUNDINGS = 8.0
"""Roundings that a coordinate may be off where a dent counts, see :mod:`difftetvr.mesh.making.delaunay_check`."""

_EXPONENT_AND_FRACTION = 2**63 - 1
_BOX = 8


@dataclass
class CellsToSort:
    """The cells of a mesh, which are to be sorted.

    Attributes:
        cell: (T,) their numbers.
        adjacency: Flat (T, 4) cells behind the half-faces; None for loose cells.
        rounding: Relative rounding of a coordinate.
        rounds: Rounds in which all cells at once are moved behind their predecessors. Delaunay meshes need one, grids
            four, such whose vertices have moved may need a hundred, which the host looks after.
    """

    cell: Any
    adjacency: Any | None
    rounding: float
    rounds: int = 8


@dataclass
class CellKeys:
    """What cells are sorted by.

    Attributes:
        keys: (T,) 64-bit integers; of two cells that follow each other along a ray, the greater is behind.
        predecessors: Four (T,), the cell across the face opposite local vertex k if it is nearer, else `NONE`.
        unsettled: (1,) 1 if some key may not be greater than those of all predecessors, else 0.
    """

    keys: Any
    predecessors: list[Any]
    unsettled: Any


def keys_of(scene: Cells, cells: CellsToSort, extent: Any) -> CellKeys:
    """Find keys by which cells are sorted, for :func:`difftetvr.recording.replayed`.

    Args:
        scene: The cells, in the space of a camera.
        cells: Which of them follow which.
        extent: Where vertices are, see :data:`difftetvr.rendering.search.starts.EXTENT`.
    """
    backend, wide = scene.backend, scene.backend.at(None).Float
    uint = backend.UInt
    corners = scene.cell(cells.cell)
    points = [[wide(x) for x in scene.point(corners[k])] for k in range(4)]
    if cells.adjacency is None:
        middle = [a + b + c + d for a, b, c, d in zip(*points, strict=True)]
        keys, unsettled = _ordered_bits(dot(middle, middle)), dr.zeros(uint, 1)
        dr.eval(keys, unsettled)
        return CellKeys(keys, [], unsettled)
    largest = wide(0)
    for k in range(6):
        largest = dr.fmax(largest, wide(dr.gather(backend.Float, extent, uint(k))))
    shape = _Shape.of(points)
    keys = _ordered_bits(_eye_power(shape, cells.rounding * largest))
    behind = dr.gather(backend.UInt4, cells.adjacency, cells.cell)
    predecessors = [dr.select(beyond, behind[k], NONE) for k, beyond in enumerate(_eye_is_beyond(shape))]
    dr.eval(keys, predecessors)
    keys, unsettled = _moved_behind(backend, keys, predecessors, cells.rounds)
    return CellKeys(keys, predecessors, unsettled)


def _moved_behind(backend: Backend, keys: Any, predecessors: list[Any], rounds: int) -> tuple[Any, Any]:
    """Raise keys by as little as makes each greater than those of all its predecessors; or begin to.

    Returns:
        The keys, and (1,) whether some keys were raised in the last round.
    """
    uint, integer = backend.UInt, type(keys)
    least = integer(-(2**63))
    moved = dr.ones(uint, 1)
    dr.eval(moved)
    for _ in range(rounds):
        is_on, moved = dr.gather(uint, moved, uint(0)) != 0, dr.zeros(uint, 1)
        last = least
        for neighbor in predecessors:
            there = is_on & (neighbor != NONE)
            key = dr.gather(integer, keys, neighbor, there)
            last = dr.select(there & (key > last), key, last)
        is_late = (last >= keys) & (last > least)
        dr.scatter(moved, uint(1), uint(0), is_late)
        keys = dr.select(is_late, last + 1, keys)
        dr.eval(keys, moved)
    return keys, moved


@dataclass
class _Shape:
    """Cells seen from their first corners, see :class:`difftetvr.mesh.making.delaunay_check.CellShape`."""

    origin: Vector
    edges: list[Vector]
    squares: Vector
    normals: list[Vector]
    determinant: Any
    longest: Any

    @staticmethod
    def of(points: list[Vector]) -> _Shape:
        """From four corners."""
        origin = points[0]
        a, b, c = ([x - o for x, o in zip(point, origin, strict=True)] for point in points[1:])
        squares = [dot(edge, edge) for edge in (a, b, c)]
        normals = [cross(b, c), cross(c, a), cross(a, b)]
        longest = dr.sqrt(dr.fmax(dr.fmax(squares[0], squares[1]), squares[2]))
        return _Shape(origin, [a, b, c], squares, normals, dot(a, normals[0]), longest)


def _eye_power(shape: _Shape, rounding: Any) -> Any:
    """Power of the eye with respect to the circumsphere, |center|^2 - radius^2.

    Where rounding of the positions moves the centre too far, the sphere around the centroid with the mean square
    distance of the corners stands in, if the eye's power is smaller there: a cell too far in front is soon moved back,
    one too far behind moves many.
    """
    diameter = [
        sum(s * n[axis] for s, n in zip(shape.squares, shape.normals, strict=True)) / shape.determinant
        for axis in range(3)
    ]
    power = dot(shape.origin, [o + d for o, d in zip(shape.origin, diameter, strict=True)])
    spread = [0.25 * sum(edge[axis] for edge in shape.edges) for axis in range(3)]
    centroid = [o + s for o, s in zip(shape.origin, spread, strict=True)]
    stand_in = dot(centroid, centroid) + dot(spread, spread) - 0.25 * sum(shape.squares)
    reach = dr.sqrt(dot(diameter, diameter)) + shape.longest
    is_sure = rounding * reach * shape.longest < _SURE * shape.determinant
    return dr.select(is_sure, power, dr.fmin(power, stand_in))


def _eye_is_beyond(shape: _Shape) -> list[Any]:
    """Whether the face opposite local vertex k has the eye on the outside for certain.

    Cells that rounding turned inside out do not know in from out and say no.
    """
    beside = [dot(normal, shape.origin) for normal in shape.normals]
    opposite = -(shape.determinant + beside[0] + beside[1] + beside[2])
    reach = dr.sqrt(dot(shape.origin, shape.origin)) + shape.longest
    least = _SIGN_CERTAIN * shape.longest * reach * reach
    return [(value > least) & (shape.determinant > 0) for value in (opposite, *beside)]


def _ordered_bits(value: Any) -> Any:
    """Float64 values as 64-bit integers in the same order, the next number being the next value."""
    integer: Any = dr.int64_array_t(value)
    bits: Any = dr.reinterpret_array(integer, value)
    return dr.select(bits < 0, bits ^ _EXPONENT_AND_FRACTION, bits)


def told_flags(backend: Backend, unsettled: Any, dents: Any | None, extent: Any) -> Any:
    """(1,) what the host has to hear, in bits; may be recorded."""
    uint = backend.UInt
    nearest = -dr.gather(backend.Float, extent, uint(5))
    flags = UNSETTLED * unsettled + dr.select(nearest <= 0, uint(BEHIND), uint(0))
    flags = flags if dents is None else flags + DENTED * dents
    dr.eval(flags)
    return flags


@dataclass
class Creases:
    """Edges of the boundary of a mesh, and its vertices.

    Attributes:
        backend: Array types.
        edges: Flat (E, 4) a, b, c, d for each edge (a, b) between the faces a, b, c and b, a, d.
        numbers: (E,) numbers of the edges.
        positions: Flat (V, 3), in their own precision.
        rounding: Relative rounding of a coordinate, that of float32 at least.
        least_rounding: That of float32.
    """

    backend: Backend
    edges: Any
    numbers: Any
    positions: Any
    rounding: float
    least_rounding: float


def dented(creases: Creases) -> Any:
    """(1,) 1 if the boundary is bent inwards at an edge, by more than rounding explains, else 0; may be recorded.

    As :func:`difftetvr.mesh.making.delaunay_check.is_convex` has it.
    """
    backend, wide = creases.backend, creases.backend.at(None).Float
    uint, real = backend.UInt, type(creases.positions)
    ends = dr.gather(backend.UInt4, creases.edges, creases.numbers)
    points = [[wide(dr.gather(real, creases.positions, 3 * ends[k] + axis)) for axis in range(3)] for k in range(4)]
    box = dr.full(wide, -dr.inf, _BOX)
    for axis in range(3):
        least, most = (choose(points[0][axis], points[1][axis]) for choose in (dr.fmin, dr.fmax))
        raise_to(backend, box, most, 2 * axis)
        raise_to(backend, box, -least, 2 * axis + 1)
    dr.eval(box)
    sides = [dr.gather(wide, box, uint(k)) for k in range(6)]
    size = dr.fmax(dr.fmax(sides[0] + sides[1], sides[2] + sides[3]), sides[4] + sides[5])
    farthest = wide(0)
    for side in sides:
        farthest = dr.fmax(farthest, dr.abs(side))
    noise = _ROUNDINGS * dr.fmax(farthest / size * creases.rounding, creases.least_rounding)
    # In units of the mesh, for products of others need not be numbers.
    edges = [[(x - a) / size for x, a in zip(point, points[0], strict=True)] for point in points[1:]]
    squares = [dot(edge, edge) for edge in edges]
    height = dot(cross(edges[0], edges[1]), edges[2])
    is_flat = height <= noise * dr.fmax(dr.fmax(squares[0], squares[1]), squares[2])
    found = dr.zeros(uint, 1)
    dr.scatter(found, uint(1), uint(0), ~is_flat)
    dr.eval(found)
    return found
