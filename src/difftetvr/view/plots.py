"""Plots of a reconstruction's course."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from difftetvr.files import atomic_write
from difftetvr.fit.checkpoint import History
from difftetvr.fit.errors import FitError

_SMOOTHING = 64


def save_curves(path: str | Path, history: History) -> None:
    """Writes a PNG with the loss and the PSNR against the iteration.

    Pale lines are single iterations, strong ones moving means; dots are glances at a few held-out views.

    Args:
        path: File to write.
        history: What happened; may be empty.

    Raises:
        FitError: The file cannot be written.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    loss_axes, psnr_axes = figure.subplots(1, 2)
    _plot(loss_axes, history.loss, "loss")
    loss_axes.set_yscale("log")
    _plot(psnr_axes, history.psnr, "training views")
    if history.evaluations:
        iterations, values = zip(*history.evaluations, strict=True)
        psnr_axes.plot(iterations, values, "o-", color="tab:orange", markersize=4, label="held-out views")
    for axes, label in ((loss_axes, "loss"), (psnr_axes, "PSNR (dB)")):
        axes.set_xlabel("iteration")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    if history.loss:
        psnr_axes.legend()
    with atomic_write(Path(path), FitError) as temporary, open(temporary, "wb") as file:
        canvas.print_png(file)


def _plot(axes, values: list[float], label: str) -> None:  # type: ignore[no-untyped-def]
    """Single values pale, their moving mean strong."""
    if not values:
        return
    x = np.arange(1, len(values) + 1)
    axes.plot(x, values, color="tab:blue", alpha=0.25, linewidth=0.6)
    window = min(_SMOOTHING, len(values))
    mean = np.convolve(values, np.full(window, 1.0 / window), mode="valid")
    axes.plot(x[window - 1 :], mean, color="tab:blue", label=label)
