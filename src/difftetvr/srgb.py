"""Colours as light and as screens take them: linear, and sRGB-encoded (IEC 61966-2-1)."""

from __future__ import annotations

from typing import Literal

import torch

Encoding = Literal["linear", "srgb"]
"""What numbers of colours are: linear light, or sRGB-encoded as in photographs."""

_SRGB_KNEE, _LINEAR_KNEE = 0.04045, 0.0031308


def srgb_to_linear(values: torch.Tensor) -> torch.Tensor:
    """Linear light from sRGB-encoded values (IEC 61966-2-1)."""
    return torch.where(values <= _SRGB_KNEE, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(values: torch.Tensor) -> torch.Tensor:
    """sRGB-encoded values from linear light (IEC 61966-2-1)."""
    return torch.where(
        values <= _LINEAR_KNEE, values * 12.92, 1.055 * values.clamp(min=_LINEAR_KNEE) ** (1 / 2.4) - 0.055
    )
