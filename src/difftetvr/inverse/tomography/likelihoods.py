"""How residuals of line integrals count: losses with their first and second derivatives, pixel by pixel.

Line integrals t are compared with measured ones b of weight w, which is one over the variance of b. For photons it is
the number that was expected to come through.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from difftetvr.inverse.tomography.config import Likelihood

_FLAT = 1e-3  # of the scale of the noise: residuals below it count as its square, so that the curvature is finite


@dataclass(frozen=True)
class Residuals:
    """What a loss says of pixels, (...) each.

    Attributes:
        loss: The loss; around 1/2 on average where residuals are nothing but noise.
        slope: Its derivative by the line integral.
        curvature: The second derivative, or one that makes the parabola an upper bound.
    """

    loss: torch.Tensor
    slope: torch.Tensor
    curvature: torch.Tensor


def gaussian(found: torch.Tensor, measured: torch.Tensor, weight: torch.Tensor) -> Residuals:
    """Weighted squares, w (t - b)^2 / 2."""
    residual = found - measured
    slope = weight * residual
    return Residuals(0.5 * slope * residual, slope, weight)


def poisson(found: torch.Tensor, measured: torch.Tensor, weight: torch.Tensor) -> Residuals:
    """The negative log-likelihood of w counts where w exp(b - t) are expected, but for a constant: it is 0 at t = b."""
    residual = found - measured
    less = torch.exp(-residual)
    # exp(-r) + r - 1 loses all digits of small residuals.
    loss = torch.where(residual.abs() < 1e-2, residual.square() * (0.5 - residual / 6.0), less + residual - 1.0)
    return Residuals(weight * loss, -weight * torch.expm1(-residual), weight * less)


def absolute(found: torch.Tensor, measured: torch.Tensor, weight: torch.Tensor) -> Residuals:
    """Magnitudes in units of the noise, sqrt(w) |t - b|."""
    residual = found - measured
    scale = weight.sqrt()
    size = (scale * residual).abs()
    return Residuals(size, scale * torch.sign(residual), weight / size.clamp(min=_FLAT))


LIKELIHOODS: dict[Likelihood, Callable[[torch.Tensor, torch.Tensor, torch.Tensor], Residuals]] = {
    "gaussian": gaussian,
    "poisson": poisson,
    "l1": absolute,
}
"""Losses by name."""
