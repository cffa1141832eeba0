"""How many pixels can be drawn in the time that a moving picture leaves for one frame."""

from __future__ import annotations

import math

FRAME_SECONDS = 0.06
"""What drawing a frame may take while something moves; with sending it, there is room for 10 frames a second."""

_STEP = math.sqrt(0.5)  # sides of one level in those of the next finer one
_COARSEST = 8
_LEAST_SIDE = 32
_WEIGHT = 0.5  # of the last frame in the mean of all
_ROOM = 0.6  # of the time a frame of the next finer level may take before that is gone over to


class Pace:
    """Chooses how coarse moving pictures are, by how long the last ones took.

    There are few levels, each with half the pixels of the one before: kernels are recorded for each size. The level
    gets coarser as soon as a frame takes too long, and finer only where there is room for that.

    Attributes:
        level: 0 for the window's own pixels; the next one has half of them.
    """

    def __init__(self) -> None:
        self.level = 3
        self._seconds_per_pixel: float | None = None

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of a frame while something moves, for a window of so many pixels."""
        scale = _STEP**self.level
        least = min(1.0, _LEAST_SIDE / max(1, min(width, height)))
        scale = max(scale, least)
        return max(1, round(scale * width)), max(1, round(scale * height))

    def bands(self, width: int, height: int) -> int:
        """In how many parts a still picture is drawn, so that none takes much longer than a moving frame."""
        if self._seconds_per_pixel is None:
            return 4
        wanted = self._seconds_per_pixel * width * height / FRAME_SECONDS
        return min(1 << max(0, math.ceil(math.log2(max(wanted, 1.0)))), max(1, height // 8))

    def observe(self, pixels: int, seconds: float, window: int) -> None:
        """Takes note of a frame, but for the first of a size, which also records kernels.

        Args:
            pixels: How many were drawn.
            seconds: How long that took.
            window: Pixels of the whole window.
        """
        rate = seconds / max(1, pixels)
        known = self._seconds_per_pixel
        self._seconds_per_pixel = rate if known is None else _WEIGHT * rate + (1.0 - _WEIGHT) * known
        expected = self._seconds_per_pixel * window * _STEP ** (2 * self.level)
        if expected > FRAME_SECONDS:
            self.level = min(self.level + 1, _COARSEST)
        elif self.level > 0 and 2.0 * expected < _ROOM * FRAME_SECONDS:
            self.level -= 1
