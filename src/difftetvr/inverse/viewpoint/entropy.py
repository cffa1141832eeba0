"""How much an image shows: entropies of its opacities and of the areas of its colours."""

from __future__ import annotations

import math

import torch

from difftetvr.errors import CameraError, shown
from difftetvr.inputs import as_reals
from difftetvr.mesh.field import Field
from difftetvr.rendering import ScalarField

_COLORS = 6
_SAMPLES = 4096  # vertices whose colours are grouped
_ROUNDS = 20


def opacity_entropy(alpha: torch.Tensor) -> torch.Tensor:
    """Entropy of an image's opacities: 1 where all pixels are equally opaque, 0 where a single one is.

    H = -sum p ln p / ln N with p = alpha / sum alpha over the N pixels (Weiss and Westermann 2022, after Ji and Shen
    2006). It counts how evenly opacity is spread over the picture, so it is high where the volume covers much of it and
    little hides behind something opaque. That of an image without anything is 0, and so is its derivative.

    Args:
        alpha: (H, W) opacities, >= 0.

    Returns:
        The entropy, a scalar in [0, 1]; differentiable.
    """
    return _entropy(alpha / alpha.sum().clamp(min=torch.finfo(alpha.dtype).tiny))


def color_entropy(color: torch.Tensor, references: torch.Tensor) -> torch.Tensor:
    """Entropy of the areas that some colours cover in an image: 1 where all of them cover as much.

    Each pixel belongs to black and to each of the K references by the shares ``softmax(-|c - r|)`` of the distances of
    its colour; their means over the pixels are the areas p, and H = -sum p ln p / ln (K + 1) (Weiss and Westermann
    2022, in their code).

    Args:
        color: (H, W, 3) colours over black.
        references: (K, 3) colours, K >= 1; of a transfer function those of its peaks, see
            :func:`difftetvr.inverse.reference_colors`.

    Returns:
        The entropy, a scalar in [0, 1]; differentiable.
    """
    known = torch.cat((references.new_zeros(1, 3), references)).to(color)
    squares = (color[..., None, :] - known).square().sum(-1)
    # The root has no derivative where a pixel has a reference's very colour.
    distances = squares.clamp(min=1e-12).sqrt()
    return _entropy(torch.softmax(-distances, dim=-1).flatten(0, -2).mean(0))


def reference_colors(content: Field | ScalarField) -> torch.Tensor:
    """Colours whose areas :func:`difftetvr.inverse.color_entropy` is to compare.

    Of scalars: the colours of the transfer function's knots that are more opaque than both of their neighbours. Of
    colours and densities: the means of six groups of vertices or cells, by k-means of colours weighted by density.

    Args:
        content: What is rendered.

    Returns:
        (K, 3) linear RGB, K >= 1.

    Raises:
        CameraError: Nothing of it is opaque, or what it holds are no colours.
    """
    if isinstance(content, ScalarField):
        function = content.transfer_function
        opacity = function.opacity.detach().cpu()
        around = torch.nn.functional.pad(opacity, (1, 1), value=-1.0)
        peaks = (opacity > around[:-2]) & (opacity >= around[2:]) & (opacity > 0)
        if not bool(peaks.any()):
            raise CameraError("The transfer function is transparent everywhere, so it has no colours to compare.")
        return function.color.detach().cpu()[peaks]
    if content.color.shape[-1] != 3:
        raise CameraError("Only RGB colours have areas to compare; measure the entropy of the opacity instead.")
    density = content.density.detach().double().cpu()
    seen = torch.nonzero(density > 0).flatten()
    if not len(seen):
        raise CameraError("The density is 0 everywhere, so there are no colours to compare.")
    seen = seen[:: max(1, len(seen) // _SAMPLES)]
    return _groups(content.color.detach().double().cpu()[seen], density[seen]).float()


def _groups(colors: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """(K, 3) weighted means of groups of colours: k-means, from colours that are far from each other."""
    chosen = [int(weights.argmax())]
    nearest = (colors - colors[chosen[0]]).square().sum(1)
    while len(chosen) < _COLORS and float(nearest.max()) > 0:
        chosen.append(int((nearest * weights).argmax()))
        nearest = torch.minimum(nearest, (colors - colors[chosen[-1]]).square().sum(1))
    means = colors[chosen].clone()
    for _ in range(_ROUNDS):
        group = torch.cdist(colors, means).argmin(1)
        total = torch.zeros(len(means), dtype=weights.dtype).index_add_(0, group, weights)
        sums = torch.zeros_like(means).index_add_(0, group, weights[:, None] * colors)
        means = torch.where(total[:, None] > 0, sums / total[:, None].clamp(min=1e-300), means)
    return means


def checked_colors(colors: object) -> torch.Tensor:
    """(K, 3) reference colours, or what a caller gave as such.

    Raises:
        CameraError: They are no colours.
    """
    found = as_reals(colors, "The reference colours", CameraError, torch.float32, "pass (K, 3) numbers")
    if found.dim() != 2 or found.shape[1:] != (3,) or not len(found) or not bool(torch.isfinite(found).all()):
        raise CameraError(f"The reference colours are {shown(colors)}; pass (K, 3) finite numbers, at least one row.")
    return found.detach()


def _entropy(shares: torch.Tensor) -> torch.Tensor:
    """-sum p ln p / ln N of shares (...), with 0 ln 0 = 0 and no derivative there."""
    is_none = shares <= 0
    logarithm = torch.log(torch.where(is_none, 1.0, shares))
    return -(torch.where(is_none, 0.0, shares) * logarithm).sum() / math.log(max(shares.numel(), 2))
