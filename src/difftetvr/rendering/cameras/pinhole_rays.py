"""The rays of pinhole cameras in kernels (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.rendering.traversal.rays import (
    Frame,
    Lanes,
    lane_count,
    lane_pixel,
    largest_coordinate,
    pixel_lane,
    rounding_of,
)

if TYPE_CHECKING:
    from difftetvr.rendering.cameras.pinhole import Camera

# Beyond what rounding moves a projection by, for images of up to 64 k pixels; the exact rule decides.
_MARGIN = 0.0625
_NEAR_PLANE = 2.0**-8  # points nearer to the camera's plane, in units of their distance, are not projected


@dataclass
class PinholeRays:
    """Intrinsics and image size in memory, so that a new view needs no recompilation; see `ImageRays`.

    Lanes without a pixel cost little, but threads share lanes, and not pixels. So where an image is no whole number of
    blocks, tables tell the pixel of each lane, and the lane of each pixel.
    """

    size: tuple[int, int]
    order: Any | None
    places: Any | None
    intrinsics: Any
    width: Any  # values of their own, not gathered ones: 0 in masked lanes, which integer division does not survive
    height: Any

    @staticmethod
    def of(backend: Backend, camera: Camera) -> PinholeRays:
        """Upload a camera's intrinsics."""
        values = [camera.fx, camera.fy, camera.cx, camera.cy, 1.0 / camera.fx, 1.0 / camera.fy]
        from difftetvr.rendering.prepared_rays import lane_order, lane_places  # late: cameras are there without bundles

        size, shape, order, places = (camera.width, camera.height), (camera.height, camera.width), None, None
        if lane_count(*size) > camera.width * camera.height:
            order, places = lane_order(backend, shape), lane_places(backend, shape)
        width, height = (backend.constant(pixels) for pixels in size)
        return PinholeRays(size, order, places, backend.Float(values), width, height)

    def _intrinsic(self, place: int) -> Any:
        """fx, fy, cx, cy, 1 / fx or 1 / fy."""
        return dr.gather(type(self.intrinsics), self.intrinsics, type(self.width)(place))

    @property
    def count(self) -> int:
        """Number of pixels."""
        return self.size[0] * self.size[1]

    @property
    def lane_count(self) -> int:
        """Number of lanes: one for each pixel, or the size rounded up to whole blocks."""
        return lane_count(*self.size) if self.order is None else self.count

    def of_lanes(self, lane: Any) -> Lanes:
        """Neighbouring lanes see neighbouring pixels, so rays share cells in cache."""
        if self.order is None:
            column, row, valid = lane_pixel(self, lane)
            return Lanes(row * self.width + column, valid, self.frame(column, row))
        valid = lane < self.width * self.height
        pixel = dr.gather(type(self.width), self.order, lane, valid)
        return Lanes(pixel, valid, self.of_pixels(pixel))

    def lane_of(self, column: Any, row: Any) -> Any:
        """The lane of a pixel."""
        if self.places is None:
            return pixel_lane(self, column, row)
        return dr.gather(type(self.width), self.places, row * self.width + column)

    def of_pixels(self, pixel: Any) -> Frame:
        """Frames of the rays of some pixels."""
        row = pixel // self.width
        return self.frame(pixel - row * self.width, row)

    def frame(self, column: Any, row: Any) -> Frame:
        """Frame of the ray through the centre of a pixel (Duff et al. 2017, branch-free because z > 0)."""
        float_t = type(self.intrinsics)
        cx, cy, inverse_fx, inverse_fy = (self._intrinsic(place) for place in (2, 3, 4, 5))
        x = ((float_t(column) + 0.5) - cx) * inverse_fx
        y = ((float_t(row) + 0.5) - cy) * inverse_fy
        z = 1.0 / dr.sqrt(dr.fma(x, x, dr.fma(y, y, float_t(1))))
        x, y = x * z, y * z
        inverse = -1.0 / (1.0 + z)
        xy = x * y * inverse
        a = (dr.fma(x * x, inverse, float_t(1)), xy, -x)
        b = (xy, dr.fma(y * y, inverse, float_t(1)), -y)
        return Frame(a, b, (x, y, z))

    def pixel_range(self, backend: Backend, points: list[list[Any]]) -> tuple[tuple[Any, Any], tuple[Any, Any], Any]:
        """Pixels that may see the convex hull of some points in camera space.

        Returns:
            First and last column, first and last row, and whether there are any.
        """
        real = backend.Float
        size, farthest = largest_coordinate(points), real(-dr.inf)
        for point in points:
            farthest = dr.fmax(farthest, point[2])
        # Points behind the camera, or so near to its plane that rounding moves their projection, have no place in it.
        ahead = [point[2] > size * _NEAR_PLANE for point in points]
        box = []
        for axis, scale, center, pixels in (
            (0, self._intrinsic(0), self._intrinsic(2), self.width),
            (1, self._intrinsic(1), self._intrinsic(3), self.height),
        ):
            low, high = _projection(points, axis, ahead, size)
            last = real(pixels) - 1.0
            # Pixel i's ray goes through i + 1/2: those from ceil(low - 1/2) to floor(high - 1/2) may see the face.
            begin = dr.ceil(low * scale + center - (0.5 + _MARGIN))
            end = dr.floor(high * scale + center - (0.5 - _MARGIN))
            begin, end = dr.fmin(dr.fmax(begin, 0.0), last + 1.0), dr.fmin(dr.fmax(end, -1.0), last)
            box.append((backend.Int(begin), backend.Int(end)))
        columns, rows = box
        visible = (farthest > -rounding_of(size)) & (columns[1] >= columns[0]) & (rows[1] >= rows[0])
        return columns, rows, visible


def _projection(points: list[list[Any]], axis: int, ahead: list[Any], size: Any) -> tuple[Any, Any]:
    """Range of x / z, or y / z, over the part of a convex hull in front of the camera; infinite where it has no end.

    Seen from a point ahead, one that is not lies on the one side or on the other. On this side there is no end, on the
    other one the points ahead are.
    """
    infinity = dr.inf + 0.0 * size
    low, high, any_ahead = infinity, -infinity, dr.mask_t(size)(False)
    for point, is_ahead in zip(points, ahead, strict=True):
        value = point[axis] / point[2]
        low = dr.fmin(low, dr.select(is_ahead, value, infinity))
        high = dr.fmax(high, dr.select(is_ahead, value, -infinity))
        any_ahead |= is_ahead
    for one, is_ahead in zip(points, ahead, strict=True):
        for other, other_is_ahead in zip(points, ahead, strict=True):
            if one is other:
                continue
            crosses = is_ahead & ~other_is_ahead
            side = other[axis] * one[2] - one[axis] * other[2]
            sure = rounding_of(size) * (dr.abs(one[axis]) + dr.abs(other[axis]) + dr.abs(one[2]) + dr.abs(other[2]))
            low = dr.select(crosses & (side < sure), -infinity, low)
            high = dr.select(crosses & (side > -sure), infinity, high)
    return dr.select(any_ahead, low, -infinity), dr.select(any_ahead, high, infinity)
