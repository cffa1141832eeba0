"""Rays that each have an origin and a direction of their own, in kernels (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.rendering.traversal.rays import Frame, Lanes


@dataclass
class BundleRays:
    """A bundle of rays; see :class:`difftetvr.rendering.traversal.rays.KernelRays`.

    Attributes:
        backend: Array types.
        lines: Flat (N, 6) origins and unit directions.
        order: (N,) number of the ray of each lane; None where lanes are numbered as rays are.
        size: N, as a device value.
        count: N.
    """

    backend: Backend
    lines: Any
    order: Any | None
    size: Any
    count: int

    @staticmethod
    def of(backend: Backend, lines: Any, order: Any | None) -> BundleRays:
        """Take flat (N, 6) origins and unit directions, and (N,) numbers of the lanes' rays."""
        count = dr.width(lines) // 6
        return BundleRays(backend, lines, order, backend.constant(count), count)

    @property
    def lane_count(self) -> int:
        """Number of lanes: one for each ray."""
        return self.count

    def of_lanes(self, lane: Any) -> Lanes:
        """The rays of some lanes."""
        valid = lane < self.size
        # Lanes behind the last ray read that of another.
        if self.order is None:
            pixel = dr.select(valid, lane, 0)
        else:
            pixel = dr.gather(self.backend.UInt, self.order, lane, valid)
        return Lanes(pixel, valid, self.of_pixels(pixel))

    def of_pixels(self, pixel: Any) -> Frame:
        """Frames of some rays by their numbers."""
        parts = [dr.gather(self.backend.Float2, self.lines, 3 * pixel + k) for k in range(3)]
        values = [value for part in parts for value in part]
        return Frame.along((values[3], values[4], values[5]), (values[0], values[1], values[2]))
