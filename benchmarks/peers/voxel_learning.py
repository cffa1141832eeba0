"""Kernels of the voxel grid's optimiser: batches of rays, the loss, total variation, steps (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
from voxel_kernels import Lattice, Rays, Samples, add_to_sums

_SMALLEST = 1e-9
_EPSILON = 1e-8


@dataclass
class RayTable:
    """All rays to learn from.

    Attributes:
        origin: Positions of the cameras, in records of four.
        direction: Unit direction and number of the camera of each ray.
        truth: Colour over black, and alpha, of each ray's pixel.
    """

    origin: Any
    direction: Any
    truth: Any


@dataclass
class Smoothing:
    """Vertices of which total variation is taken: consecutive ones, that are others in each step.

    Attributes:
        lane: Numbers, from 0, of their packets of four values.
        first: Row of the first one, as a device value.
        count: Number of all rows, likewise.
        next: Rows of the vertices behind each along x, y and z, in records of four; its own where there is none.
        color: Weight of the variation of coefficients, the mean over vertices.
        density: Weight of that of densities.
    """

    lane: Any
    first: Any
    count: Any
    next: Any
    color: float
    density: float


def take_batch(lattice: Lattice, table: RayTable, chosen: Any, background: Any) -> tuple[Rays, list[Any], list[Any]]:
    """Rays, what is behind them and what should be seen, for :func:`difftetvr.recording.replayed`.

    Args:
        lattice: For its array types.
        table: All rays.
        chosen: Numbers of those to take.
        background: A colour for each of them, in records of four.
    """
    four, place = lattice.backend.Float4, dr.arange(lattice.backend.UInt, dr.width(chosen))
    direction, truth = (dr.gather(four, source, chosen) for source in (table.direction, table.truth))
    origin = dr.gather(four, table.origin, lattice.backend.UInt(direction[3]))
    behind = dr.gather(four, background, place)
    rays = Rays([origin[k] for k in range(3)], [direction[k] for k in range(3)])
    colors = [behind[k] for k in range(3)]
    wanted = [dr.fma(1.0 - truth[3], colors[k], truth[k]) for k in range(3)]
    dr.eval(rays, colors, wanted)
    return rays, colors, wanted


def loss_adjoint(seen: list[Any], wanted: list[Any]) -> list[Any]:
    """Derivatives of the mean squared error by colours, for :func:`difftetvr.recording.replayed`."""
    scale = 2.0 / (3 * dr.width(seen[0]))
    result = [(s - w) * scale for s, w in zip(seen, wanted, strict=True)]
    dr.eval(result)
    return result


def gradient_of(
    lattice: Lattice,
    rows: Any,
    samples: Samples,
    direction: list[Any],
    adjoint: Any,
    lane: Any,
    smoothing: Smoothing,
    length: int,
) -> Any:
    """Derivatives of the loss and of total variation by the rows, for :func:`difftetvr.recording.replayed`.

    Args:
        lattice, rows, samples, direction, lane: As for :func:`voxel_kernels.color_samples`.
        adjoint: The derivatives by samples.
        smoothing: Of what variation is taken.
        length: Floats in all rows.
    """
    sums = dr.zeros(lattice.backend.Float, length)
    add_variation(lattice, rows, smoothing, sums)
    add_to_sums(lattice, samples, direction, adjoint, lane, sums)
    dr.eval(sums)
    return sums


def add_variation(lattice: Lattice, rows: Any, smoothing: Smoothing, sums: Any) -> None:
    """Add the derivatives of the mean, over vertices, of the length of a value's differences along x, y and z."""
    backend, packets = lattice.backend, lattice.width // 4
    vertex = smoothing.first + smoothing.lane // packets
    vertex = dr.select(vertex < smoothing.count, vertex, vertex - smoothing.count)
    packet = smoothing.lane % packets
    behind = dr.gather(backend.UInt4, smoothing.next, vertex)
    own = dr.gather(backend.Float4, rows, dr.fma(vertex, packets, packet))
    others = [dr.gather(backend.Float4, rows, dr.fma(behind[k], packets, packet)) for k in range(3)]
    differences = [[other[i] - own[i] for other in others] for i in range(4)]
    scale = packets / dr.width(smoothing.lane)
    pulls = []
    for i, along in enumerate(differences):
        is_density = dr.fma(packet, 4, i) == lattice.density_place
        weight = dr.select(is_density, smoothing.density * scale, smoothing.color * scale)
        square = dr.fma(along[0], along[0], dr.fma(along[1], along[1], dr.fma(along[2], along[2], _SMALLEST)))
        pulls.append([weight * dr.rsqrt(square) * d for d in along])

    def body(k: Any) -> tuple[Any]:
        target = dr.select(k == 0, behind[0], dr.select(k == 1, behind[1], dr.select(k == 2, behind[2], vertex)))
        parts = [dr.select(k == 0, x, dr.select(k == 1, y, dr.select(k == 2, z, -(x + y + z)))) for x, y, z in pulls]
        place = dr.fma(target, packets, packet)
        dr.scatter_add(sums, backend.Float4(*parts), place, mode=dr.ReduceMode.NoConflicts)
        return (k + 1,)

    dr.while_loop((dr.zeros(backend.UInt, dr.width(vertex)),), lambda k: k < 4, body)


def take_step(
    lattice: Lattice, rows: Any, squares: Any, gradient: Any, rates: tuple[Any, Any], decay: float
) -> tuple[Any, Any]:
    """A step of RMSprop where there is a gradient, for :func:`difftetvr.recording.replayed`.

    Values of which nothing is said keep their means of squares; a first square is a first mean, as in Plenoxels.

    Args:
        lattice: Where vertices are.
        rows: What they hold.
        squares: Means of squared derivatives; 0 before the first.
        gradient: Derivatives by the rows.
        rates: Lengths of the steps of coefficients and of densities, as device values.
        decay: Share of the means that a step keeps.

    Returns:
        The new rows and means of squares.
    """
    lane = dr.arange(lattice.backend.UInt, dr.width(rows))
    rate = dr.select(lane % lattice.width == lattice.density_place, rates[1], rates[0])
    square = gradient * gradient
    mean = dr.select(squares == 0.0, square, dr.fma(decay, squares - square, square))
    mean = dr.select(square == 0.0, squares, mean)
    rows = rows - rate * gradient / (dr.sqrt(mean) + _EPSILON)
    dr.eval(rows, mean)
    return rows, mean


def densities_of_cells(lattice: Lattice, rows: Any, row: Any) -> Any:
    """The densities of the vertices of each cell that holds something, for :func:`difftetvr.recording.replayed`.

    Args:
        lattice: Where vertices are.
        rows: What they hold.
        row: The numbers of all rows.
    """
    real = lattice.backend.Float
    density = dr.gather(real, rows, dr.fma(row, lattice.width, lattice.density_place))
    dr.eval(density)
    of_cells = dr.gather(real, density, lattice.corners)
    dr.eval(of_cells)
    return of_cells


def seen_cells(lattice: Lattice, samples: Samples, lane: Any, least: float, count: int) -> Any:
    """A flag for each of ``count`` cells, whether a sample in it has at least some weight; likewise."""
    backend = lattice.backend
    number = dr.gather(backend.UInt, samples.link, dr.fma(lane, 4, 0))
    weight = dr.gather(backend.Float, samples.light, dr.fma(lane, 2, 0))
    flags = dr.zeros(backend.UInt, count)
    dr.scatter(flags, backend.UInt(1), number, (lane < samples.count) & (weight >= least))
    dr.eval(flags)
    return flags
