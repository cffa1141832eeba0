"""What a fit of a transfer function has found: views, and the curves of the functions."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from difftetvr.capture.capture import Capture
from difftetvr.capture.truth import BLACK, WHITE
from difftetvr.fitting.metrics import psnr
from difftetvr.fitting.records.evaluation import rendered_image, true_image, where_valid
from difftetvr.inverse.transfer.fit import TransferResult
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.rendering import ScalarField
from difftetvr.view.pictures import below, beside, labelled, save_picture, to_picture

_VIEWS = 3
_DIFFERENCE = 4
_SAMPLES = 512
_DPI = 100


def save_transfer_report(
    path: str | Path, mesh: TetMesh, result: TransferResult, capture: Capture, truth: TransferFunction | None = None
) -> None:
    """Writes a PNG: truth, start, result and difference of some views, and the curves of the functions below.

    Args:
        path: File to write.
        mesh: The mesh of the scalars.
        result: What was found.
        capture: The images.
        truth: The function that made them, where it is known.

    Raises:
        CaptureError: The file cannot be written.
    """
    views = (capture.test_indices.tolist() or capture.train_indices.tolist())[:_VIEWS]
    behind = BLACK if capture.alphas is None else WHITE
    field = result.field
    begun = ScalarField(field.scalar, result.start, field.attenuation, field.value_range, field.location)
    rows = []
    for view in views:
        expected = true_image(capture, view, behind)
        panels = [(f"truth, view {view}", expected)]
        for name, shown in (("start", begun), ("ours", field)):
            image = where_valid(capture, view, rendered_image(mesh, shown, capture, view, behind), expected)
            panels.append((f"{name}, {psnr(image, expected):.2f} dB", image))
        panels.append((f"difference x {_DIFFERENCE}", _DIFFERENCE * (panels[-1][1] - expected).abs()))
        rows.append(beside([labelled(to_picture(image), label) for label, image in panels]))
    functions = [("start", result.start), ("ours", result.transfer_function)]
    if truth is not None:
        functions.insert(0, ("truth", truth))
    save_picture(path, below([*rows, draw_functions(functions, max(row.width for row in rows))]))


def draw_functions(functions: Sequence[tuple[str, TransferFunction]], width: int = 1000) -> Image.Image:
    """Opacities over the scalar, and a strip of colours for each function.

    Args:
        functions: Names and functions.
        width: Pixels.
    """
    height = 240 + 40 * len(functions)
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    ratios = [200, *[34] * len(functions)]
    curve_axes, *strips = figure.subplots(len(functions) + 1, 1, sharex=True, gridspec_kw={"height_ratios": ratios})
    looks: dict[str, Any] = {"truth": {"color": "black", "linewidth": 2.5}, "start": {"color": "0.6"}}
    for (name, function), strip in zip(functions, strips, strict=True):
        knots, opacity = function.scalar.detach().cpu(), function.opacity.detach().cpu()
        style = looks.get(name, {"color": "tab:red", "marker": ".", "markersize": 5, "linewidth": 1.2})
        curve_axes.plot([0.0, *knots, 1.0], [opacity[0], *opacity, opacity[-1]], label=name, **style)
        colors = function(torch.linspace(0.0, 1.0, _SAMPLES))[0].detach().clamp(0.0, 1.0).cpu().numpy()
        strip.imshow(np.repeat(colors[None], 2, axis=0), extent=(0.0, 1.0, 0.0, 1.0), aspect="auto")
        strip.set_yticks([])
        strip.set_ylabel(name, rotation=0, ha="right", va="center")
    curve_axes.set(xlim=(0.0, 1.0), ylim=(-0.02, 1.02), ylabel="opacity")
    curve_axes.grid(alpha=0.3)
    curve_axes.legend()
    strips[-1].set_xlabel("scalar")
    content = io.BytesIO()
    canvas.print_png(content)
    return Image.open(content).convert("RGB")
