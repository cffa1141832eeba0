"""Ray marching of a volume in float64 NumPy and SciPy, ray by ray, that shares no code with the kernel."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from difftetvr import TransferFunction
from difftetvr.capture import Volume
from difftetvr.rendering.cameras.pinhole import Camera


def render(
    volume: Volume, function: TransferFunction, attenuation: float, camera: Camera, steps_per_unit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Image (H, W, 3), premultiplied over black, and alpha (H, W)."""
    pose = camera.world_to_camera.double().numpy()
    eye = -pose[:3, :3].T @ pose[:3, 3]
    directions = camera.ray_directions().numpy() @ pose[:3, :3]
    extent = (np.array(volume.resolution) - 1.0) * np.array(volume.spacing)
    upper = extent / extent.max() / 2
    image, alpha = np.zeros((camera.height, camera.width, 3)), np.zeros((camera.height, camera.width))
    for row in range(camera.height):
        for column in range(camera.width):
            direction = directions[row, column]
            with np.errstate(divide="ignore", invalid="ignore"):
                sides = np.stack([(-upper - eye) / direction, (upper - eye) / direction])
            near = max(np.nanmax(np.fmin(*sides)), 0.0)
            far = np.nanmin(np.fmax(*sides))
            if far <= near:
                continue
            steps = int(np.ceil((far - near) * steps_per_unit))
            length = (far - near) / steps
            points = eye + (near + (np.arange(steps) + 0.5) * length)[:, None] * direction
            voxels = (points + upper) / (2 * upper) * (np.array(volume.resolution) - 1.0)
            scalar = ndimage.map_coordinates(
                volume.values.astype(np.float64), voxels[:, ::-1].T, order=1, mode="nearest"
            )
            image[row, column], alpha[row, column] = composite(function, attenuation * length, scalar)
    return image, alpha


def composite(function: TransferFunction, attenuation_of_step: float, scalar: np.ndarray) -> tuple[np.ndarray, float]:
    knots = function.scalar.double().numpy()
    depth = attenuation_of_step * np.interp(scalar, knots, function.opacity.double().numpy())
    in_front = np.exp(-np.concatenate([[0.0], np.cumsum(depth)]))
    weight = in_front[:-1] - in_front[1:]
    channels = [weight @ np.interp(scalar, knots, channel) for channel in function.color.double().numpy().T]
    return np.array(channels), 1.0 - in_front[-1]
