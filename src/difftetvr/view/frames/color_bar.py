"""Colour bars: which colour a scalar has where."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.ticker import LogLocator, MaxNLocator, ScalarFormatter
from PIL import Image

from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.view.frames.lettering import Ink, Layer
from difftetvr.view.looks.look import logarithmic

ROOM = 0.16
"""Share of a picture's width, on its right, that a colour bar takes."""

_LEFT, _WIDTH, _TOP, _BOTTOM = 1.0 - 0.88 * ROOM, 0.022, 0.22, 0.80
_STEPS = 256
_LEAST_ROOM = 72  # pixels of a bar beside a picture
_FEWEST_DECADES = 1.0  # from which on ticks are powers of ten
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, eq=False)
class ColorScale:
    """Colours of a scalar.

    Attributes:
        label: What the scalar is called.
        value_range: Values at its transfer function's 0 and 1.
        transfer_function: Colours of scalars in units of the range.
        is_log: Whether the bar is logarithmic, which takes a range above 0.
    """

    label: str
    value_range: tuple[float, float]
    transfer_function: TransferFunction
    is_log: bool = False

    def colors(self, count: int) -> torch.Tensor:
        """(count, 3) colours along the bar, from its lower end."""
        along = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
        if self.is_log:
            low, high = self.value_range
            along = logarithmic(along, low, high)
        return self.transfer_function(along)[0].detach().clamp(0.0, 1.0)

    def ticks(self) -> list[tuple[float, str]]:
        """Where along the bar, from 0 to 1, numbers stand, and these."""
        low, high = self.value_range
        if not math.isfinite(high - low):
            return [(0.0, f"{low:.3g}"), (1.0, f"{high:.3g}")]
        has_decades = self.is_log and math.log10(high) - math.log10(low) >= _FEWEST_DECADES
        locator = LogLocator(numticks=8) if has_decades else MaxNLocator(6)
        with np.errstate(over="ignore"):  # of ticks beyond the greatest number, which are left out
            values = [float(value) for value in locator.tick_values(low, high) if low <= value <= high]
        if has_decades:
            labels = ["10" + str(round(math.log10(value))).translate(_RAISED) for value in values]
        else:
            labels = labels_of(values, low, high)
        return [(self._place(value), label) for value, label in zip(values, labels, strict=True)]

    def _place(self, value: float) -> float:
        low, high = self.value_range
        if self.is_log:
            return math.log(value / low) / math.log(high / low)
        return (value - low) / (high - low)


def labels_of(values: list[float], low: float, high: float) -> list[str]:
    """Numbers of a scale as text, with as many digits as tell them apart."""
    formatter = ScalarFormatter(useOffset=False)
    formatter.create_dummy_axis()
    axis: Any = formatter.axis
    axis.set_view_interval(low, high)
    axis.set_data_interval(low, high)
    labels = formatter.format_ticks(values)
    exponent = formatter.get_offset()
    return [f"{label}{exponent.replace('1e', 'e')}" if exponent else label for label in labels]


def draw_color_bar(layer: Layer, scale: ColorScale) -> None:
    """Draws a colour bar on the right of a sheet.

    Args:
        layer: Where to.
        scale: What it shows.
    """
    ticks, thickness = scale.ticks(), _WIDTH * layer.width
    longest = max((layer.size_of(label)[0] for _, label in ticks), default=0.0)
    # Long numbers push the bar to the left, so that they end within the picture.
    left = min(_LEFT * layer.width, layer.width - thickness - longest - 1.2 * layer.letters)
    right = left + thickness
    top, bottom = _TOP * layer.height, _BOTTOM * layer.height
    colors = scale.colors(_STEPS).numpy()[:, None]
    layer.axes.imshow(
        np.flip(colors, 0), extent=(left, right, bottom, top), aspect="auto", interpolation="bilinear", zorder=1
    )
    layer.axes.set(xlim=(0, layer.width), ylim=(layer.height, 0))  # which an image changes
    layer.line([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)])
    for place, label in ticks:
        y = bottom + place * (top - bottom)
        layer.line([(right, y), (right + 0.4 * layer.letters, y)])
        layer.text((right + 0.7 * layer.letters, y), label, across="left")
    # From the right edge of the picture, whatever its length.
    label = layer.fitting(scale.label, layer.width - 1.2 * layer.letters)
    layer.text((layer.width - 0.6 * layer.letters, top - layer.letters), label, across="right", along="bottom")


def beside_color_bar(picture: Image.Image, scale: ColorScale, background: tuple[float, float, float]) -> Image.Image:
    """A picture with a colour bar on its right, on a background R G B, instead of one in it."""
    room = max(_LEAST_ROOM, round(ROOM * max(picture.size)))
    whole = Image.new("RGB", (picture.width + room, picture.height), tuple(round(255 * v) for v in background))
    whole.paste(picture, (0, 0))
    # A sheet as wide as it is high, whose right end holds the bar in its usual size.
    side = max(picture.height, round(room / ROOM))
    layer = Layer(side, picture.height, Ink.on(background))
    draw_color_bar(layer, scale)
    bar = layer.drawn().crop((side - room, 0, side, picture.height))
    whole.paste(bar, (picture.width, 0), bar)
    return whole
