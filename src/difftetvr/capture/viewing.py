"""What cameras see, in NumPy and float64."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
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
    """(C, 2) pixels and (C,) depths of points in world space."""
    pose = pose_of(camera)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return local[:, :2] / depth[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy), depth


def in_image(pixels: Floats, depth: Floats, camera: Camera, reach: Floats | float = 0.0) -> NDArray[np.bool_]:
    """(C,) bool, whether pixels lie in the image, or so near to it, in front of the camera."""
    x, y = pixels.T
    across = (x >= -reach) & (x < camera.width + reach)
    return (depth > 0) & across & (y >= -reach) & (y < camera.height + reach)


def cell_centers(box: Floats, count: int) -> Floats:
    """(count^3, 3) centres of the cells of a grid over a box."""
    places = (np.arange(count) + 0.5) / count
    axes = [box[0, axis] + places * (box[1, axis] - box[0, axis]) for axis in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
