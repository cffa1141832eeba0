"""Plots of a reconstruction's course."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from difftetvr.errors import FitError
from difftetvr.files import atomic_write
from difftetvr.fitting.records.history import History, RefinementRecord

_SMOOTHING = 64


def save_curves(path: str | Path, history: History) -> None:
    """Writes a PNG with the loss and the PSNR against the iteration, and predicted against achieved gains.

    Pale lines are single iterations, strong ones moving means; dots are glances at a few held-out views, dotted lines
    refinements. The third plot is there if the refinements of the run predicted what they would win.

    Args:
        path: File to write.
        history: What happened; may be empty.

    Raises:
        FitError: The file cannot be written.
    """
    predicting = [record for record in history.refinements if record.predicted is not None]
    count = 3 if predicting else 2
    figure = Figure(figsize=(5 * count, 4), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    loss_axes, psnr_axes, *gain_axes = figure.subplots(1, count)
    _plot(loss_axes, history.loss, "loss")
    loss_axes.set_yscale("log")
    _plot(psnr_axes, history.psnr, "training views")
    if history.evaluations:
        iterations, values = zip(*history.evaluations, strict=True)
        psnr_axes.plot(iterations, values, "o-", color="tab:orange", markersize=4, label="held-out views")
    for axes, label in ((loss_axes, "loss"), (psnr_axes, "PSNR (dB)")):
        for record in history.refinements:
            axes.axvline(record.iteration, color="gray", linestyle=":", linewidth=0.7)
        axes.set_xlabel("iteration")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    if history.loss:
        psnr_axes.legend()
    for axes in gain_axes:
        _plot_gains(axes, predicting)
    with atomic_write(Path(path), FitError) as temporary, open(temporary, "wb") as file:
        canvas.print_png(file)


def _plot_gains(axes, records: list[RefinementRecord]) -> None:  # type: ignore[no-untyped-def]
    """Achieved against predicted decrease of the error, one dot a refinement, numbered in their order."""
    predicted = [record.predicted or 0.0 for record in records]
    achieved = [record.achieved for record in records]
    ends = [min(0.0, *predicted, *achieved), max(*predicted, *achieved)]
    axes.plot(ends, ends, color="gray", linewidth=0.8, label="as predicted")
    axes.axhline(0.0, color="black", linewidth=0.5)
    axes.scatter(predicted, achieved, s=14, color="tab:blue")
    for number, place in enumerate(zip(predicted, achieved), 1):
        axes.annotate(str(number), place, xytext=(3, 3), textcoords="offset points", fontsize=7)
    linear = max(1e-2 * max(abs(end) for end in ends), 1e-12)
    axes.set_xscale("symlog", linthresh=linear)
    axes.set_yscale("symlog", linthresh=linear)
    axes.set_xlabel("predicted decrease of the squared error")
    axes.set_ylabel("achieved decrease, at once")
    axes.grid(alpha=0.3)
    axes.legend()


def _plot(axes, values: list[float], label: str) -> None:  # type: ignore[no-untyped-def]
    """Single values pale, their moving mean strong."""
    if not values:
        return
    x = np.arange(1, len(values) + 1)
    axes.plot(x, values, color="tab:blue", alpha=0.25, linewidth=0.6)
    window = min(_SMOOTHING, len(values))
    mean = np.convolve(values, np.full(window, 1.0 / window), mode="valid")
    axes.plot(x[window - 1 :], mean, color="tab:blue", label=label)
