"""What every kind of camera asks of its parameters."""

from __future__ import annotations

from typing import Any

import torch

from difftetvr.errors import CameraError, shown
from difftetvr.inputs import as_number, as_reals, as_whole

MOST_PIXELS = 1 << 28
"""With so many, four floats a pixel stay within the kernels' 32-bit indices."""

_ORTHONORMALITY_TOLERANCE = 1e-3


def number(name: str, value: object) -> float:
    """A camera's parameter as a number.

    Raises:
        CameraError: It is none.
    """
    return as_number(value, f"The camera's {name}", CameraError)


def pixels(name: str, value: object) -> int:
    """A number of pixels.

    Raises:
        CameraError: It is none, or out of range.
    """
    count = as_whole(value, f"The camera's {name}", CameraError, "give a whole number of pixels")
    if count < 1:
        raise CameraError(f"The camera's {name} is {shown(count)} pixels; it must be at least 1.")
    if count > MOST_PIXELS:
        raise CameraError(f"The camera's {name} is {shown(count)} pixels; take at most {MOST_PIXELS:,} in all.")
    return count


def require_places(places: Any, count: int) -> None:
    """Checks that these are (N,) integers from 0 to below ``count``; of those on a GPU all but how large they are."""
    is_list = isinstance(places, torch.Tensor) and places.ndim == 1 and places.dtype in (torch.int32, torch.int64)
    if not is_list:
        raise CameraError(f"The pixels are {shown(places)}; pass integers of shape (N,), row * width + column.")
    if places.device.type == "cpu" and places.numel() and not 0 <= int(places.min()) <= int(places.max()) < count:
        raise CameraError(
            f"Pixels go from {int(places.min())} to {int(places.max())}; this image has 0 to {count - 1}."
        )


def take_size(camera: Any) -> None:
    """Check ``width`` and ``height`` of a frozen camera, and keep them as integers.

    Raises:
        CameraError: One of them, or both together, are out of range.
    """
    for name in ("width", "height"):
        object.__setattr__(camera, name, pixels(name, getattr(camera, name)))
    if camera.width * camera.height > MOST_PIXELS:
        raise CameraError(
            f"The image size is {camera.width} x {camera.height} pixels; take at most {MOST_PIXELS:,} in all."
        )


def take_pose(camera: Any) -> None:
    """Check ``world_to_camera`` of a frozen camera, and keep it as a tensor.

    Raises:
        CameraError: It is no rigid transform.
    """
    pose = as_reals(camera.world_to_camera, "world_to_camera", CameraError)
    object.__setattr__(camera, "world_to_camera", pose)
    if pose.shape != (4, 4):
        raise CameraError(f"world_to_camera has shape {tuple(pose.shape)}; give a (4, 4) matrix.")
    values = pose.detach().to("cpu", torch.float64)
    if not bool(torch.isfinite(values).all()):
        raise CameraError("world_to_camera holds a value that is not finite; give a rigid transform.")
    rotation = values[:3, :3]
    deviation = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
    last_row = (values[3] - torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)).abs().max().item()
    if max(deviation, last_row) > _ORTHONORMALITY_TOLERANCE or torch.linalg.det(rotation) < 0:
        raise CameraError(
            "world_to_camera is no rigid transform (rotation without scale or mirror, last row 0 0 0 1); "
            "orthonormalise it first."
        )
