"""Meshes and fields laid out as walks read them, and gradients as callers want them (Dr.Jit kernels).

What is passed is looked over on the way: whether it is finite, and where it lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.rendering.search.starts import EXTENT
from difftetvr.rendering.traversal.records import PACKET, Records, packets_of
from difftetvr.rendering.traversal.sums import raise_to

LARGEST = 1e6
"""Greatest coordinate that is laid out; anything beyond would overflow in products of float32."""


@dataclass
class VertexSource:
    """What vertices are and hold, as flat arrays of the caller.

    Attributes:
        backend: Array types.
        order: (V,) the caller's number of each vertex in the order of memory.
        positions: (V, 3).
        pose: (4, 4) rigid transform to the space of the rays, None where positions are in it.
        value: (V,) density or scalar; None where vertices have neither.
        is_density: Whether the value is a density.
        channels: (V, C); None where vertices have none.
        channel_count: C.
    """

    backend: Backend
    order: Any
    positions: Any
    pose: Any | None
    value: Any | None
    is_density: bool
    channels: Any | None
    channel_count: int

    @property
    def stride(self) -> int:
        """Packets of a record: x, y, z and the value, then channels, so that for RGB one cache line holds it."""
        return 1 + (packets_of(self.channel_count) if self.channel_count else 0)


@dataclass
class CellSource:
    """What cells hold, as flat arrays of the caller.

    Attributes:
        backend: Array types.
        order: (T,) the caller's number of each cell in the order of memory.
        density: (T,); None where cells have none.
        channels: (T, C); None where C is 0.
        channel_count: C.
    """

    backend: Backend
    order: Any
    density: Any | None
    channels: Any | None
    channel_count: int


def lay_out_vertices(source: VertexSource, length: int) -> tuple[Any, Any]:
    """Records of vertices, for :func:`difftetvr.recording.replayed`.

    Args:
        source: What they hold.
        length: Number of records to make, at least V.

    Returns:
        Flat (length, 4 stride) records, and their extent.
    """
    real, uint, stride = source.backend.Float, source.backend.UInt, source.stride
    vertex, count = source.order, source.channel_count
    position = [dr.gather(real, source.positions, 3 * vertex + k) for k in range(3)]
    if source.pose is not None:
        position = _transformed(real, source.pose, position)
    value = real(0) if source.value is None else dr.gather(real, source.value, vertex)
    channels = [dr.gather(real, source.channels, count * vertex + k) for k in range(count)]
    values = [*position, value, *channels]
    extent, is_bad = dr.full(real, -dr.inf, EXTENT), _any_unbounded(values)
    if source.is_density:
        is_bad |= value < 0
    ends = [end for coordinate in position for end in (coordinate, -coordinate)]
    for k, end in enumerate([*ends, dr.select(is_bad, real(1), real(0))]):
        raise_to(source.backend, extent, end, k)
    # Searches go through what is too large for them, too, before the host hears of it.
    values[:3] = [dr.select(dr.abs(coordinate) <= LARGEST, coordinate, 0) for coordinate in position]
    values += [real(0)] * (PACKET * stride - len(values))
    records, place = dr.empty(real, PACKET * stride * length), dr.arange(uint, dr.width(vertex))
    dr.scatter(records, source.backend.Floats(values), place)
    dr.eval(records, extent)
    return records, extent


def lay_out_cells(source: CellSource, length: int) -> tuple[Any, Any]:
    """Records of cells' channels and densities, for :func:`difftetvr.recording.replayed`; likewise."""
    backend, cell, count = source.backend, source.order, source.channel_count
    density = backend.Float(0) if source.density is None else dr.gather(backend.Float, source.density, cell)
    channels = [dr.gather(backend.Float, source.channels, count * cell + k) for k in range(count)]
    extent = dr.full(backend.Float, -dr.inf, EXTENT)
    is_bad = _any_unbounded([density, *channels]) | (density < 0)
    raise_to(backend, extent, dr.select(is_bad, backend.Float(1), backend.Float(0)), EXTENT - 2)
    layout = Records(count)
    records, place = dr.empty(backend.Float, layout.width * length), dr.arange(backend.UInt, dr.width(cell))
    layout.scatter(backend, records, [*channels, density], place)
    dr.eval(records, extent)
    return records, extent


def any_extent(one: Any, other: Any) -> Any:
    """The extent of what has either of two."""
    extent = dr.fmax(one, other)
    dr.eval(extent)
    return extent


@dataclass
class GradientSource:
    """Gradients in the order of memory, as flat arrays.

    Attributes:
        backend: Array types.
        order: (V,) or (T,) the caller's number of each vertex or cell.
        vectors: (V, 4) by positions in the space of the rays, and by the value where there are no records; None if not
            wanted.
        pose: (4, 4) rigid transform to that space, None where callers' positions are in it.
        records: By channels and the value behind them; None if not wanted.
        channels: Number of channels C.
    """

    backend: Backend
    order: Any
    vectors: Any | None
    pose: Any | None
    records: Any | None
    channels: int


def collect(source: GradientSource, length: int) -> tuple[Any | None, Any | None, Any | None]:
    """Gradients in the caller's order and space, for :func:`difftetvr.recording.replayed`.

    Args:
        source: What there is.
        length: Number of rows to make, at least V or T.

    Returns:
        Flat (length, 3) by positions, (length, C) by channels, (length,) by the value; None where not wanted.
    """
    backend, order = source.backend, source.order
    real, place = backend.Float, dr.arange(backend.UInt, dr.width(source.order))
    positions = channels = values = None
    if source.vectors is not None:
        packet = dr.gather(backend.Float4, source.vectors, place)
        vector = [packet[0], packet[1], packet[2]]
        if source.pose is not None:
            rows = _rows(real, source.pose)
            vector = [
                dr.fma(rows[0][k], vector[0], dr.fma(rows[1][k], vector[1], rows[2][k] * vector[2])) for k in range(3)
            ]
        positions = dr.empty(real, 3 * length)
        dr.scatter(positions, backend.Floats(vector), order)
        if source.records is None:
            values = dr.empty(real, length)
            dr.scatter(values, packet[3], order)
    if source.records is not None:
        *by_channel, by_value = Records(source.channels).gather_sums(backend, source.records, place)
        channels, values = dr.empty(real, max(source.channels, 1) * length), dr.empty(real, length)
        if by_channel:
            dr.scatter(channels, backend.Floats(by_channel), order)
        dr.scatter(values, by_value, order)
    dr.eval(positions, channels, values)
    return positions, channels, values


def _rows(real: Any, pose: Any) -> list[list[Any]]:
    """The first three rows of a (4, 4) matrix."""
    number = dr.uint32_array_t(real)
    return [[dr.gather(real, pose, number(4 * i + j)) for j in range(4)] for i in range(3)]


def _transformed(real: Any, pose: Any, point: list[Any]) -> list[Any]:
    return [dr.fma(r[0], point[0], dr.fma(r[1], point[1], r[2] * point[2])) + r[3] for r in _rows(real, pose)]


def _any_unbounded(values: list[Any]) -> Any:
    is_bad = ~dr.isfinite(values[0])
    for value in values[1:]:
        is_bad |= ~dr.isfinite(value)
    return is_bad
