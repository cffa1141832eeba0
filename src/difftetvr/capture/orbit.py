"""Camera positions around an object."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from difftetvr.errors import CaptureError, shown
from difftetvr.rendering.cameras.pinhole import Camera

# The field of view of the published experiments: the image plane at distance 1 has height 1.
DEFAULT_FOV_Y = 2.0 * math.atan(0.5)
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_POLE = 1.0 - 1e-4


def fibonacci_orbit(
    count: int,
    target: Sequence[float] = (0.0, 0.0, 0.0),
    radius: float = 1.2,
    fov_y: float = DEFAULT_FOV_Y,
    width: int = 128,
    height: int = 128,
) -> list[Camera]:
    """Cameras spread evenly over a sphere along a Fibonacci spiral, from its top (+z) to its bottom.

    Args:
        count: Number of cameras, >= 1.
        target: (3,) centre of the sphere, which all cameras look at.
        radius: Radius of the sphere, > 0.
        fov_y: Vertical field of view in radians.
        width: Image width in pixels.
        height: Image height in pixels.

    Raises:
        CaptureError: ``count`` or ``radius`` is out of range.
        CameraError: The field of view or the image size is.
    """
    _check(count, radius)
    index = np.arange(count)
    z, angle = 1.0 - (2.0 * index + 1.0) / count, index * _GOLDEN_ANGLE
    return _look_at_target(_on_sphere(z, angle), target, radius, fov_y, width, height)


def random_orbit(
    count: int,
    target: Sequence[float] = (0.0, 0.0, 0.0),
    radius: float = 1.2,
    fov_y: float = DEFAULT_FOV_Y,
    width: int = 128,
    height: int = 128,
    seed: int = 0,
) -> list[Camera]:
    """Cameras at uniformly distributed random places on a sphere; the same seed gives the same cameras.

    Args and errors are those of :func:`fibonacci_orbit`; ``seed`` is a non-negative integer.
    """
    _check(count, radius)
    if seed < 0:
        raise CaptureError(f"The seed is {shown(seed)}; give a non-negative integer.")
    random = np.random.default_rng(seed).random((count, 2))
    directions = _on_sphere(2.0 * random[:, 0] - 1.0, 2.0 * math.pi * random[:, 1])
    return _look_at_target(directions, target, radius, fov_y, width, height)


def _check(count: int, radius: float) -> None:
    if count < 1:
        raise CaptureError(f"The number of views is {shown(count)}; give at least one.")
    if not (math.isfinite(radius) and radius > 0):
        raise CaptureError(f"The radius of the cameras' sphere is {shown(radius)}; it must be greater than 0.")


def _on_sphere(z: np.ndarray, angle: np.ndarray) -> np.ndarray:
    across = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=-1)


def _look_at_target(
    directions: np.ndarray, target: Sequence[float], radius: float, fov_y: float, width: int, height: int
) -> list[Camera]:
    cameras = []
    for direction in directions:
        eye = [float(t + radius * d) for t, d in zip(target, direction, strict=True)]
        # From the poles z is no upward direction; y is.
        up = (0.0, 1.0, 0.0) if abs(direction[2]) > _POLE else (0.0, 0.0, 1.0)
        cameras.append(Camera.look_at(eye, list(target), up, fov_y, width, height))
    return cameras
