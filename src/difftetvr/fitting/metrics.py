"""Image quality: PSNR and SSIM of images with a data range of [0, 1]."""

from __future__ import annotations

import torch

from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.rigid import full_precision

SSIM_WINDOW = 11
_SSIM_SIGMA = 1.5
_SSIM_K1, _SSIM_K2 = 0.01, 0.03
# The PSNR of equal images is infinite, which JSON cannot hold; no float32 image differs from another by less than this.
_LEAST_MSE = 1e-16


def psnr_of_mse(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared error, for a peak of 1; 160 dB for equal images."""
    return float(-10.0 * torch.log10(torch.tensor(max(mse, _LEAST_MSE), dtype=torch.float64)))


def psnr(image: torch.Tensor, reference: torch.Tensor, share: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1, of images clipped to [0, 1] first.

    Args:
        image: (H, W, 3) image.
        reference: Image of the same shape.
        share: Part of the pixels that count, in (0, 1]; the images are the same in the others.

    Raises:
        CaptureError: The shapes differ.
    """
    a, b = _comparable(image, reference)
    return psnr_of_mse(float((a - b).square().mean()) / max(share, 1e-9))


def ssim(image: torch.Tensor, reference: torch.Tensor) -> float:
    """Mean structural similarity (Wang et al. 2004), the mean over pixels and the colour channels.

    Gaussian window of 11 x 11 pixels with sigma 1.5, K1 = 0.01, K2 = 0.03, population covariances. Only windows that
    lie within the image count ("valid" padding, as in the authors' code), on images clipped to [0, 1] first.

    Args:
        image: (H, W, 3) image, linear, at least 11 x 11 pixels.
        reference: Image of the same shape.

    Raises:
        CaptureError: The shapes differ, or the images are smaller than the window.
    """
    a, b = _comparable(image, reference)
    if min(a.shape[:2]) < SSIM_WINDOW:
        raise CaptureError(
            f"SSIM needs images of at least {SSIM_WINDOW} x {SSIM_WINDOW} pixels, these are "
            f"{a.shape[1]} x {a.shape[0]}; render larger images."
        )
    return float(mean_similarity(a, b))


def mean_similarity(image: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """The scalar of :func:`ssim` for images as they are: neither clipped nor converted, and differentiable.

    Args:
        image: (H, W, 3), at least 11 x 11 pixels.
        reference: Image of the same shape.
    """
    a, b = image.movedim(-1, 0), reference.movedim(-1, 0)
    window = _gaussian(a)
    mean_a, mean_b = _blur(a, window), _blur(b, window)
    variance_a = _blur(a * a, window) - mean_a**2
    variance_b = _blur(b * b, window) - mean_b**2
    covariance = _blur(a * b, window) - mean_a * mean_b
    c1, c2 = _SSIM_K1**2, _SSIM_K2**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * covariance + c2) / (variance_a + variance_b + c2)
    return (luminance * structure).mean()


def _comparable(image: torch.Tensor, reference: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    if image.shape != reference.shape:
        raise CaptureError(
            f"The image has shape {tuple(image.shape)} but its reference {tuple(reference.shape)}; "
            "compare images of one size."
        )
    # Float64: the variances of SSIM are differences of nearly equal numbers.
    is_together = image.device == reference.device and image.device.type == "cuda"
    device = image.device if is_together else torch.device("cpu")
    a, b = (x.detach().to(device, torch.float64).clamp(0.0, 1.0) for x in (image, reference))
    return a, b


def _gaussian(like: torch.Tensor) -> torch.Tensor:
    x = torch.arange(SSIM_WINDOW, dtype=like.dtype, device=like.device) - SSIM_WINDOW // 2
    weights = torch.exp(-0.5 * (x / _SSIM_SIGMA) ** 2)
    return weights / weights.sum()


def _blur(channels: torch.Tensor, window: torch.Tensor) -> torch.Tensor:
    stack = channels[:, None]
    with full_precision(channels):
        stack = torch.nn.functional.conv2d(stack, window.reshape(1, 1, -1, 1))
        return torch.nn.functional.conv2d(stack, window.reshape(1, 1, 1, -1))[:, 0]
