"""Half-spaces that cut a volume open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from difftetvr.errors import DiffTetError, shown
from difftetvr.inputs import as_reals
from difftetvr.rendering.cameras.pinhole import Camera

_FINITE = "give four finite numbers a, b, c, d, the first three not all 0"


def clip_limits(
    plane: Any, camera: Camera, like: torch.Tensor, origin: Sequence[float] = (0.0, 0.0, 0.0)
) -> torch.Tensor:
    """Distances between which each ray lies in a half-space, in front of the camera.

    Differentiable in the plane and in the camera's pose: the plane stands still in the world.

    Args:
        plane: (4,) a, b, c, d of the half-space a x + b y + c z + d >= 0 in world space.
        camera: The camera, relative to ``origin``.
        like: A tensor whose precision and device the result gets.
        origin: (3,) point of world space that the camera's pose counts from.

    Returns:
        (H, W, 2) first and last distance in world units; the second may be infinite, or smaller than the first where a
        ray never enters.

    Raises:
        DiffTetError: These are not four finite numbers, or the normal (a, b, c) is zero.
    """
    exact = as_reals(plane, "clip_plane", DiffTetError, torch.float64, "give a list or tensor a, b, c, d")
    coefficients = exact.to(like)
    values = coefficients.detach()
    if values.shape != (4,) or not bool(torch.isfinite(values).all()) or not bool(values[:3].any()):
        raise DiffTetError(f"clip_plane is {shown(plane)}; {_FINITE}.")
    pose = camera.world_to_camera.to(like)
    # No matrix products, which torch.autocast would round.
    normal = (pose[:3, :3] * coefficients[:3]).sum(1)
    offset = coefficients[3]
    if any(origin):
        exact, shift = exact.cpu(), torch.tensor(list(origin), dtype=torch.float64)
        offset = (exact[3].double() + (exact[:3].double() * shift).sum()).to(like)
    at_camera = offset - (normal * pose[:3, 3]).sum()
    directions = camera.ray_directions().to(like.dtype)  # before the device: not all of them know float64
    slope = (directions.to(like.device) * normal).sum(-1)
    # Along a ray the plane's function is slope * t + at_camera.
    crossing = -at_camera / torch.where(slope == 0, 1.0, slope)
    nowhere = torch.where(at_camera < 0, -1.0, torch.inf)
    near = torch.where(slope > 0, crossing.clamp(min=0), 0.0)
    far = torch.where(slope < 0, crossing, torch.where(slope == 0, nowhere, torch.inf))
    return torch.stack((near, far), dim=-1)
