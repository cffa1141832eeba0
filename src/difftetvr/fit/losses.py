"""Photometric losses between a rendered and a true image."""

from __future__ import annotations

from collections.abc import Callable

import torch

Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def l1(image: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """Mean absolute difference of two images of the same shape, a scalar."""
    return (image - reference).abs().mean()


def l2(image: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """Mean squared difference of two images of the same shape, a scalar."""
    return (image - reference).square().mean()


LOSSES: dict[str, Loss] = {"l1": l1, "l2": l2}
