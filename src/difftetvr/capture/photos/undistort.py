"""Photographs without the distortion of their lens, or with it."""

from __future__ import annotations

from functools import lru_cache

import torch

from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.intrinsics import Intrinsics, field_of_view
from difftetvr.srgb import linear_to_srgb, srgb_to_linear

_EDGE = 129  # places along each edge of a photograph that are looked at
_LEAST_KNOWN = 0.5  # of the pixels


def pinhole_of(lens: Intrinsics, where: str) -> Intrinsics:
    """The pinhole camera of the same image size that sees as much as it can without seeing beyond the photograph.

    Its image is the largest upright rectangle between the photograph's edges in the undistorted plane, so no pixel
    of it is without a value.

    Args:
        lens: Intrinsics with distortion.
        where: What they belong to, for messages.

    Raises:
        CaptureError: The distortion folds the image, as no lens does, or the lens is a fisheye.
    """
    if lens.distortion.is_none:
        return lens
    if lens.distortion.is_fisheye:
        raise CaptureError(
            f"The lens of {where} is a fisheye, which no pinhole can stand for; keep it (keep_lens, on the command "
            "line --keep-lens), or undistort its images first."
        )
    across, down = (torch.linspace(0, side, _EDGE, dtype=torch.float64) for side in (lens.width, lens.height))
    left, right = (_edge(lens, torch.full_like(down, x), down)[:, 0] for x in (0.0, lens.width))
    top, bottom = (_edge(lens, across, torch.full_like(across, y))[:, 1] for y in (0.0, lens.height))
    lower = torch.stack([left.max(), top.max()])
    upper = torch.stack([right.min(), bottom.min()])
    # NaN, of edges that the lens cannot have made, fails this test, too.
    if not bool((lower < upper).all()):
        raise _folds(where)
    (x, y), (across_seen, down_seen) = lower.tolist(), (upper - lower).tolist()
    fx, fy = lens.width / across_seen, lens.height / down_seen
    pinhole = Intrinsics(fx, fy, -x * fx, -y * fy, lens.width, lens.height)
    coarse = torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1)
    if not bool(lens.distortion.keeps_orientation(pinhole.to_normalised(coarse)).all()):
        raise _folds(where)
    return pinhole


def known_pixels(lens: Intrinsics, where: str) -> torch.Tensor | None:
    """(H, W) bool, the pixels of a photograph that its lens can have made; None where it can have made all.

    Args:
        lens: Intrinsics that the image was taken with.
        where: What they belong to, for messages.

    Raises:
        CaptureError: The distortion folds half of the image or more, as no lens does.
    """
    if lens.distortion.is_none:
        return None
    known = field_of_view(lens).known
    if float(known.float().mean()) <= _LEAST_KNOWN:
        raise _folds(where)
    return None if bool(known.all()) else known


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
    source = lens.to_pixels(lens.distortion.distort(pinhole.to_normalised(pinhole.pixel_centers())))
    return (2.0 * source / source.new_tensor([lens.width, lens.height]) - 1.0).float()[None]


def _edge(lens: Intrinsics, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    return lens.distortion.undistort(lens.to_normalised(torch.stack([x, y], dim=-1)))


def _folds(where: str) -> CaptureError:
    return CaptureError(f"The lens distortion of {where} folds the image, as no lens does; check its parameters.")
