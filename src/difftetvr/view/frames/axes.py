"""Axes around what is shown: its box with numbers along three edges."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.ticker import MaxNLocator

from difftetvr.capture.viewing import Floats
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.view.frames.color_bar import labels_of
from difftetvr.view.frames.lettering import Box, Layer

ROOM = 0.12
"""Share of a picture on each side that numbers take."""

_NAMES = "xyz"
_TICKS = 5
_UPRIGHT = 3.0  # how many times as high as wide the line of an upright axis is at least
_TRIES = 4  # places for the name of an axis, each a letter's height farther out
_TICK, _GAP = 0.5, 0.4  # lengths of ticks, and what is free between them and words, in heights of letters


@dataclass(frozen=True, eq=False)
class AxesBox:
    """The box of what is shown, and what its numbers are.

    Attributes:
        bounds: (2, 3) lower and upper corner in world space.
        lengths: (2, 3) coordinates that are written at these corners; None: those of world space.
        unit: What they are told in; empty: not said.
    """

    bounds: torch.Tensor
    lengths: torch.Tensor | None = None
    unit: str = ""


class ProjectedBox:
    """A box as a camera sees it.

    Args:
        box: The box.
        camera: From where it is seen.
    """

    def __init__(self, box: AxesBox, camera: Camera) -> None:
        self._box = box
        self._bounds = box.bounds.detach().double().cpu().numpy()
        self._camera = camera
        corners = np.array(list(itertools.product((0, 1), repeat=3)))
        pixels, enlarged = self._seen(np.take_along_axis(self._bounds, corners, axis=0))
        self.is_in_front = bool((enlarged > 0.0).all())
        """Whether all of it lies in front of the camera; only then it can be drawn."""
        self._center = pixels.mean(0)
        eye = camera.position.detach().double().cpu().numpy()
        # Whether the camera sees the outer side of a face, by its axis and its end.
        self._faces_camera = np.stack([eye < self._bounds[0], eye > self._bounds[1]])

    def draw_behind(self, layer: Layer) -> None:
        """Draws the edges that lie behind the box's inside, or beside it."""
        for axis, ends in self._edges():
            if not all(self._faces_camera[end, other] for other, end in self._others(axis, ends)):
                layer.line(self._line(axis, ends))

    def draw_numbers(self, layer: Layer) -> None:
        """Draws ticks and numbers along one edge of each direction, on the outline of the box."""
        for axis in range(3):
            outline = [
                ends
                for direction, ends in self._edges()
                if direction == axis
                and sum(self._faces_camera[end, other] for other, end in self._others(axis, ends)) == 1
            ]
            if outline:
                # The lowest one, of upright ones the leftmost.
                middles = np.array([self._line(axis, ends).mean(0) for ends in outline])
                span = np.ptp(self._line(axis, outline[0]), axis=0)
                best = middles[:, 0].argmin() if span[1] > span[0] else middles[:, 1].argmax()
                self._draw_ticks(layer, axis, outline[int(best)])

    def _draw_ticks(self, layer: Layer, axis: int, ends: tuple[int, int]) -> None:
        line = self._line(axis, ends)
        along = (line[1] - line[0]) / max(float(np.linalg.norm(line[1] - line[0])), 1e-9)
        out = np.array([along[1], -along[0]])
        out *= np.sign(out @ (line.mean(0) - self._center)) or 1.0
        lengths = self._bounds if self._box.lengths is None else self._box.lengths.double().cpu().numpy()
        low, high = lengths[:, axis].tolist()
        values = [float(v) for v in MaxNLocator(_TICKS).tick_values(low, high) if low <= v <= high]
        places = self._along(axis, ends, [(value - low) / (high - low) for value in values])
        away = (_TICK + _GAP) * layer.letters
        labels = labels_of(values, low, high)
        boxes = [layer.box_beside(place, out, away, label) for place, label in zip(places, labels, strict=True)]
        farthest = away
        for index in range(0, len(boxes), _step_of(boxes, layer.room)):
            if layer.write_in(boxes[index], labels[index]):
                layer.line([places[index], places[index] + _TICK * layer.letters * out])
                size = boxes[index].right - boxes[index].left, boxes[index].bottom - boxes[index].top
                farthest = max(farthest, away + float(np.abs(out) @ size))
        self._write_name(layer, axis, line, out, farthest)

    def _write_name(self, layer: Layer, axis: int, line: Floats, out: Floats, away: float) -> None:
        """Writes what an axis is called: above upright ones, beside the numbers of others, wherever there is room."""
        name = f"{_NAMES[axis]} ({self._box.unit})" if self._box.unit else _NAMES[axis]
        across, upwards = np.ptp(line, axis=0)
        place = line.mean(0)
        if upwards > _UPRIGHT * across:
            place, out, away = line[line[:, 1].argmin()], np.array([0.0, -1.0]), 0.0
        for further in range(_TRIES):
            if layer.write_in(layer.box_beside(place, out, away + (_GAP + further) * layer.letters, name), name):
                return

    def _edges(self) -> list[tuple[int, tuple[int, int]]]:
        """Direction of each edge, and at which ends of the other two axes it lies."""
        return [(axis, (i, j)) for axis in range(3) for i in (0, 1) for j in (0, 1)]

    def _others(self, axis: int, ends: tuple[int, int]) -> list[tuple[int, int]]:
        return list(zip([other for other in range(3) if other != axis], ends, strict=True))

    def _line(self, axis: int, ends: tuple[int, int]) -> Floats:
        """(2, 2) pixels of the ends of an edge."""
        return self._along(axis, ends, [0.0, 1.0])

    def _along(self, axis: int, ends: tuple[int, int], shares: list[float]) -> Floats:
        """(N, 2) pixels of points on an edge, told in shares of it."""
        points = np.empty((len(shares), 3))
        for other, end in self._others(axis, ends):
            points[:, other] = self._bounds[end, other]
        points[:, axis] = self._bounds[0, axis] + np.array(shares) * np.ptp(self._bounds[:, axis])
        return self._seen(points)[0]

    def _seen(self, points: Floats) -> tuple[Floats, Floats]:
        pixels, enlarged = self._camera.project(torch.from_numpy(points))
        return pixels.detach().cpu().numpy(), enlarged.detach().cpu().numpy()


def _step_of(boxes: list[Box], room: float) -> int:
    """Every how many numbers are written, so that there is room between them."""
    return next(
        step
        for step in range(1, len(boxes) + 2)
        if not any(one.meets(other, room) for one, other in itertools.pairwise(boxes[::step]))
    )
