"""Half-spaces that cut a volume open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from difftetvr.errors import DiffTetError, shown
from difftetvr.inputs import as_reals, handed_over
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
    coefficients, offset = _plane(plane, like, origin)
    pose = handed_over(camera.world_to_camera, like)
    # No matrix products, which torch.autocast would round.
    normal = (pose[:3, :3] * coefficients).sum(1)
    at_camera = offset - (normal * pose[:3, 3]).sum()
    near, far = _half_space((handed_over(camera.ray_directions(), like) * normal).sum(-1), at_camera)
    return torch.stack((near.clamp(min=0.0), far), dim=-1)


def clip_rays(
    plane: Any, origins: torch.Tensor, directions: torch.Tensor, origin: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances between which lines lie in a half-space; differentiable in the plane and the rays.

    Args:
        plane: (4,) a, b, c, d of the half-space a x + b y + c z + d >= 0 in world space.
        origins: (..., 3) points of the lines, relative to ``origin``.
        directions: (..., 3) their unit directions.
        origin: (3,) point of world space that the points count from.

    Returns:
        (...) first and last distance, which may be infinite; the last is smaller where a line is outside.

    Raises:
        DiffTetError: These are not four finite numbers, or the normal (a, b, c) is zero.
    """
    coefficients, offset = _plane(plane, origins, origin)
    slope, at_origin = ((part * coefficients).sum(-1) for part in (directions, origins))
    return _half_space(slope, at_origin + offset)


def _plane(plane: Any, like: torch.Tensor, origin: Sequence[float]) -> tuple[torch.Tensor, torch.Tensor]:
    """(3,) normal and offset of a plane of world space, seen from an origin there."""
    exact = as_reals(plane, "clip_plane", DiffTetError, torch.float64, "give a list or tensor a, b, c, d")
    values = exact.detach()
    if values.shape != (4,) or not bool(torch.isfinite(values).all()) or not bool(values[:3].any()):
        raise DiffTetError(f"clip_plane is {shown(plane)}; {_FINITE}.")
    # In another unit, a power of two, so that no precision is too small for them.
    most = 120 if exact.dtype == torch.float32 else 1000
    exponent = torch.frexp(values[:3].abs().amax()).exponent.clamp(-most, most)
    exact = exact * torch.ldexp(torch.ones_like(values[0]), -exponent)
    farthest = torch.finfo(like.dtype).max
    coefficients = handed_over(torch.cat((exact[:3], exact[3:].clamp(-farthest, farthest))), like)
    offset = coefficients[3]
    if any(origin):
        exact, shift = exact.cpu(), torch.tensor(list(origin), dtype=torch.float64)
        offset = exact[3].double() + (exact[:3].double() * shift).sum()
        offset = handed_over(offset, like)
    return coefficients[:3], offset


def _half_space(slope: torch.Tensor, at_origin: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances between which the plane's function, slope * t + at_origin along a ray, is not negative."""
    crossing = -at_origin / torch.where(slope == 0, 1.0, slope)
    nowhere = torch.where(at_origin < 0, -torch.inf, torch.inf)
    near = torch.where(slope > 0, crossing, -torch.inf)
    return near, torch.where(slope < 0, crossing, torch.where(slope == 0, nowhere, torch.inf))
