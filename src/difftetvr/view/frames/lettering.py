"""Layers of lines and letters, drawn by Matplotlib, that are laid over pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke
from PIL import Image

_DPI = 100
_POINTS = 72
_LETTERS = 1 / 42  # height of letters in the picture's shorter side
_LEAST_LETTERS = 10.0  # pixels
_BRIGHT = 0.5


@dataclass(frozen=True)
class Ink:
    """Colours of lines and letters, and of the halo around these that lifts them off what lies behind."""

    color: str
    halo: str

    @staticmethod
    def on(background: Sequence[float] | None) -> Ink:
        """Ink for a background, linear RGB; for none, ink that shows on all."""
        if background is None:
            return Ink("black", "white")
        red, green, blue = background
        is_bright = 0.3 * red + 0.6 * green + 0.1 * blue > _BRIGHT
        return Ink("black", "white") if is_bright else Ink("white", "black")


class Layer:
    """A transparent sheet of a picture's size, with Matplotlib's axes in pixels: x to the right, y downwards.

    Args:
        width: Pixels.
        height: Pixels.
        ink: What is drawn with.
    """

    def __init__(self, width: int, height: int, ink: Ink) -> None:
        self.width, self.height, self.ink = width, height, ink
        self.letters = max(_LEAST_LETTERS, _LETTERS * min(width, height))
        self._figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
        self._figure.patch.set_alpha(0.0)
        self._canvas = FigureCanvasAgg(self._figure)
        self.axes: Any = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.axes.set(xlim=(0, width), ylim=(height, 0))
        self.axes.set_axis_off()

    def line(self, points: Any, width: float = 0.08) -> None:
        """A line through (N, 2) pixels; its width is told in heights of letters."""
        x, y = np.asarray(points, dtype=np.float64).T
        self.axes.plot(x, y, color=self.ink.color, linewidth=self._in_points(width * self.letters))

    def text(self, place: Sequence[float], words: str, across: str = "center", along: str = "center") -> None:
        """Words at a pixel, which is their ``center`` or one of their ends."""
        self.axes.text(
            *place,
            words,
            color=self.ink.color,
            fontsize=self._in_points(self.letters),
            horizontalalignment=across,
            verticalalignment=along,
            path_effects=[Stroke(linewidth=self._in_points(0.2 * self.letters), foreground=self.ink.halo), Normal()],
            clip_on=False,
        )

    def drawn(self) -> Image.Image:
        """The sheet as an RGBA picture."""
        self._canvas.draw()
        return Image.fromarray(np.array(self._canvas.buffer_rgba()))

    def _in_points(self, pixels: float) -> float:
        return pixels * _POINTS / _DPI
