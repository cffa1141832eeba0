"""Where a mesh far from the origin counts its positions from, so that single precision resolves it."""

from __future__ import annotations

import math

import torch

Origin = tuple[float, float, float]
"""A point of world space, in units of length."""

WORLD: Origin = (0.0, 0.0, 0.0)
"""The origin of world space itself."""

_FARTHEST = 16.0


def origin_for(vertices: torch.Tensor) -> Origin:
    """The origin that positions in single precision should have.

    A mesh at map coordinates spans metres, millions of them away from the origin, where float32 resolves half a metre.
    Its own origin lies near its centre, at a multiple of a power of two of about its size: subtracting and adding it
    again then changes no digit of positions that were float32 already.

    Args:
        vertices: (V, 3) finite positions in world space, in the precision that they were given in.

    Returns:
        The origin; that of world space for a mesh that lies within 16 of its longest sides of it.
    """
    if not vertices.shape[0]:
        return WORLD
    low, high = (corner.double().cpu() for corner in torch.aminmax(vertices.detach(), dim=0))
    longest = float((high - low).max())
    farthest = float(torch.maximum(-low, high).max())
    if not 0.0 < _FARTHEST * longest < farthest < math.inf:
        return WORLD
    step = 2.0 ** math.ceil(math.log2(longest))
    # Along an axis where the mesh is near to the origin, shifting it would cost the digits of its smallest numbers.
    is_far = torch.maximum(low, -high) >= 2.0 * longest
    middles = torch.where(is_far, 0.5 * (low + high), 0.0).tolist()
    x, y, z = (step * round(middle / step) for middle in middles)
    return (x, y, z)


def reoriented(vertices: torch.Tensor, old: Origin, new: Origin, dtype: torch.dtype) -> torch.Tensor:
    """Positions relative to another origin, rounded once; differentiable.

    Args:
        vertices: (V, 3) positions relative to ``old``.
        old: Their origin.
        new: The wanted one.
        dtype: The wanted precision.
    """
    shift = torch.tensor([o - n for o, n in zip(old, new, strict=True)], dtype=torch.float64)
    return (vertices.double() + shift.to(vertices.device)).to(dtype)
