"""Opacities of a scalar's values, by what they are to show."""

from __future__ import annotations

from typing import Literal

import torch

from difftetvr.view.looks.distribution import Distribution

OpacityPreset = Literal["edges", "peak", "ramp", "flat"]

KNOTS = 65
_SPREAD = 1.5  # standard deviation, in knots, of the smoothing of what is found at knots
_REACH = 6  # knots on either side that it takes along

_DEPTH_OF_RANGE = 4.0  # optical depth of a ray along which the scalar runs through all of its range once
_MEAN_DEPTH = 2.0  # of all rays, where they are to be seen through
_PEAKS, _PEAK_WIDTH, _DEPTH_OF_PEAK = 6, 0.02, 0.4


def opacity_knots(
    preset: OpacityPreset, distribution: Distribution, positions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Densities along the range of a scalar.

    - ``edges``: proportional to the mean slope of the scalar where it has a value. So each step of the scalar has the
      same optical depth wherever it lies and however steep it is, as if seen through evenly spaced surfaces; where
      nothing changes, nothing is seen.
    - ``peak``: the same, but only near some values: as translucent surfaces.
    - ``ramp``: the more the greater the value.
    - ``flat``: the same for all.

    Args:
        preset: One of these.
        distribution: Of the scalar, at least one sample of which lies in the range.
        positions: (N,) where in the range its samples lie, from 0 to 1; what is less or more lies outside.

    Returns:
        (K,) positions of knots from 0 to 1, and (K,) densities at them, where the longest side of the space is 1.
    """
    inside = (positions >= 0.0) & (positions <= 1.0)
    knots = torch.linspace(0.0, 1.0, KNOTS, dtype=torch.float64)
    if not bool(inside.any()):
        return knots, torch.zeros_like(knots)  # as if it were not there: the picture says that it is not
    samples, places = distribution.chosen(inside), positions[inside]
    if preset in ("edges", "peak"):
        steepness = _mean_slopes(samples, places)
        if bool((steepness > 0.0).any()) and bool(torch.isfinite(steepness).all()):
            if preset == "peak":
                return _peaks(knots, steepness)
            return knots, _seen_through(_DEPTH_OF_RANGE * steepness, samples, places, at_most=True)
        preset = "flat"
    shape = knots if preset == "ramp" else torch.ones_like(knots)
    return knots, _seen_through(shape, samples, places, at_most=False)


def _mean_slopes(samples: Distribution, places: torch.Tensor) -> torch.Tensor:
    """(K,) mean slopes at the knots, smoothed; in ranges, as the samples' slopes are."""
    nearest = (places * (KNOTS - 1)).round().long().clamp(0, KNOTS - 1)
    volume = _smoothed(torch.bincount(nearest, samples.volumes, KNOTS))
    slope = _smoothed(torch.bincount(nearest, samples.volumes * samples.slopes, KNOTS))
    known = volume > 0.0
    return torch.where(known, slope / torch.where(known, volume, 1.0), 0.0)


def _smoothed(values: torch.Tensor) -> torch.Tensor:
    offsets = torch.arange(-_REACH, _REACH + 1, dtype=values.dtype)
    weights = torch.exp(-0.5 * (offsets / _SPREAD) ** 2)
    return torch.nn.functional.conv1d(values[None, None], weights[None, None], padding=_REACH)[0, 0]


def _peaks(knots: torch.Tensor, steepness: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Narrow tents at evenly spaced values, each of the same optical depth."""
    centers = (torch.arange(_PEAKS, dtype=torch.float64) + 0.5) / _PEAKS
    nearest = (centers * (KNOTS - 1)).round().long()
    height = _DEPTH_OF_PEAK / _PEAK_WIDTH * steepness[nearest]
    low = torch.zeros_like(height)
    places = torch.stack((centers - _PEAK_WIDTH, centers, centers + _PEAK_WIDTH), 1).flatten()
    heights = torch.stack((low, height, low), 1).flatten()
    ends = torch.zeros(1, dtype=torch.float64)
    return torch.cat((ends, places, ends + 1.0)), torch.cat((ends, heights, ends))


def _seen_through(densities: torch.Tensor, samples: Distribution, places: torch.Tensor, at_most: bool) -> torch.Tensor:
    """Densities at evenly spaced knots, scaled to the usual mean depth; or only where that is exceeded."""
    position = places * (KNOTS - 1)
    lower = position.floor().long().clamp(0, KNOTS - 2)
    mean = samples.mean_depth(torch.lerp(densities[lower], densities[lower + 1], position - lower))
    if mean <= 0.0 or (at_most and mean <= _MEAN_DEPTH):
        return densities
    return densities * (_MEAN_DEPTH / mean)
