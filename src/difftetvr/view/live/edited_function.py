"""A transfer function as hands change it: few knots of opacity over the colours of a map."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch

from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.view.looks.colormaps import colormap_colors

MOST_KNOTS = 12
"""More are no pleasure to drag."""

_SAMPLES = 65  # of a colour map, between which colours are linear
_CLOSE_ENOUGH = 0.004  # of opacities, in that of the most opaque knot
_WIDTH, _HEIGHT, _STRIP = 280, 110, 14  # of the drawing, and of the colours below it


@dataclass(frozen=True, eq=False)
class EditedFunction:
    """Opacity as a linear function between few knots, over colours of their own.

    Attributes:
        colors: Transfer function whose colours these are; its opacities do not matter.
        places: (K,) where the knots are, in [0, 1], not decreasing, K >= 2.
        opacities: (K,) opacities there, in [0, 1].
    """

    colors: TransferFunction
    places: tuple[float, ...]
    opacities: tuple[float, ...]

    @staticmethod
    def of(function: TransferFunction) -> EditedFunction:
        """One that is all but the same as a given one, with as many knots as that takes and no more than can be seen.

        Of many knots those are kept in turn between which the opacity is farthest from the line.
        """
        places, opacities = (part.detach().cpu().double().numpy() for part in (function.scalar, function.opacity))
        places, opacities = _reaching_both_ends(places, opacities)
        kept = [0, len(places) - 1]
        while len(kept) < min(MOST_KNOTS, len(places)):
            line = np.interp(places, places[kept], opacities[kept])
            distance = np.abs(opacities - line)
            distance[kept] = 0.0
            if distance.max() <= _CLOSE_ENOUGH * max(opacities.max(), 1e-9):
                break
            kept = sorted([*kept, int(distance.argmax())])
        return EditedFunction(function, tuple(places[kept].tolist()), tuple(opacities[kept].tolist()))

    @property
    def function(self) -> TransferFunction:
        """The transfer function, whose knots are those of the opacity and those of the colours."""
        opacity_points = np.stack((self.places, self.opacities), 1)
        own = (self.colors.scalar[:, None], self.colors.color)
        color_points = torch.cat(own, 1).detach().cpu().double().numpy()
        return TransferFunction.joined(opacity_points, color_points, self.colors.name)

    def moved(self, places: tuple[float, ...]) -> EditedFunction:
        """The same with knots elsewhere; those that pass others are held up by them."""
        ordered = np.maximum.accumulate(np.clip(places, 0.0, 1.0))
        return dataclasses.replace(self, places=tuple(ordered.tolist()))

    def with_opacity(self, knot: int, opacity: float) -> EditedFunction:
        """The same with another opacity at a knot."""
        values = list(self.opacities)
        values[knot] = min(max(opacity, 0.0), 1.0)
        return dataclasses.replace(self, opacities=tuple(values))

    def with_knot_after(self, knot: int) -> tuple[EditedFunction, int]:
        """The same with one more knot on the line behind one, or before the last one, and that knot's number."""
        first = min(knot, len(self.places) - 2)
        place, opacity = (0.5 * (part[first] + part[first + 1]) for part in (self.places, self.opacities))
        places, opacities = list(self.places), list(self.opacities)
        places.insert(first + 1, place)
        opacities.insert(first + 1, opacity)
        return dataclasses.replace(self, places=tuple(places), opacities=tuple(opacities)), first + 1

    def without_knot(self, knot: int) -> EditedFunction:
        """The same without a knot; the last two stay."""
        if len(self.places) <= 2:
            return self
        places, opacities = ([*part[:knot], *part[knot + 1 :]] for part in (self.places, self.opacities))
        return dataclasses.replace(self, places=tuple(places), opacities=tuple(opacities))

    def in_colors_of(self, colormap: str) -> EditedFunction:
        """The same in the colours of a map.

        Raises:
            CaptureError: There is no such map.
        """
        scalar = torch.linspace(0.0, 1.0, _SAMPLES)
        colors = TransferFunction(scalar, torch.zeros(_SAMPLES), colormap_colors(colormap, scalar), self.colors.name)
        return dataclasses.replace(self, colors=colors)

    def drawing(self, chosen: int) -> str:
        """The opacity over the scalar, above the colours, as SVG; low opacities are stretched, as by a square root.

        Args:
            chosen: Number of the knot that is to stand out.
        """
        stops = []
        for place in np.linspace(0.0, 1.0, 33):
            color, _ = self.colors(torch.tensor([place]))
            red, green, blue = (color[0].clamp(0, 1) * 255).round().int().tolist()
            stops.append(f'<stop offset="{place:.4f}" stop-color="rgb({red},{green},{blue})"/>')
        inner = _HEIGHT - 12
        points = [(_WIDTH * p, 6 + inner * (1.0 - o**0.5)) for p, o in zip(self.places, self.opacities, strict=True)]
        line = _curve(self.places, self.opacities, inner)
        area = f"0,{_HEIGHT} 0,{line[0][1]:.1f} {_joined(line)} {_WIDTH},{line[-1][1]:.1f} {_WIDTH},{_HEIGHT}"
        knots = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{6 if index == chosen else 4}" stroke="#222" stroke-width="1.5" '
            f'fill="{"#ffb000" if index == chosen else "#fff"}"/>'
            for index, (x, y) in enumerate(points)
        )
        return (
            f'<svg class="transfer-function" viewBox="-7 0 {_WIDTH + 14} {_HEIGHT + _STRIP + 4}" width="100%" '
            'style="display:block">'
            f'<defs><linearGradient id="map">{"".join(stops)}</linearGradient></defs>'
            f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="#8883"/>'
            f'<polygon points="{area}" fill="url(#map)" fill-opacity="0.85"/>'
            f'<polyline points="{_joined(line)}" fill="none" stroke="#888" stroke-width="1.5"/>'
            f'<rect y="{_HEIGHT + 3}" width="{_WIDTH}" height="{_STRIP}" fill="url(#map)"/>{knots}</svg>'
        )


def _reaching_both_ends(places: np.ndarray, opacities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same constant continuation, with knots at 0 and 1."""
    if places[0] > 0.0:
        places, opacities = np.insert(places, 0, 0.0), np.insert(opacities, 0, opacities[0])
    if places[-1] < 1.0 or len(places) < 2:
        places, opacities = np.append(places, 1.0), np.append(opacities, opacities[-1])
    return places, opacities


def _curve(places: tuple[float, ...], opacities: tuple[float, ...], height: float) -> list[tuple[float, float]]:
    """The line of the drawing: straight in the opacity, so bent where that is stretched."""
    fine = np.unique(np.concatenate((np.linspace(0.0, 1.0, 141), places)))
    return [
        (_WIDTH * float(p), 6 + height * (1.0 - float(o) ** 0.5))
        for p, o in zip(fine, np.interp(fine, places, opacities), strict=True)
    ]


def _joined(points: list[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
