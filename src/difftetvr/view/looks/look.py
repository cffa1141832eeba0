"""From what is asked of a scalar's look, and its distribution, to a transfer function."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from difftetvr.errors import MeshError
from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.view.looks.colormaps import DEFAULT_COLORMAP, colormap_colors
from difftetvr.view.looks.distribution import Distribution
from difftetvr.view.looks.opacities import OpacityPreset, opacity_knots

_TAILS = ((1e-3, 1.5), (5e-3, 10.0))
"""Shares of the volume at either end of the values that the usual range leaves out if that narrows it so many times."""


@dataclass(frozen=True)
class Appearance:
    """How a scalar is to look.

    Attributes:
        colormap: Name of the colour map.
        opacity: Which values are how opaque, see `difftetvr.view.looks.opacities.opacity_knots`.
        value_range: Values at the ends of the colour map; None: as ``percentile`` says.
        percentile: Per cent of the volume that lie below these ends; None: the least and the greatest value, without
            the thousandth of the volume at either end if these widen that by more than half, and without the next four
            thousandths if these do more than ten times.
        is_log: Whether colours are spread over the logarithm of the values.
    """

    colormap: str = DEFAULT_COLORMAP
    opacity: OpacityPreset = "edges"
    value_range: tuple[float, float] | None = None
    percentile: tuple[float, float] | None = None
    is_log: bool = False

    def look(self, distribution: Distribution, name: str) -> Look:
        """What a scalar looks like.

        Args:
            distribution: How it is distributed.
            name: What it is called, for messages.

        Raises:
            MeshError: There is no range, or no logarithm of it.
            CaptureError: There is no such colour map.
        """
        low, high = self._range(distribution, name)
        positions, per_value = self._positions(distribution.values, low, high)
        in_ranges = replace(distribution, slopes=distribution.slopes * per_value)
        knots, densities = opacity_knots(self.opacity, in_ranges, positions)
        if self.is_log and distribution.ends[0] <= 0.0:
            densities[0] = 0.0  # with which what has no logarithm is transparent: it lies below the range
        attenuation = float(densities.max()) or 1.0
        opacity = densities / attenuation
        colors = colormap_colors(self.colormap, knots)
        function = TransferFunction(self._scalars(knots, low, high).float(), opacity.float(), colors, name)
        return Look(function, attenuation, (low, high), self.is_log, self.colormap)

    def _range(self, distribution: Distribution, name: str) -> tuple[float, float]:
        if self.value_range is not None:
            low, high = self.value_range
            if not -math.inf < low < high < math.inf:
                raise MeshError(f"The range is {low:g} to {high:g}; give two finite numbers, the smaller first.")
            if self.is_log and low <= 0.0:
                raise MeshError(f"The range begins with {low:g}, which has no logarithm; begin with a number above 0.")
            return low, high
        if self.is_log and distribution.ends[0] <= 0.0:
            positive = distribution.values > 0.0
            if not bool(positive.any()):
                raise MeshError(f"No value of '{name}' is greater than 0, so none has a logarithm; leave out --log.")
            distribution = distribution.chosen(positive)
        if self.percentile is not None:
            low, high = distribution.quantiles([0.01 * share for share in self.percentile])
            if not low < high:
                raise MeshError(
                    f"'{name}' is {low:g} at both percentiles, {self.percentile[0]:g} and {self.percentile[1]:g}; give "
                    "others that lie farther apart, or --value-range."
                )
            return low, high
        low, high = distribution.ends
        if not low < high:
            raise MeshError(f"All values of '{name}' that can be shown are {low:g}; give --value-range.")
        for share, factor in _TAILS:
            lower, upper = distribution.quantiles([share, 1.0 - share])
            if lower < upper and self._extent(low, high) > factor * self._extent(lower, upper):
                low, high = lower, upper
        return low, high

    def _extent(self, low: float, high: float) -> float:
        return math.log(high) - math.log(low) if self.is_log else high - low

    def _positions(self, values: torch.Tensor, low: float, high: float) -> tuple[torch.Tensor, torch.Tensor | float]:
        """(N,) where on the colour map values lie, and by how much that changes with them."""
        if not self.is_log:
            return (values - low) / (high - low), 1.0 / (high - low)
        extent = math.log(high) - math.log(low)
        safe = values.clamp(min=torch.finfo(values.dtype).tiny)
        return (safe.log() - math.log(low)) / extent, 1.0 / (extent * safe)

    def _scalars(self, positions: torch.Tensor, low: float, high: float) -> torch.Tensor:
        """(K,) the inverse, in units of the range: a transfer function knows nothing of logarithms."""
        if not self.is_log:
            return positions
        return logarithmic(positions, low, high)


def logarithmic(positions: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """Where in a range values lie that lie somewhere on a logarithmic scale of it.

    Args:
        positions: (K,) on the scale, in [0, 1].
        low: Lower end of the range, > 0.
        high: Its upper end.

    Returns:
        (K,) in [0, 1].
    """
    ratio = math.log(high) - math.log(low)
    # From the upper end, whose exponential does not overflow.
    shares = (torch.exp((positions - 1.0) * ratio) - math.exp(-ratio)) / -math.expm1(-ratio)
    return shares.clamp(0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Look:
    """What a scalar looks like.

    Attributes:
        transfer_function: Colour and opacity of the scalars in units of the range.
        attenuation: Density of opacity 1, where the longest side of what is looked at is 1.
        value_range: Values that stand for 0 and 1 of the transfer function.
        is_log: Whether colours are spread over the logarithm of the values.
        colormap: Name of the colour map.
    """

    transfer_function: TransferFunction
    attenuation: float
    value_range: tuple[float, float]
    is_log: bool
    colormap: str
