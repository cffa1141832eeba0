"""Line integrals of N^3 voxels that are constant inside, and the exact transpose, view by view (Dr.Jit).

Forward is the product's own walk from voxel to voxel (Siddon); the transpose is the same walk, which adds where the
other reads. So the two agree to rounding, and iterations with both descend.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import torch

from difftetvr.backend import get_backend
from difftetvr.capture.projections.geometry import ProjectionGeometry
from difftetvr.capture.projections.projector import tiled_order, view_table
from difftetvr.capture.projections.projector_kernel import (
    NUMBERS_OF_VIEW,
    Piece,
    VoxelRays,
    Voxels,
    integrate,
    rays_of,
    walk,
)


class VoxelProjector:
    """The matrix A of line integrals of voxels, a row for each pixel, which nobody ever stores.

    Volumes are flat float32, x fastest: (N, N, N) in z, y, x.
    """

    def __init__(self, geometry: ProjectionGeometry, size: int) -> None:
        """For the views of a geometry, whose bounds are filled by ``size``^3 voxels."""
        self.geometry, self.size = geometry, size
        detector, self._b = geometry.detector, get_backend("cpu")
        lower, upper = geometry.bounds.numpy()
        sides = (upper - lower) / size
        self._table = torch.from_numpy(view_table(detector, lower, sides, 0.0)).float()
        self._ends = (0.0, 1.0) if detector.source is not None else (-math.inf, math.inf)
        self._width = detector.width
        self.pixels = detector.width * detector.height
        self._order = torch.from_numpy(tiled_order(detector.width, detector.height).astype(np.int32))
        self._sides = sides.tolist()

    def forward(self, volume: torch.Tensor, views: list[int]) -> torch.Tensor:
        """(views, pixels) line integrals."""
        with self._b.exclusive():
            return self._integrals(self._b.floats(volume), views)

    def lengths(self, views: list[int]) -> torch.Tensor:
        """(views, pixels) lengths of the rays in the box: the line integrals of 1."""
        with self._b.exclusive():
            rays, place, _ = self._rays(self._voxels(self._b.Float(0)), views)
            return self._placed(dr.select(rays.near < rays.far, rays.far - rays.near, 0.0), place, views)

    def transpose(self, values: torch.Tensor, views: list[int]) -> torch.Tensor:
        """(N^3) sums over rays of their length in each voxel times their value, (views, pixels).

        Each thread adds to a copy of its own: atomic additions take several times as long.
        """
        b = self._b
        with b.exclusive():
            sums = dr.zeros(b.Float, self.size**3)
            voxels = self._voxels(sums)
            rays, place, active = self._rays(voxels, views)
            value = dr.gather(b.Float, b.floats(values), place, active)

            def add(total: Any, cell: Piece) -> Any:
                part = value * (cell.end - cell.begin)
                dr.scatter_add(sums, part, cell.index, cell.end > cell.begin, mode=dr.ReduceMode.Expand)
                return total

            walk(b, voxels, rays, add, b.Float(0))
            return b.tensor(sums)

    def _integrals(self, values: Any, views: list[int]) -> torch.Tensor:
        voxels = self._voxels(values)
        rays, place, _ = self._rays(voxels, views)
        return self._placed(integrate(self._b, voxels, rays, False), place, views)

    def _placed(self, values: Any, place: Any, views: list[int]) -> torch.Tensor:
        output = dr.zeros(self._b.Float, len(views) * self.pixels)
        dr.scatter(output, values, place)
        return self._b.tensor(output, len(views), self.pixels)

    def _rays(self, voxels: Voxels, views: list[int]) -> tuple[VoxelRays, Any, Any]:
        """Rays of some views tile by tile, the places of their pixels, and which of them meet the box."""
        b = self._b
        ray = dr.arange(b.UInt, self.pixels * len(views))
        pixels, width = b.opaque_uint(self.pixels), b.opaque_uint(self._width)
        view = ray // pixels
        pixel = dr.gather(b.UInt, b.uints(self._order), ray - view * pixels)
        row = pixel // width
        table = b.floats(self._table[views])
        numbers = [dr.gather(b.Float, table, view * NUMBERS_OF_VIEW + k) for k in range(NUMBERS_OF_VIEW)]
        ends = (b.opaque(self._ends[0]), b.opaque(self._ends[1]))
        rays = rays_of(b, voxels, numbers, (pixel - row * width, row), ends)
        return rays, view * pixels + pixel, rays.near < rays.far

    def _voxels(self, values: Any) -> Voxels:
        b, size = self._b, float(self.size)
        x, y, z = (b.opaque(side) for side in self._sides)
        return Voxels(
            values=values,
            lower=b.opaque(0.0),
            upper=(b.opaque(size),) * 3,
            first=b.opaque(0.0),
            last=(b.opaque(size - 1.0),) * 3,
            strides=(b.opaque_uint(self.size), b.opaque_uint(self.size**2)),
            sides=(x, y, z),
            middle=(b.opaque(0.5 * size),) * 3,
        )
