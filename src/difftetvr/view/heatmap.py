"""Numbers per pixel as colours, with their scale beside them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from difftetvr.errors import CaptureError
from difftetvr.files import atomic_write

COLORMAP = "viridis"
"""The colours of numbers."""

_DPI = 100
_DARK = 0.08  # what is around pictures, and where there is no number
_SCALE_WIDTH = 90  # pixels beside the picture
_MARGIN = 0.08  # of the scale's ends, so that its numbers are whole


@dataclass(frozen=True)
class Scale:
    """What is shown, the values at the ends of the colour scale, and whether it is logarithmic in between."""

    label: str
    lowest: float
    highest: float
    is_logarithmic: bool = False


def heat_colors(values: torch.Tensor, scale: Scale) -> torch.Tensor:
    """(H, W, 3) float32 colours of (H, W) numbers; NaN is left dark."""
    numbers = values.detach().cpu().numpy()
    colors = torch.from_numpy(colormaps[COLORMAP](_norm(scale)(numbers).filled(0.0))[..., :3]).float()
    return torch.where(values.detach().cpu().isnan()[..., None], _DARK, colors)


def _norm(scale: Scale) -> Normalize:
    """Where on the colour scale numbers lie."""
    return (LogNorm if scale.is_logarithmic else Normalize)(scale.lowest, scale.highest, clip=True)


def save_heatmap(path: str | Path, values: torch.Tensor, scale: Scale) -> None:
    """Writes a PNG with one pixel for each value, and the colour scale on its right.

    Args:
        path: File to write.
        values: (H, W); NaN is left dark.
        scale: What they are.

    Raises:
        CaptureError: The file cannot be written.
    """
    height, width = values.shape
    tall = max(height, 160)
    figure = Figure(figsize=((width + _SCALE_WIDTH) / _DPI, tall / _DPI), dpi=_DPI, facecolor=str(_DARK))
    canvas = FigureCanvasAgg(figure)
    whole = width + _SCALE_WIDTH
    axes = figure.add_axes((0.0, 1.0 - height / tall, width / whole, height / tall))
    axes.set_axis_off()
    image = axes.imshow(
        values.detach().cpu().numpy(),
        cmap=COLORMAP,
        norm=_norm(scale),
        interpolation="nearest",
        aspect="auto",
    )
    side = figure.add_axes(((width + 14) / whole, _MARGIN, 12 / whole, 1.0 - 2.0 * _MARGIN))
    bar = figure.colorbar(image, cax=side)
    bar.set_label(scale.label, color="white")
    bar.ax.tick_params(colors="white")
    with atomic_write(Path(path), CaptureError) as temporary, open(temporary, "wb") as file:
        canvas.print_png(file)
