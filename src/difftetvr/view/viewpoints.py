"""Where views were looked for, and what they show, as a map of the sphere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from difftetvr.errors import CaptureError
from difftetvr.files import atomic_write
from difftetvr.inverse.viewpoint.record import Viewpoint
from difftetvr.inverse.viewpoint.search import ViewpointSearch

_LEVELS = 24
_FEWEST = 8  # views that make a map


def longitude_latitude(view: Viewpoint, center: Any) -> tuple[float, float]:
    """Where a camera stands, seen from a point: degrees around z from x towards y, and above the horizon."""
    x, y, z = (view.camera.position.double().cpu() - center.cpu()).tolist()
    return math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))


def save_viewpoint_map(path: str | Path, search: ViewpointSearch, others: Sequence[Viewpoint] = ()) -> None:
    """Writes a PNG with the entropy over longitude and latitude, and the paths of a search in it.

    The map lies between views that were rendered: the search's scouts, and others. Dots are where climbs began, rings
    where they ended, a star the best view.

    Args:
        path: File to write.
        search: What was found.
        others: More views of the same orbit, for a finer map.

    Raises:
        CaptureError: The file cannot be written.
    """
    figure = Figure(figsize=(8, 4.4), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    views = [*search.scouts, *others]
    if len(views) >= _FEWEST:
        _fill(figure, axes, views, search.center)
    for number, climb in enumerate(search.paths):
        places = np.array([longitude_latitude(view, search.center) for view in climb])
        # Across the seam of the map a line would run through all of it.
        breaks = np.nonzero(np.abs(np.diff(places[:, 0])) > 180.0)[0] + 1
        for part in np.split(places, breaks):
            axes.plot(part[:, 0], part[:, 1], "-", color="white", linewidth=1.2)
        axes.plot(*places[0], "o", color="white", markersize=3)
        axes.plot(
            *places[-1], "*" if number == 0 else "o", color="red", markersize=13 if number == 0 else 5, mfc="none"
        )
    axes.set(xlim=(-180, 180), ylim=(-90, 90), xlabel="longitude (degrees)", ylabel="latitude (degrees)")
    axes.set_xticks(range(-180, 181, 60))
    axes.set_yticks(range(-90, 91, 30))
    axes.set_facecolor("0.6")
    with atomic_write(Path(path), CaptureError) as temporary, open(temporary, "wb") as file:
        canvas.print_png(file)


def _fill(figure: Any, axes: Any, views: Sequence[Viewpoint], center: Any) -> None:
    places = np.array([longitude_latitude(view, center) for view in views])
    values = np.array([view.entropy for view in views])
    # Once more on either side, and a row at each pole, so that the map reaches its edges.
    x = np.concatenate([places[:, 0] + turn for turn in (-360.0, 0.0, 360.0)])
    y, z = np.tile(places[:, 1], 3), np.tile(values, 3)
    for pole in (-90.0, 90.0):
        edge = np.linspace(-540.0, 540.0, 37)
        nearest = values[np.abs(places[:, 1] - pole).argmin()]
        x, y, z = np.append(x, edge), np.append(y, np.full(37, pole)), np.append(z, np.full(37, nearest))
    low, high = float(values.min()), float(values.max())
    levels = np.linspace(low, high + max(1e-6, 1e-3 * (high - low)), _LEVELS)
    filled = axes.tricontourf(x, y, z, levels=levels, cmap="viridis", extend="both")
    figure.colorbar(filled, ax=axes, label="entropy")
