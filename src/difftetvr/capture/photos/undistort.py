"""Photographs without the distortion of their lens."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from difftetvr.capture.photos.lens import Intrinsics
from difftetvr.errors import CaptureError
from difftetvr.srgb import linear_to_srgb, srgb_to_linear


def pinhole_of(lens: Intrinsics, where: str) -> Intrinsics:
    """The pinhole camera of the same image size that sees as much as it can without seeing beyond the photograph.

    Its image is the largest upright rectangle between the photograph's edges in the undistorted plane, so no pixel
    of it is without a value.

    Args:
        lens: Intrinsics with distortion.
        where: What they belong to, for messages.

    Raises:
        CaptureError: The distortion folds the image, as no lens does.
    """
    if lens.distortion.is_none:
        return lens
    across, down = np.linspace(0, lens.width, 129), np.linspace(0, lens.height, 129)
    left, right = (_edge(lens, np.full_like(down, x), down)[:, 0] for x in (0.0, float(lens.width)))
    top, bottom = (_edge(lens, across, np.full_like(across, y))[:, 1] for y in (0.0, float(lens.height)))
    lower = np.array([left.max(), top.max()])
    upper = np.array([right.min(), bottom.min()])
    # NaN, of edges that the lens cannot have made, fails this test, too.
    if not (lower < upper).all():
        raise _folds(where)
    fx, fy = (float(focal) for focal in (lens.width, lens.height) / (upper - lower))
    pinhole = Intrinsics(fx, fy, -float(lower[0]) * fx, -float(lower[1]) * fy, lens.width, lens.height)
    coarse = np.stack(np.meshgrid(across, down), axis=-1)
    if not lens.distortion.keeps_orientation(pinhole.to_normalised(coarse)).all():
        raise _folds(where)
    return pinhole


def undistorted(image: torch.Tensor, lens: Intrinsics, pinhole: Intrinsics) -> torch.Tensor:
    """An image as the pinhole camera sees it, sampled bicubically.

    Photographs are interpolated in linear light, where the lens worked. Images with alpha are interpolated as they
    are stored, because that is where their alpha composites.

    Args:
        image: (H, W, 3) float32 sRGB-encoded, or (H, W, 4) with alpha and premultiplied; in [0, 1].
        lens: Intrinsics that the image was taken with.
        pinhole: Intrinsics of the result.

    Returns:
        Image like ``image``.
    """
    has_alpha = image.shape[2] == 4
    source = image if has_alpha else srgb_to_linear(image)
    channels = source.movedim(-1, 0)[None]
    sampled = torch.nn.functional.grid_sample(
        channels, _sampling_grid(lens, pinhole), mode="bicubic", padding_mode="border", align_corners=False
    )
    # Bicubic interpolation overshoots at edges.
    result = sampled[0].movedim(0, -1).clamp(0.0, 1.0)
    if has_alpha:
        return torch.cat([torch.minimum(result[..., :3], result[..., 3:]), result[..., 3:]], dim=-1)
    return linear_to_srgb(result)


def undistorted_mask(mask: torch.Tensor, lens: Intrinsics, pinhole: Intrinsics) -> torch.Tensor:
    """A mask as the pinhole camera sees it: true where all pixels that :func:`undistorted` mixes are.

    Args:
        mask: (H, W) bool.
        lens: Intrinsics that the mask belongs to.
        pinhole: Intrinsics of the result.
    """
    # Bicubic interpolation reaches two pixels far.
    wrong = torch.nn.functional.max_pool2d((~mask).float()[None, None], 5, stride=1, padding=2)
    grid = _sampling_grid(lens, pinhole)
    return torch.nn.functional.grid_sample(wrong, grid, mode="nearest", align_corners=False)[0, 0] == 0


# The photographs of one camera share a grid; it is large, so few are kept.
@lru_cache(maxsize=2)
def _sampling_grid(lens: Intrinsics, pinhole: Intrinsics) -> torch.Tensor:
    """(1, H, W, 2) places in the photograph of the pinhole's pixels, -1 to 1 from edge to edge."""
    x, y = np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    source = lens.to_pixels(lens.distortion.distort(pinhole.to_normalised(pixels)))
    return torch.from_numpy((2.0 * source / (lens.width, lens.height) - 1.0).astype(np.float32))[None]


def _edge(lens: Intrinsics, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return lens.distortion.undistort(lens.to_normalised(np.stack([x, y], axis=-1)))


def _folds(where: str) -> CaptureError:
    return CaptureError(f"The lens distortion of {where} folds the image, as no lens does; check its parameters.")
