"""Ground-truth views of a scalar volume: fine ray marching with the transfer function applied after interpolation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import drjit as dr
import numpy as np
import torch
from scipy import ndimage

from difftetvr.backend import Backend, default_device, get_backend
from difftetvr.capture.volumes.volume import Volume
from difftetvr.capture.volumes.volume_kernel import VolumeTables, enter_box, march
from difftetvr.errors import CaptureError, shown
from difftetvr.memory import tried_twice
from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.rendering.cameras.pinhole import Camera

# Cells along an edge of the blocks that empty space is skipped in.
_BLOCK = 4
# Rays of one kernel launch, which bound the memory that a batch of views needs.
_MAX_RAYS = 2**22

Progress = Callable[[int, int], None]


class VolumeRenderer:
    """Renders a volume through a transfer function by the emission-absorption integral, without gradients.

    A ray's path through the box is cut into equal steps no longer than 1 / ``steps_per_unit``; each has the colour and
    the attenuation coefficient ``attenuation * opacity`` of its middle. Space where the transfer function is zero is
    stepped over, and rays stop at a transmittance of 1e-6; neither changes the image visibly to float32.

    Args:
        volume: Scalars and box.
        transfer_function: Colour and opacity of a scalar.
        attenuation: Attenuation coefficient of opacity 1, per world unit (the box's longest side is 1), >= 0.
        steps_per_unit: Steps per world unit, > 0. 2500 are within 94 dB of 6000 for the packaged tooth.
        device: PyTorch device to render on; None takes the fastest.
        dtype: torch.float32 or torch.float64.

    Raises:
        CaptureError: A number is out of range.
        BackendError: No back end works on the device.
    """

    def __init__(
        self,
        volume: Volume,
        transfer_function: TransferFunction,
        attenuation: float,
        steps_per_unit: float = 2500.0,
        device: str | torch.device | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if not (math.isfinite(attenuation) and attenuation >= 0):
            raise CaptureError(f"The attenuation is {shown(attenuation)}; it must be at least 0.")
        if not (math.isfinite(steps_per_unit) and steps_per_unit > 0):
            raise CaptureError(f"The number of steps per unit is {shown(steps_per_unit)}; it must be greater than 0.")
        self._backend = get_backend(str(default_device() if device is None else device), dtype)
        self._tables = _tables(self._backend, volume, transfer_function, attenuation)
        nx, ny, nz = volume.resolution
        lower = -0.5 * (np.array([nx, ny, nz]) - 1) * volume.cell_size
        self._lower = [self._backend.opaque(v) for v in lower]
        self._cell_size = [self._backend.opaque(v) for v in volume.cell_size]
        self._steps_per_unit = self._backend.opaque(steps_per_unit)

    def render(self, cameras: Sequence[Camera], progress: Progress | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Views from cameras of one image size.

        Args:
            cameras: N cameras with the same width and height.
            progress: Called with the number of finished views and N.

        Returns:
            Images (N, H, W, 3), linear RGB premultiplied over black, and alphas (N, H, W), both on the CPU.

        Raises:
            CaptureError: No camera is given, one is no pinhole, or the image sizes differ.
        """
        if any(type(camera) is not Camera for camera in cameras):
            raise CaptureError("Volumes are rendered for pinhole cameras alone; pass difftetvr.Camera without a lens.")
        if not cameras or len({(camera.width, camera.height) for camera in cameras}) != 1:
            raise CaptureError("The views of a capture need at least one camera and one common image size.")
        width, height = cameras[0].width, cameras[0].height
        order = _pixel_order(width, height)
        images = torch.empty((len(cameras), height * width, 4), dtype=self._backend.dtype)
        for chunk in _chunks(len(cameras), max(1, _MAX_RAYS // (width * height))):
            with self._backend.exclusive():
                images[chunk.start : chunk.stop] = self._launch(cameras[chunk.start : chunk.stop], order)
            if progress is not None:
                progress(chunk.stop, len(cameras))
        images = images.reshape(len(cameras), height, width, 4)
        return images[..., :3].contiguous(), images[..., 3].contiguous()

    @tried_twice
    def _launch(self, cameras: Sequence[Camera], order: np.ndarray) -> torch.Tensor:
        """(N, H * W, 4) premultiplied colour and alpha of some views, on the CPU."""
        b = self._backend
        pixels, width = b.opaque_uint(order.size), b.opaque_uint(cameras[0].width)
        ray = dr.arange(b.UInt, order.size * len(cameras))
        view = ray // pixels
        pixel = dr.gather(b.UInt, b.UInt(order), ray - view * pixels)
        row = pixel // width
        table = b.floats(torch.stack([_camera_row(camera) for camera in cameras]).to(b.device))
        camera = [dr.gather(b.Float, table, view * 16 + k) for k in range(16)]
        samples = list(self._tables.resolution)
        rays = enter_box(
            b, camera, (pixel - row * width, row), self._lower, self._cell_size, samples, self._steps_per_unit
        )
        red, green, blue, alpha = march(b, self._tables, rays)
        output = dr.zeros(b.Float, 4 * order.size * len(cameras))
        dr.scatter(output, b.Float4(red, green, blue, alpha), view * pixels + pixel)
        return b.tensor(output, len(cameras), order.size, 4).cpu()


def _chunks(total: int, size: int) -> Iterator[range]:
    for start in range(0, total, size):
        yield range(start, min(start + size, total))


def _camera_row(camera: Camera) -> torch.Tensor:
    pose = camera.world_to_camera.detach().to("cpu", torch.float64)
    intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)
    position = -pose[:3, :3].T @ pose[:3, 3]
    return torch.cat([pose[:3, :3].reshape(-1), position, intrinsics])


def _pixel_order(width: int, height: int) -> np.ndarray:
    """(H * W,) uint32 pixel indices along a Morton curve, so that rays that run together read the same samples."""
    row, column = np.divmod(np.arange(width * height, dtype=np.uint32), np.uint32(width))
    return np.argsort(_spread(column) | (_spread(row) << np.uint64(1)), kind="stable").astype(np.uint32)


def _spread(bits: np.ndarray) -> np.ndarray:
    """Every bit of 16-bit numbers moved to twice its place."""
    spread = bits.astype(np.uint64)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        spread = (spread | (spread << np.uint64(shift))) & np.uint64(mask)
    return spread


def _tables(b: Backend, volume: Volume, transfer_function: TransferFunction, attenuation: float) -> VolumeTables:
    nx, ny, nz = volume.resolution
    clearance = _clearance(volume, transfer_function)
    knots, values = _knot_rows(transfer_function, attenuation)
    intervals = knots.shape[0] - 1
    by_axis = clearance.shape[::-1]
    return VolumeTables(
        corners=b.floats(torch.from_numpy(_corner_packets(volume.values)).to(b.device)),
        resolution=(b.opaque_uint(nx), b.opaque_uint(ny), b.opaque_uint(nz)),
        clearance=b.UInt(clearance.reshape(-1)),
        blocks=(b.opaque_uint(by_axis[0]), b.opaque_uint(by_axis[1]), b.opaque_uint(by_axis[2])),
        block_size=b.opaque_uint(_BLOCK),
        knots=b.floats(torch.from_numpy(knots).to(b.device)),
        values=b.floats(torch.from_numpy(values).to(b.device)),
        knot_count=b.opaque_uint(intervals),
        search_steps=(intervals - 1).bit_length(),
    )


def _corner_packets(values: np.ndarray) -> np.ndarray:
    """(nz, ny, nx, 4) each sample with its neighbours at y + 1, z + 1 and both; past the last row they repeat."""
    padded = np.pad(values, ((0, 1), (0, 1), (0, 0)), mode="edge")
    return np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]], axis=-1)


def _clearance(volume: Volume, transfer_function: TransferFunction) -> np.ndarray:
    """(bz, by, bx) uint32 per block: 0 if it may be visible, else its Chebyshev distance in blocks to one that may."""
    lower, upper = volume.values, volume.values
    for axis in range(3):
        # A block of cells reaches to the first sample of the next block.
        starts = np.arange(0, lower.shape[axis] - 1, _BLOCK)
        ends = np.minimum(starts + _BLOCK, lower.shape[axis] - 1)
        lower = np.minimum(np.minimum.reduceat(lower, starts, axis), np.take(lower, ends, axis))
        upper = np.maximum(np.maximum.reduceat(upper, starts, axis), np.take(upper, ends, axis))
    empty = transfer_function.is_transparent(lower, upper)
    if empty.all():
        return np.full(empty.shape, max(empty.shape), dtype=np.uint32)
    return np.asarray(ndimage.distance_transform_cdt(empty, metric="chessboard")).astype(np.uint32)


def _knot_rows(transfer_function: TransferFunction, attenuation: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions with inverse widths (K + 2, 2), colours with attenuation coefficients (K + 2, 4), float64.

    A sentinel row before the first knot and one behind the last hold the constant ends.
    """
    scalar = transfer_function.scalar.detach().cpu().double().numpy()
    opacity = transfer_function.opacity.detach().cpu().double().numpy()
    color = transfer_function.color.detach().cpu().double().numpy()
    width = np.diff(scalar)
    inverse = np.divide(1.0, width, out=np.zeros_like(width), where=width > 0)
    knots = np.stack([np.concatenate([[-1.0], scalar, [2.0]]), np.concatenate([[0.0], inverse, [0.0, 0.0]])], axis=-1)
    values = np.concatenate([color, attenuation * opacity[:, None]], axis=-1)
    return knots, np.concatenate([values[:1], values, values[-1:]])
