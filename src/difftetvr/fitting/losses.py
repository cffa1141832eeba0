"""Photometric losses between a rendered and a true image."""

from __future__ import annotations

from collections.abc import Callable

import torch

from difftetvr.fitting.metrics import mean_similarity

_SSIM_PART = 0.2

_SMALL = 0.02  # residuals below which absolute ones count as this large to divide by

Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]

Residuals = Callable[[torch.Tensor], torch.Tensor]


def l1(image: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """Mean absolute difference of two images of the same shape, a scalar."""
    return (image - reference).abs().mean()


def l2(image: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """Mean squared difference of two images of the same shape, a scalar."""
    return (image - reference).square().mean()


def l1_ssim(image: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """Four parts of `l1` and one of 1 - SSIM, as in 3-D Gaussian splatting; images of at least 11 x 11 pixels."""
    return (1.0 - _SSIM_PART) * l1(image, reference) + _SSIM_PART * (1.0 - mean_similarity(image, reference))


def sparsity(density: torch.Tensor) -> torch.Tensor:
    """Mean of log(1 + 2 density^2), a scalar that favours few opaque places over much fog (Plenoxels, equation 4).

    Args:
        density: (N,) in units of the capture's density.
    """
    return torch.log1p(2.0 * density.square()).mean()


def _of_squares(residual: torch.Tensor) -> torch.Tensor:
    return torch.ones_like(residual)


def _of_absolutes(residual: torch.Tensor) -> torch.Tensor:
    return 0.5 / residual.abs().clamp(min=_SMALL)


LOSSES: dict[str, Loss] = {"l1": l1, "l2": l2, "l1-ssim": l1_ssim}

WEIGHTS: dict[str, Residuals] = {"l1": _of_absolutes, "l2": _of_squares, "l1-ssim": _of_absolutes}
"""From residuals to weights of their squares that make a sum of squares as steep as the loss, times their number."""
