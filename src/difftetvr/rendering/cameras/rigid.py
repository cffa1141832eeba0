"""Points under a rigid transform, at their own precision whatever surrounds it."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch


def transformed(points: torch.Tensor, rotation: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
    """``points @ rotation.T + offset``, also where :class:`torch.autocast` would round the factors to 16 bits.

    Args:
        points: (N, 3).
        rotation: (3, 3).
        offset: (3,).

    Returns:
        (N, 3); differentiable in all three.
    """
    result: torch.Tensor = _Transform.apply(points, rotation, offset)
    return result


class _Transform(torch.autograd.Function):
    """Its backward pass may run under ``autocast``, too, so it is not left to that of ``addmm``."""

    @staticmethod
    def forward(ctx: Any, points: torch.Tensor, rotation: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(points, rotation)
        with full_precision(points):
            return offset + _rows_times(points, rotation.T)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> Any:
        points, rotation = ctx.saved_tensors
        with full_precision(points):
            return (
                _rows_times(gradient, rotation) if ctx.needs_input_grad[0] else None,
                torch.stack([(gradient * column[:, None]).sum(0) for column in points.unbind(1)], dim=1)
                if ctx.needs_input_grad[1]
                else None,
                gradient.sum(0) if ctx.needs_input_grad[2] else None,
            )


def _rows_times(rows: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    """``rows @ matrix`` for (N, 3) and (3, 3), without a matrix product, which GPUs may round to TF32."""
    x, y, z = (column[:, None] for column in rows.unbind(1))
    a, b, c = matrix.unbind(0)
    return torch.addcmul(torch.addcmul(x * a, y, b), z, c)


def pencil(pose: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays from a camera in world space, float64; differentiable in both.

    Args:
        pose: (4, 4) world to camera.
        seen: (..., 3) directions in camera space.

    Returns:
        (..., 3) origins, which are all one, and directions.
    """
    pose = pose.double()
    # No matrix products, which torch.autocast would round, nor a sum over three, which takes several times as long.
    x, y, z = (part[..., None] for part in seen.to(pose.device).unbind(-1))
    directions = x * pose[0, :3] + y * pose[1, :3] + z * pose[2, :3]
    origin = -(pose[:3, :3] * pose[:3, 3:]).sum(0)
    return origin.expand(directions.shape), directions


def full_precision(like: torch.Tensor) -> AbstractContextManager[Any]:
    """Where ``autocast`` is off for the device of a tensor."""
    kind = like.device.type
    return torch.autocast(kind, enabled=False) if torch.amp.is_autocast_available(kind) else nullcontext()
