"""The Dr.Jit kernel that integrates voxels along rays: exactly, voxel by voxel.

Sources: Siddon, "Fast calculation of the exact radiological path for a three-dimensional CT array", Med. Phys. 12
(1985); Amanatides and Woo, "A fast voxel traversal algorithm for ray tracing", Eurographics (1987).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend

NUMBERS_OF_VIEW = 18
"""Of origin and direction of a ray: at the middle of the first pixel, and what a column and a row add to each."""

_STILL = 1e-20  # of a direction's length
_GAUSS = 0.28867513459481287  # half of 1 / sqrt(3): two such points integrate cubic polynomials exactly


@dataclass(frozen=True)
class Voxels:
    """Device arrays of a volume.

    Attributes:
        values: (nx * ny * nz), x fastest; for trilinear ones with one more layer on each side, which repeats the last.
        lower: Opaque: where the box begins, in voxels from the plane 0.
        upper: Three opaque coordinates where it ends.
        first: Opaque: the least number of a cell between planes.
        last: Three opaque greatest numbers.
        strides: Opaque distances of neighbours along y and z.
        sides: Three opaque lengths of a voxel in world units.
        middle: Three opaque coordinates of the middle of the box, in voxels.
    """

    values: Any
    lower: Any
    upper: tuple[Any, Any, Any]
    first: Any
    last: tuple[Any, Any, Any]
    strides: tuple[Any, Any]
    sides: tuple[Any, Any, Any]
    middle: tuple[Any, Any, Any]


@dataclass(frozen=True)
class VoxelRays:
    """Rays in voxels, whose parameter is a length in world units, counted from near the middle of the box.

    Attributes:
        origin: Three coordinates.
        direction: Three, in voxels per unit of length.
        inverse: Three, their inverses; 0 where a ray does not move along an axis.
        begin: Three, -origin times these, or infinity: planes w are at the parameters w inverse + begin.
        near: Where a ray enters the box, or begins.
        far: Where it leaves it, or ends; at most ``near`` where it misses.
    """

    origin: tuple[Any, Any, Any]
    direction: tuple[Any, Any, Any]
    inverse: tuple[Any, Any, Any]
    begin: tuple[Any, Any, Any]
    near: Any
    far: Any


@dataclass(frozen=True)
class Piece:
    """What of a ray is in one cell.

    Attributes:
        index: Of the cell's value, or of that at its lower corner.
        walls: Three planes at which the ray would leave the cell.
        ahead: Three flags, whether it runs towards greater coordinates.
        begin: Where it enters the cell.
        end: Where it leaves it.
    """

    index: Any
    walls: list[Any]
    ahead: list[Any]
    begin: Any
    end: Any


def rays_of(b: Backend, voxels: Voxels, view: list[Any], pixel: tuple[Any, Any], ends: tuple[Any, Any]) -> VoxelRays:
    """Rays to the middles of pixels, cut to the box.

    Args:
        b: Back end of the arrays.
        voxels: The volume.
        view: `NUMBERS_OF_VIEW` numbers per ray, in voxels: origin, its steps by column and by row; direction, likewise.
        pixel: Column and row.
        ends: Where rays begin and end, in directions.
    """
    column, row = b.Float(pixel[0]), b.Float(pixel[1])
    origin, direction = (
        [dr.fma(view[k + 6 + a], row, dr.fma(view[k + 3 + a], column, view[k + a])) for a in range(3)] for k in (0, 9)
    )
    world = [direction[a] * voxels.sides[a] for a in range(3)]
    length = dr.sqrt(dr.fma(world[0], world[0], dr.fma(world[1], world[1], world[2] * world[2])))
    direction = [part / length for part in direction]
    squared = dr.fma(direction[0], direction[0], dr.fma(direction[1], direction[1], direction[2] * direction[2]))
    # Counted from the place that is nearest to the box's middle, a ray from far away loses no digits there.
    offset = [voxels.middle[a] - origin[a] for a in range(3)]
    shift = dr.fma(offset[0], direction[0], dr.fma(offset[1], direction[1], offset[2] * direction[2])) / squared
    origin = [dr.fma(direction[a], shift, origin[a]) for a in range(3)]
    near, far = dr.fma(ends[0], length, -shift), dr.fma(ends[1], length, -shift)
    size = dr.sqrt(squared)
    inverse, begin = [], []
    for axis in range(3):
        # So slow along an axis, a ray crosses none of its planes: they are at infinity.
        still = dr.abs(direction[axis]) <= _STILL * size
        inverse.append(dr.select(still, 0.0, 1.0 / direction[axis]))
        begin.append(dr.select(still, dr.inf, -origin[axis] * inverse[axis]))
        lower, upper = (dr.fma(side, inverse[axis], begin[axis]) for side in (voxels.lower, voxels.upper[axis]))
        between = (origin[axis] >= voxels.lower) & (origin[axis] < voxels.upper[axis])
        enter, leave = dr.select(lower < upper, lower, upper), dr.select(lower < upper, upper, lower)
        near = dr.fmax(near, dr.select(still, dr.select(between, -dr.inf, dr.inf), enter))
        far = dr.fmin(far, dr.select(still, dr.select(between, dr.inf, -dr.inf), leave))
    return VoxelRays(_three(origin), _three(direction), _three(inverse), _three(begin), near, far)


def integrate(b: Backend, voxels: Voxels, rays: VoxelRays, linear: bool) -> Any:
    """Integrals of the volume along rays.

    Args:
        b: Back end of the arrays.
        voxels: The volume.
        rays: The rays.
        linear: Whether values are trilinear between the middles of voxels, which the planes run through then, or
            constant in voxels, which they bound.
    """

    def add(total: Any, cell: Piece) -> Any:
        if linear:
            mean = _mean(b, voxels, rays, cell)
        else:
            mean = dr.gather(b.Float, voxels.values, cell.index)
        return dr.fma(mean, cell.end - cell.begin, total)

    return walk(b, voxels, rays, add, b.Float(0))


def walk(b: Backend, voxels: Voxels, rays: VoxelRays, visit: Callable[[Any, Piece], Any], total: Any) -> Any:
    """Follow rays from cell to cell, and return what is left of a state.

    Args:
        b: Back end of the arrays.
        voxels: The volume.
        rays: The rays.
        visit: Takes the state and a ray's piece in a cell, and returns the new state. A piece may have no length.
        total: The state to begin with, one array.
    """
    hit = rays.near < rays.far
    start = dr.select(hit, rays.near, 0.0)
    planes, cells, ahead = [], [], []
    for axis in range(3):
        forward = rays.direction[axis] > 0.0
        place = dr.floor(dr.fma(rays.direction[axis], start, rays.origin[axis]))
        cell = dr.fmin(dr.fmax(place, voxels.first), voxels.last[axis])
        planes.append(dr.select(forward, cell + 1.0, cell))
        cells.append(b.Int(cell - voxels.first))
        ahead.append(forward)
    index = b.UInt(cells[0]) + voxels.strides[0] * b.UInt(cells[1]) + voxels.strides[1] * b.UInt(cells[2])
    strides = (b.UInt(1), voxels.strides[0], voxels.strides[1])
    steps = [dr.select(on, by, b.UInt(0) - by) for on, by in zip(ahead, strides)]
    signs = [dr.select(on, b.Float(1), b.Float(-1)) for on in ahead]

    def running(t: Any, *state: Any) -> Any:
        return hit & (t < rays.far)

    def advance(t: Any, total: Any, index: Any, x: Any, y: Any, z: Any) -> tuple[Any, ...]:
        walls = [x, y, z]
        times = [dr.fma(walls[axis], rays.inverse[axis], rays.begin[axis]) for axis in range(3)]
        first = dr.fmin(times[0], dr.fmin(times[1], times[2]))
        end = dr.fmax(t, dr.fmin(first, rays.far))
        total = visit(total, Piece(index, walls, ahead, t, end))
        on_x = times[0] == first
        on_y = ~on_x & (times[1] == first)
        crossed = (on_x, on_y, ~(on_x | on_y))
        left = first < rays.far  # else the ray ends here, and there need not be a next one
        for axis in range(3):
            moves = crossed[axis] & left
            walls[axis] = dr.select(moves, walls[axis] + signs[axis], walls[axis])
            index = dr.select(moves, index + steps[axis], index)
        return dr.select(left, end, rays.far), total, index, walls[0], walls[1], walls[2]

    state = (start, total, index, planes[0], planes[1], planes[2])
    return dr.while_loop(state, running, advance, label="integrate_voxels")[1]


def _mean(b: Backend, voxels: Voxels, rays: VoxelRays, cell: Piece) -> Any:
    """Mean between two places in a cell of what is trilinear there, and so cubic along the ray."""
    y, z = voxels.strides
    corners = [
        dr.gather(b.Float, voxels.values, cell.index + shift)
        for shift in (0, y, z, y + z, b.UInt(1), y + 1, z + 1, y + z + 1)
    ]
    middle, half = 0.5 * (cell.begin + cell.end), cell.end - cell.begin
    base = [dr.select(ahead, wall - 1.0, wall) for ahead, wall in zip(cell.ahead, cell.walls)]
    total = b.Float(0)
    for sign in (-_GAUSS, _GAUSS):
        t = dr.fma(half, sign, middle)
        u, v, w = (dr.fmin(dr.fmax(dr.fma(rays.direction[a], t, rays.origin[a]) - base[a], 0.0), 1.0) for a in range(3))
        c = [dr.fma(far - near, u, near) for near, far in zip(corners[:4], corners[4:])]
        lower, upper = dr.fma(c[1] - c[0], v, c[0]), dr.fma(c[3] - c[2], v, c[2])
        total += dr.fma(upper - lower, w, lower)
    return 0.5 * total


def _three(values: Any) -> tuple[Any, Any, Any]:
    first, second, third = values
    return first, second, third
