"""What cameras see, in NumPy and float64."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from difftetvr.rendering.cameras.pinhole import Camera

Floats = NDArray[np.float64]


def pose_of(camera: Camera) -> Floats:
    """(4, 4) world-to-camera."""
    return camera.world_to_camera.detach().cpu().double().numpy()


def positions_of(cameras: Sequence[Camera]) -> Floats:
    """(N, 3) centres of projection in world space."""
    poses = [pose_of(camera) for camera in cameras]
    return np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])


def project(points: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """(C, 2) pixels of points in world space, and (C,) pixels in a unit of length there; see `Camera.project`."""
    pixels, enlarged = camera.project(torch.from_numpy(points))
    return pixels.detach().numpy(), enlarged.detach().numpy()


def in_image(pixels: Any, enlarged: Any, camera: Camera, reach: Any = 0.0) -> Any:
    """(C,) bool, whether pixels lie in the image, or so near to it, and not behind the camera.

    Args:
        pixels: (C, 2), an array or a tensor.
        enlarged: (C,) pixels in a unit of length.
        camera: The camera.
        reach: How many pixels beside the image still count, one for all or (C,).
    """
    x, y = pixels[:, 0], pixels[:, 1]
    across = (x >= -reach) & (x < camera.width + reach)
    return (enlarged > 0) & across & (y >= -reach) & (y < camera.height + reach)


def cell_centers(box: Floats, count: int) -> Floats:
    """(count^3, 3) centres of the cells of a grid over a box."""
    places = (np.arange(count) + 0.5) / count
    axes = [box[0, axis] + places * (box[1, axis] - box[0, axis]) for axis in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
