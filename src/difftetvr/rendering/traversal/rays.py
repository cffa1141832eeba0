"""Rays, their pixels, and the exact 2-D predicates that every renderer shares (Dr.Jit).

Each ray has an orthonormal frame (a, b, direction) with a x b = direction. A vertex seen by a ray is (a, b, t): its
offset from the ray's line and its distance along it. Whether a ray meets a face is decided by signs of 2-D edge
functions of (a, b) alone, never by comparing distances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr

from difftetvr.backend import Backend

_MOST_BLOCK_BITS = 6  # pixels are visited in Morton order inside blocks of 64 x 64, smaller ones in small images


@dataclass
class Frame:
    """Orthonormal frame of a ray; each axis is a tuple of three Dr.Jit floats in the space of the vertices.

    Attributes:
        a, b, direction: The axes.
        origin: Where the ray starts, likewise; None for that space's own origin, where a camera is.
    """

    a: tuple[Any, Any, Any]
    b: tuple[Any, Any, Any]
    direction: tuple[Any, Any, Any]
    origin: tuple[Any, Any, Any] | None = None

    @staticmethod
    def along(direction: tuple[Any, Any, Any], origin: tuple[Any, Any, Any]) -> Frame:
        """Frame of a ray of any unit direction (Duff et al. 2017)."""
        x, y, z = direction
        sign = dr.copysign(type(z)(1), z)
        inverse = -1.0 / (sign + z)
        xy = x * y * inverse
        a = (dr.fma(sign * x * x, inverse, 1.0), sign * xy, -sign * x)
        return Frame(a, (xy, dr.fma(y * y, inverse, sign), -y), direction, origin)

    def project(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """Coordinates (a, b, t) of a point; explicit fma, so that every kernel rounds alike."""
        if self.origin is not None:
            x, y, z = x - self.origin[0], y - self.origin[1], z - self.origin[2]
        return tuple(dr.fma(e[0], x, dr.fma(e[1], y, e[2] * z)) for e in (self.a, self.b, self.direction))

    def unproject(self, a: Any, b: Any, t: Any) -> tuple[Any, Any, Any]:
        """A vector given in this frame, in the space of the vertices."""
        return tuple(dr.fma(self.a[k], a, dr.fma(self.b[k], b, self.direction[k] * t)) for k in range(3))


@dataclass
class Lanes:
    """The rays of a kernel's lanes.

    Attributes:
        pixel: Index of each ray's pixel in the image, row by row, or of the ray in its bundle.
        valid: Whether a lane has one.
        frame: Where the rays run.
    """

    pixel: Any
    valid: Any
    frame: Frame


class KernelRays(Protocol):
    """The rays of a view as kernels read them, in device values."""

    @property
    def count(self) -> int:
        """Number of rays."""
        ...

    @property
    def lane_count(self) -> int:
        """Number of lanes that a kernel needs for them: some may have no ray."""
        ...

    def of_lanes(self, lane: Any) -> Lanes:
        """The rays of some lanes; explicit fma, so that every kernel rounds alike."""
        ...

    def of_pixels(self, pixel: Any) -> Frame:
        """Frames of the rays of some pixels, the same as in their lanes."""
        ...


class ImageRays(KernelRays, Protocol):
    """Rays of a camera, from the origin through the pixels of an image.

    A camera model that can be rasterised is a camera and one of these beside it.

    Attributes:
        size: Width and height of the image in pixels.
        width, height: The same as device values.
    """

    size: tuple[int, int]
    width: Any
    height: Any

    def frame(self, column: Any, row: Any) -> Frame:
        """Frame of the ray of a pixel."""
        ...

    def lane_of(self, column: Any, row: Any) -> Any:
        """The lane of a pixel, the inverse of :meth:`of_lanes`."""
        ...

    def pixel_range(self, backend: Backend, points: list[list[Any]]) -> tuple[tuple[Any, Any], tuple[Any, Any], Any]:
        """Pixels that may see the convex hull of some points in camera space: rather too many than too few.

        Returns:
            First and last column, first and last row, and whether there are any.
        """
        ...


def largest_coordinate(points: list[list[Any]]) -> Any:
    """Greatest coordinate of some points."""
    size = type(points[0][0])(0)
    for point in points:
        for value in point:
            size = dr.fmax(size, dr.abs(value))
    return size


def rounding_of(size: Any) -> Any:
    """By how much, at most, a ray's frame moves points of which ``size`` is the greatest coordinate."""
    return 16.0 * dr.epsilon(size) * size


def _block_bits(size: tuple[int, int]) -> int:
    """Binary logarithm of the side of a block in an image of some width and height."""
    return min((max(size) - 1).bit_length(), _MOST_BLOCK_BITS)


def lane_count(width: int, height: int) -> int:
    """Number of kernel lanes for an image: its size rounded up to whole blocks."""
    block = 1 << _block_bits((width, height))
    return -(-width // block) * -(-height // block) * block * block


def lane_pixel(image: ImageRays, lane: Any) -> tuple[Any, Any, Any]:
    """Column, row and validity of a lane: neighbouring lanes see neighbouring pixels, so rays share cells in cache."""
    bits = _block_bits(image.size)
    mask = (1 << bits) - 1
    blocks_per_row = (image.width + mask) >> bits
    block = lane >> (2 * bits)
    block_row = block // blocks_per_row
    block_column = block - block_row * blocks_per_row
    column = (block_column << bits) + (_even_bits(lane) & mask)
    row = (block_row << bits) + (_even_bits(lane >> 1) & mask)
    return column, row, (column < image.width) & (row < image.height)


def pixel_lane(image: ImageRays, column: Any, row: Any) -> Any:
    """The lane of a pixel: the inverse of :func:`lane_pixel`."""
    bits = _block_bits(image.size)
    mask = (1 << bits) - 1
    blocks_per_row = (image.width + mask) >> bits
    block = (row >> bits) * blocks_per_row + (column >> bits)
    return (block << (2 * bits)) + _spread_bits(column & mask) + (_spread_bits(row & mask) << 1)


def _spread_bits(code: Any) -> Any:
    """Put six bits at the even places of a Morton code."""
    code = (code | (code << 4)) & 0x30F
    code = (code | (code << 2)) & 0x333
    return (code | (code << 1)) & 0x555


def _even_bits(code: Any) -> Any:
    """Gather the six even bits of a Morton code."""
    code = code & 0x555
    code = (code | (code >> 1)) & 0x333
    code = (code | (code >> 2)) & 0x30F
    return (code | (code >> 4)) & 0x3F


def edge_function(pa: Any, pb: Any, qa: Any, qb: Any) -> Any:
    """Twice the signed area of (ray, p, q) in the ray's plane, with an exact sign (Kahan's difference of products)."""
    product = pb * qa
    error = dr.fma(-pb, qa, product)
    return dr.fma(pa, qb, -product) + error


def is_left(edge: Any, pa: Any, pb: Any, qa: Any, qb: Any) -> Any:
    """Sign of an edge function; ties are broken as if the ray were shifted by (eps, eps^2).

    Antisymmetric in p and q, so the cells on both sides of an edge always agree.
    """
    return (edge > 0) | ((edge == 0) & ((pb > qb) | ((pb == qb) & (qa > pa))))
