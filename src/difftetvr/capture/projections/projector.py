"""``project_volume``: what a tomograph measures of voxels, as exact integrals along its rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import drjit as dr
import numpy as np
import torch

from difftetvr.backend import Backend, default_device, get_backend
from difftetvr.capture.projections.geometry import ProjectionGeometry
from difftetvr.capture.projections.projector_kernel import NUMBERS_OF_VIEW, Voxels, integrate, rays_of
from difftetvr.errors import CaptureError, shown
from difftetvr.inputs import as_reals, require_type
from difftetvr.memory import tried_twice
from difftetvr.rendering.cameras.detector import Detector
from difftetvr.trust import require_free

Method = Literal["siddon", "trilinear"]
METHODS = ("siddon", "trilinear")

_MAX_RAYS = 2**22  # of one launch, which bound the memory that a batch of views needs
_MOST_VOXELS = 2**31 - 1  # of what is indexed with 32 bits and a sign
_TILE = 32  # pixels along a side of those that run together


def project_volume(
    values: Any,
    geometry: ProjectionGeometry,
    method: Method = "siddon",
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> torch.Tensor:
    """Line integrals of voxels that fill the bounds of a geometry, along its rays.

    Either method is exact up to rounding: ``siddon`` for values that are constant in each voxel, TIGRE's default, and
    ``trilinear`` for values that are trilinear between the middles of voxels, and constant along an axis between an
    outermost middle and the face of the box. Outside of the box nothing absorbs. Rays of a source are looked at from
    there to the detector, parallel ones along their whole line.

    Args:
        values: (X, Y, Z) attenuation per unit of length.
        geometry: The rays, and the box that the outer faces of the voxels bound.
        method: ``siddon`` or ``trilinear``.
        dtype: torch.float32 or torch.float64, of all arithmetic.
        device: PyTorch device to compute on; None takes the fastest.
        progress: Called with the number of finished views, and of all.

    Returns:
        (V, H, W) on the CPU.

    Raises:
        CaptureError: The values are no volume, not finite, or too many; or there is too little memory.
        BackendError: No back end works on the device.
    """
    require_type(geometry, ProjectionGeometry, "geometry", "pass a ProjectionGeometry", CaptureError)
    if method not in METHODS:
        raise CaptureError(f"The method is {shown(method)}; give {' or '.join(METHODS)}.")
    volume = as_reals(values, "values", CaptureError).detach().to("cpu", dtype)
    padded = math.prod(n + 2 for n in volume.shape)
    if volume.ndim != 3 or min(volume.shape) < 1 or padded > _MOST_VOXELS:
        raise CaptureError(f"values has shape {tuple(volume.shape)}; pass (X, Y, Z) of at most 2^31 voxels.")
    if not bool(torch.isfinite(volume).all()):
        raise CaptureError("values are not finite everywhere; replace those that are not.")
    views, height, width = geometry.shape
    size = dtype.itemsize * (2 * padded + views * height * width)
    require_free(size, "The projections", "take a smaller volume, or fewer views", CaptureError)
    b = get_backend(str(default_device() if device is None else device), dtype)
    projector = _Projector(b, volume, geometry, method == "trilinear")
    result = torch.empty((views, height * width), dtype=dtype)
    at_once = max(1, _MAX_RAYS // (width * height))
    for first in range(0, views, at_once):
        last = min(first + at_once, views)
        with b.exclusive():
            result[first:last] = projector.launch(first, last)
        if progress is not None:
            progress(last, views)
    return result.reshape(views, height, width)


class _Projector:
    """A volume on a device, and the rays through it."""

    def __init__(self, b: Backend, volume: torch.Tensor, geometry: ProjectionGeometry, linear: bool) -> None:
        self._b, self._linear = b, linear
        lower, upper = geometry.bounds.numpy()
        counts = np.array(volume.shape)
        sides = (upper - lower) / counts
        # Planes that bound cells are whole numbers: faces of voxels, or their middles.
        begin = -0.5 if linear else 0.0
        self._table = view_table(geometry.detector, lower, sides, begin)
        self._ends = (0.0, 1.0) if geometry.detector.source is not None else (-math.inf, math.inf)
        self._size = (geometry.detector.width, geometry.detector.height)
        self._order = tiled_order(*self._size)
        stored = volume.permute(2, 1, 0)
        if linear:
            stored = torch.nn.functional.pad(stored[None, None], [1] * 6, mode="replicate")[0, 0]
        _, ny, nx = stored.shape
        self._voxels = Voxels(
            values=b.floats(stored.contiguous().to(b.device)),
            lower=b.opaque(begin),
            upper=_opaque(b, counts + begin),
            first=b.opaque(-1.0 if linear else 0.0),
            last=_opaque(b, counts - 1),
            strides=(b.opaque_uint(nx), b.opaque_uint(nx * ny)),
            sides=_opaque(b, sides),
            middle=_opaque(b, 0.5 * counts + begin),
        )

    @tried_twice
    def launch(self, first: int, last: int) -> torch.Tensor:
        """(V, H * W) line integrals of some views, on the CPU."""
        b, order = self._b, self._order
        pixels, width = b.opaque_uint(order.size), b.opaque_uint(self._size[0])
        ray = dr.arange(b.UInt, order.size * (last - first))
        view = ray // pixels
        pixel = dr.gather(b.UInt, b.UInt(order), ray - view * pixels)
        row = pixel // width
        table = b.floats(torch.from_numpy(self._table[first:last]).to(b.device))
        numbers = [dr.gather(b.Float, table, view * NUMBERS_OF_VIEW + k) for k in range(NUMBERS_OF_VIEW)]
        ends = (b.opaque(self._ends[0]), b.opaque(self._ends[1]))
        rays = rays_of(b, self._voxels, numbers, (pixel - row * width, row), ends)
        output = dr.zeros(b.Float, order.size * (last - first))
        dr.scatter(output, integrate(b, self._voxels, rays, self._linear), view * pixels + pixel)
        return b.tensor(output, last - first, order.size).cpu()


def view_table(detector: Detector, lower: np.ndarray, sides: np.ndarray, begin: float) -> np.ndarray:
    """(V, 18) float64 origins and directions of rays in voxels; see the kernel."""
    center, columns, rows = (
        part.detach().cpu().double().numpy() / sides for part in (detector.center, detector.columns, detector.rows)
    )
    center = center - lower / sides + begin
    corner = center + (0.5 - 0.5 * detector.width) * columns + (0.5 - 0.5 * detector.height) * rows
    still = np.zeros_like(corner)
    if detector.source is not None:
        source = detector.source.detach().cpu().double().numpy() / sides - lower / sides + begin
        parts = [source, still, still, corner - source, columns, rows]
    else:
        assert detector.direction is not None
        parts = [corner, columns, rows, detector.direction.detach().cpu().double().numpy() / sides, still, still]
    return np.concatenate(parts, axis=1)


def tiled_order(width: int, height: int) -> np.ndarray:
    """(H * W,) uint32 pixels tile by tile, so that rays that run together read the same voxels."""
    row, column = np.divmod(np.arange(width * height, dtype=np.int64), width)
    tile = (row // _TILE) * (width // _TILE + 1) + column // _TILE
    return np.argsort(tile, kind="stable").astype(np.uint32)


def _opaque(b: Backend, numbers: Any) -> tuple[Any, Any, Any]:
    x, y, z = (b.opaque(float(number)) for number in numbers)
    return x, y, z
