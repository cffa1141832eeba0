"""The Dr.Jit kernel that marches rays through a scalar volume and a transfer function."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend

# Rays stop at this transmittance; what lies behind changes no premultiplied value by more.
TRANSMITTANCE_THRESHOLD = 1e-6
# Below this optical depth of a step, 1 - exp(-x) cancels in float32 and its series is exact to rounding.
_SERIES_LIMIT = 0.1


@dataclass(frozen=True)
class VolumeTables:
    """Device arrays of a volume, its empty space and its transfer function.

    Attributes:
        corners: (nx * ny * nz * 4) scalars at (y, z), (y+1, z), (y, z+1), (y+1, z+1) of every sample, x fastest.
        resolution: Opaque numbers of samples (nx, ny, nz).
        clearance: (bx * by * bz) per block of cells: 0 if something in it may be visible, else the Chebyshev distance,
            in blocks, to the nearest such block.
        blocks: Opaque numbers of blocks (bx, by, bz).
        block_size: Opaque number of cells along an edge of a block.
        knots: (K + 2, 2) position of a knot and 1 / distance to the next (0 where there is none).
        values: (K + 2, 4) colour and attenuation coefficient (attenuation * opacity) at the knots.
        knot_count: Opaque K + 1, the number of rows that begin an interval.
        search_steps: Halvings that a binary search over these rows needs.
    """

    corners: Any
    resolution: tuple[Any, Any, Any]
    clearance: Any
    blocks: tuple[Any, Any, Any]
    block_size: Any
    knots: Any
    values: Any
    knot_count: Any
    search_steps: int


@dataclass(frozen=True)
class Rays:
    """Rays in the volume's voxel coordinates, cut to the box; all members are device arrays.

    Attributes:
        origin: Three coordinates of the point where the ray enters, in voxels.
        step: Three coordinates of the way between two sample points, in voxels.
        count: Number of steps up to the exit; 0 for rays that miss the box.
        length: Length of a step in world units.
    """

    origin: tuple[Any, Any, Any]
    step: tuple[Any, Any, Any]
    count: Any
    length: Any


def enter_box(
    b: Backend,
    camera: list[Any],
    pixel: tuple[Any, Any],
    lower: list[Any],
    cell_size: list[Any],
    samples: list[Any],
    steps_per_unit: Any,
) -> Rays:
    """Rays through pixels' centres, cut to the box and divided into equal steps.

    Args:
        b: Back end of the arrays.
        camera: 16 numbers per ray: world-to-camera rotation row by row, the camera's position, fx, fy, cx, cy.
        pixel: Column and row of each ray's pixel.
        lower: Three coordinates of the box's lower corner in world space.
        cell_size: Distances of samples in world space.
        samples: Numbers of samples along the axes.
        steps_per_unit: Steps per unit of length; the number of steps is rounded up.
    """
    x = (b.Float(pixel[0]) + 0.5 - camera[14]) / camera[12]
    y = (b.Float(pixel[1]) + 0.5 - camera[15]) / camera[13]
    norm = 1.0 / dr.sqrt(dr.fma(x, x, dr.fma(y, y, 1.0)))  # rsqrt of float64 has 20 bits on CUDA
    near, far = b.Float(0.0), b.Float(dr.inf)
    origin, direction = [], []
    for axis in range(3):
        world = norm * dr.fma(camera[axis], x, dr.fma(camera[3 + axis], y, camera[6 + axis]))
        position = (camera[9 + axis] - lower[axis]) / cell_size[axis]
        direction.append(world / cell_size[axis])
        origin.append(position)
        extent = b.Float(samples[axis] - 1)
        at_lower, at_upper = -position / direction[axis], (extent - position) / direction[axis]
        # A ray in the plane of a side gives 0 / 0 here; fmin and fmax then keep the other operand.
        near = dr.fmax(near, dr.fmin(at_lower, at_upper))
        far = dr.fmin(far, dr.fmax(at_lower, at_upper))
    hit = far > near
    length = dr.select(hit, far - near, 0.0)
    count = b.UInt(dr.ceil(length * steps_per_unit))
    step = dr.select(hit, length / dr.fmax(b.Float(count), 1.0), 0.0)
    near = dr.select(hit, near, 0.0)
    return Rays(
        origin=_three(dr.fma(direction[axis], near, origin[axis]) for axis in range(3)),
        step=_three(direction[axis] * step for axis in range(3)),
        count=count,
        length=step,
    )


def march(b: Backend, tables: VolumeTables, rays: Rays) -> tuple[Any, Any, Any, Any]:
    """Premultiplied radiance (red, green, blue) over black, and alpha, by the mid-point rule.

    Every step has the colour and the attenuation coefficient of its middle: the scalar is interpolated trilinearly
    there and then classified by the transfer function. Empty blocks are stepped over; steps keep their places.
    """

    def running(k: Any, check: Any, light: Any) -> Any:
        return (k < rays.count) & (light[3] > TRANSMITTANCE_THRESHOLD)

    def advance(k: Any, check: Any, light: Any) -> tuple[Any, Any, Any]:
        middle = b.Float(k) + 0.5
        point = _three(dr.fma(middle, rays.step[axis], rays.origin[axis]) for axis in range(3))
        k, check = dr.if_stmt(
            (k, check),
            k >= check,
            lambda k, check: _skip_empty(b, tables, rays, k, point),
            lambda k, check: (k, check),
        )
        light = dr.if_stmt(
            (light,),
            k < check,
            lambda light: _composite(b, tables, rays, point, light),
            lambda light: light,
        )
        return dr.select(k < check, k + 1, k), check, light

    light = (b.Float(0), b.Float(0), b.Float(0), b.Float(1), b.Float(0))
    _, _, light = dr.while_loop((b.UInt(0), b.UInt(0), light), running, advance, label="march_volume")
    red, green, blue, transmittance, lost = light
    return red, green, blue, dr.fmin(dr.fmax((1.0 - transmittance) - lost, 0.0), 1.0)


def _composite(b: Backend, tables: VolumeTables, rays: Rays, point: Any, light: Any) -> tuple[Any, ...]:
    """Light (red, green, blue, transmittance, what rounding has cut from the transmittance) behind one more step."""
    red, green, blue, transmittance, lost = light
    color, attenuation = _classify(b, tables, _trilinear(b, tables, *point))
    weight = transmittance * _opacity(attenuation * rays.length)
    red, green, blue = dr.fma(weight, color[0], red), dr.fma(weight, color[1], green), dr.fma(weight, color[2], blue)
    # Compensated: in thin media a step takes less from the transmittance than its last bit holds.
    change = lost - weight
    behind = transmittance + change
    return red, green, blue, behind, change - (behind - transmittance)


def _skip_empty(b: Backend, tables: VolumeTables, rays: Rays, k: Any, point: Any) -> tuple[Any, Any]:
    """The next sample that may be visible, and the first one behind it whose block is not known."""
    end, empty = _block_end(b, tables, rays, k, point)
    return dr.select(empty, end, k), end


def _block_end(b: Backend, tables: VolumeTables, rays: Rays, k: Any, point: tuple[Any, Any, Any]) -> tuple[Any, Any]:
    """First sample behind the block at ``point``, or behind the empty space around it; whether it is empty."""
    size = b.Float(tables.block_size)
    block = []
    for axis in range(3):
        position = dr.fmin(dr.floor(dr.fmax(point[axis], 0.0) / size), b.Float(tables.blocks[axis] - 1))
        block.append(b.UInt(position))
    index = block[0] + tables.blocks[0] * (block[1] + tables.blocks[1] * block[2])
    clearance = dr.gather(b.UInt, tables.clearance, index)
    reach = dr.fmax(b.Float(clearance), 1.0)
    steps = b.Float(rays.count)
    for axis in range(3):
        forward = rays.step[axis] > 0.0
        side = dr.select(forward, b.Float(block[axis]) + reach, b.Float(block[axis]) + 1.0 - reach) * size
        to_side = dr.select(rays.step[axis] == 0.0, steps, (side - point[axis]) / rays.step[axis])
        # Rounding may put a point just outside its block, so that its side lies behind it.
        steps = dr.fmin(steps, dr.fmax(to_side, 0.0))
    return k + b.UInt(steps) + 1, clearance > 0


def _trilinear(b: Backend, tables: VolumeTables, x: Any, y: Any, z: Any) -> Any:
    nx, ny, nz = tables.resolution
    cell, weight = [], []
    for coordinate, samples in ((x, nx), (y, ny), (z, nz)):
        last = b.Float(samples - 2)
        base = dr.fmax(dr.fmin(dr.floor(coordinate), last), 0.0)
        cell.append(b.UInt(base))
        weight.append(coordinate - base)
    index = cell[0] + nx * (cell[1] + ny * cell[2])
    near = dr.gather(b.Float4, tables.corners, index)
    far = dr.gather(b.Float4, tables.corners, index + 1)
    face = dr.fma(far - near, weight[0], near)
    lower, upper = dr.fma(face[1] - face[0], weight[1], face[0]), dr.fma(face[3] - face[2], weight[1], face[2])
    return dr.fma(upper - lower, weight[2], lower)


def _classify(b: Backend, tables: VolumeTables, scalar: Any) -> tuple[tuple[Any, Any, Any], Any]:
    """Colour and attenuation coefficient at a scalar."""
    # The last knot at or below the scalar; knot 0 is a sentinel below every scalar.
    knot = b.UInt(0)
    for halving in reversed(range(tables.search_steps)):
        candidate = knot + (1 << halving)
        inside = candidate < tables.knot_count
        position = dr.gather(b.Float, tables.knots, 2 * candidate, inside)
        knot = dr.select(inside & (position <= scalar), candidate, knot)
    position = dr.gather(b.Float2, tables.knots, knot)
    lower = dr.gather(b.Float4, tables.values, knot)
    upper = dr.gather(b.Float4, tables.values, knot + 1)
    value = dr.fma(upper - lower, (scalar - position[0]) * position[1], lower)
    return (value[0], value[1], value[2]), value[3]


def _opacity(depth: Any) -> Any:
    """1 - exp(-depth) without cancellation."""
    series = dr.fma(dr.fma(dr.fma(dr.fma(depth, 1 / 120, -1 / 24), depth, 1 / 6), depth, -0.5), depth, 1.0) * depth
    return dr.select(depth < _SERIES_LIMIT, series, 1.0 - dr.exp(-depth))


def _three(values: Any) -> tuple[Any, Any, Any]:
    first, second, third = values
    return first, second, third
