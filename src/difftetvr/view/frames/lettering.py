"""Layers of lines and letters, drawn by Matplotlib, that are laid over pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patheffects import Normal, Stroke
from PIL import Image

_DPI = 100
_POINTS = 72
_LETTERS = 1 / 42  # height of letters in the picture's shorter side
_LEAST_LETTERS = 10.0  # pixels
_APART = 0.2  # room between words, in heights of letters
_BRIGHT = 0.5
_ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"


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


@dataclass(frozen=True)
class Box:
    """Where words stand, in pixels."""

    left: float
    top: float
    right: float
    bottom: float

    def meets(self, other: Box, room: float) -> bool:
        """Whether there is less room than that between them."""
        across = max(self.left - other.right, other.left - self.right)
        return max(across, self.top - other.bottom, other.top - self.bottom) < room


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
        self.words: list[tuple[str, Box]] = []
        """What is written, and where."""

    def line(self, points: Any, width: float = 0.08) -> None:
        """A line through (N, 2) pixels; its width is told in heights of letters."""
        x, y = np.asarray(points, dtype=np.float64).T
        self.axes.plot(x, y, color=self.ink.color, linewidth=self._in_points(width * self.letters))

    def text(self, place: Sequence[float], words: str, across: str = "center", along: str = "center") -> None:
        """Words, as they are, at a pixel, which is their ``center`` or one of their ends."""
        width, height = self.size_of(words)
        left = place[0] - {"left": 0.0, "center": 0.5, "right": 1.0}[across] * width
        top = place[1] - {"top": 0.0, "center": 0.5, "bottom": 1.0}[along] * height
        self.words.append((words, Box(left, top, left + width, top + height)))
        self.axes.text(
            *place,
            words,
            color=self.ink.color,
            fontsize=self._in_points(self.letters),
            horizontalalignment=across,
            verticalalignment=along,
            path_effects=[Stroke(linewidth=self._in_points(0.2 * self.letters), foreground=self.ink.halo), Normal()],
            clip_on=False,
            parse_math=False,
            snap=False,  # which would leave out bars of a small E
        )

    def box_beside(self, place: Any, out: Any, gap: float, words: str) -> Box:
        """Where words stand that lie beyond a gap from a pixel.

        Args:
            place: (2,) the pixel.
            out: (2,) unit vector of the direction in which they lie.
            gap: Pixels that are left free.
            words: The words.
        """
        width, height = self.size_of(words)
        away = gap + 0.5 * (abs(float(out[0])) * width + abs(float(out[1])) * height)
        x, y = (float(at + away * direction) for at, direction in zip(place, out, strict=True))
        return Box(x - 0.5 * width, y - 0.5 * height, x + 0.5 * width, y + 0.5 * height)

    def write_in(self, box: Box, words: str) -> bool:
        """Writes words there, unless others are in their way, or a part of them would not be seen; whether it does."""
        ends = min(box.left, box.top), self.width - box.right, self.height - box.bottom
        if min(ends) < self.room or any(box.meets(other, self.room) for _, other in self.words):
            return False
        self.text((0.5 * (box.left + box.right), 0.5 * (box.top + box.bottom)), words)
        return True

    @property
    def room(self) -> float:
        """Pixels between words."""
        return _APART * self.letters

    def size_of(self, words: str) -> tuple[float, float]:
        """Width and height of words in pixels."""
        font = FontProperties(size=self._in_points(self.letters))
        width, height, _ = self._canvas.get_renderer().get_text_width_height_descent(words, font, False)
        return width, height

    def fitting(self, words: str, width: float) -> str:
        """Words, without their end where they would be wider than so many pixels."""
        kept = words
        while kept and self.size_of(kept + (_ELLIPSIS if kept != words else ""))[0] > width:
            kept = kept[:-1]
        return kept if kept == words else kept + _ELLIPSIS

    def drawn(self) -> Image.Image:
        """The sheet as an RGBA picture."""
        self._canvas.draw()
        return Image.fromarray(np.array(self._canvas.buffer_rgba()))

    def _in_points(self, pixels: float) -> float:
        return pixels * _POINTS / _DPI
