"""The output folder of a reconstruction from projections: model, numbers, curves, slices and sinograms."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from difftetvr.capture.volumes.voxels import load_volume
from difftetvr.errors import CaptureError, CaptureWarning
from difftetvr.fitting.metrics import psnr_of_mse
from difftetvr.fitting.records.folder import RunFolder, write_json
from difftetvr.inverse.tomography.loop import TomographyResult
from difftetvr.inverse.tomography.measurements import Measurements
from difftetvr.mesh.io import save
from difftetvr.rendering import render
from difftetvr.sampling.voxels import voxelise
from difftetvr.view.pictures import below, beside, labelled, save_picture, to_picture
from difftetvr.view.plots import save_curves

_SLICE_PIXELS = 384
_DIFFERENCE_GAIN = 4.0
_COMPARED_VIEWS = 3
_AXES = ("x", "y", "z")
_THICK = 16


@dataclass(frozen=True)
class Truth:
    """What projections are of.

    Attributes:
        values: (X, Y, Z) at the centres of voxels that fill the box to reconstruct.
    """

    values: torch.Tensor


def read_truth(path: Path) -> Truth:
    """The volume to compare with.

    Raises:
        CaptureError: It cannot be read, or holds nothing.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        values = load_volume(path).values.float()
    if not float(values.max()) > 0.0:
        raise CaptureError(f"'{path}' is greater than 0 nowhere, so nothing can be compared with it; leave it out.")
    return Truth(values)


def write_scan_report(
    folder: RunFolder, result: TomographyResult, scan: Measurements, truth: Truth | None = None
) -> dict[str, Any]:
    """Writes everything that a run leaves behind; the metrics come last, so they stand for a complete folder.

    Args:
        folder: Existing folder.
        result: The finished reconstruction.
        scan: The projections that it was made from.
        truth: What they are of, if that is known.

    Returns:
        What comparing with the truth says; nothing without one.

    Raises:
        MeshError: The model cannot be written.
        CaptureError: A picture cannot be written.
        FitError: The curves or the metrics cannot be written.
    """
    save(folder.model, result.mesh, point_data={"density": result.field.density})
    save_curves(folder.curves, result.history)
    save_picture(folder.cut, _slices(result, scan, truth))
    save_picture(folder.comparison, _views(result, scan))
    compared = {} if truth is None else {"volume_psnr": volume_psnr(result, scan, truth)}
    unit = {"unit_of_length": scan.capture.geometry.unit}
    write_json(folder.metrics, {"capture": scan.capture.name, **unit, **result.metrics, **compared})
    return compared


def volume_psnr(result: TomographyResult, scan: Measurements, truth: Truth) -> float:
    """PSNR in dB of the densities at the centres of the truth's voxels, with its greatest value as peak."""
    low, high = scan.capture.geometry.bounds
    spacing = (high - low) / torch.tensor(truth.values.shape)
    origin = (low + 0.5 * spacing).tolist()
    found = voxelise(result.mesh, result.field.density, origin, spacing.tolist(), truth.values.shape)
    error = float((found.cpu() - truth.values).double().square().mean())
    peak = float(truth.values.abs().max())
    return psnr_of_mse(error / (peak * peak)) if peak > 0 else float("nan")


def _slices(result: TomographyResult, scan: Measurements, truth: Truth | None) -> Image.Image:
    """The middle slices across all axes: what was found, and beside it what is true and the difference."""
    brightest = float((result.field.density if truth is None else truth.values).max())
    rows = []
    sides = scan.capture.geometry.bounds[1] - scan.capture.geometry.bounds[0]
    # Across the other axes, thin slabs show nothing.
    seen = [axis for axis in range(3) if _THICK * sides[axis] >= sides.max()]
    for axis in seen if len(seen) == 3 else [int(sides.argmin())]:
        found = _slice(result, scan, axis) / max(brightest, 1e-30)
        panels = []
        if truth is not None:
            true = truth.values.select(axis, truth.values.shape[axis] // 2) / max(brightest, 1e-30)
            true = torch.nn.functional.interpolate(true[None, None], found.shape, mode="nearest")[0, 0]
            panels.append(("truth", true))
        panels.append((f"found, across {_AXES[axis]}", found))
        if truth is not None:
            panels.append((f"difference x {_DIFFERENCE_GAIN:g}", _DIFFERENCE_GAIN * (found - panels[0][1]).abs()))
        rows.append(beside([_panel(label, image) for label, image in panels]))
    return beside(rows) if truth is None else below(rows)


def _slice(result: TomographyResult, scan: Measurements, axis: int) -> torch.Tensor:
    """(A, B) densities in the middle of the box, across an axis."""
    low, high = scan.capture.geometry.bounds
    sides = high - low
    step = float(sides.max()) / _SLICE_PIXELS
    shape = [max(1, round(float(side) / step)) for side in sides]
    shape[axis] = 1
    spacing = [float(side) / count for side, count in zip(sides, shape, strict=True)]
    origin = [float(start) + 0.5 * part for start, part in zip(low, spacing, strict=True)]
    found = voxelise(result.mesh, result.field.density, origin, spacing, shape)
    return found.select(axis, 0).cpu()


def _views(result: TomographyResult, scan: Measurements) -> Image.Image:
    """Some views as measured, as predicted, and the residuals in units of the noise."""
    views = scan.test or scan.train
    chosen = views[:: max(1, -(-len(views) // _COMPARED_VIEWS))]
    rows = []
    for view in chosen:
        with torch.no_grad():
            part = scan.pixels(view, scan.all_pixels, alignment=result.alignment)
            found = render(result.mesh, result.field, part.camera).optical_depth
        residual = (found - part.measured) * part.weight.sqrt()
        # Grey is none; black and white are three times the noise.
        panels = [
            (f"measured, view {view}", part.measured / scan.peak),
            ("predicted", found / scan.peak),
            ("residual, -3 to 3 times the noise", 0.5 + residual / 6.0),
        ]
        rows.append(beside([_panel(label, image.cpu()) for label, image in panels]))
    return below(rows)


def _panel(label: str, image: torch.Tensor) -> Image.Image:
    # Rows of detectors with few are repeated, that they can be seen; the first axis of slices points right.
    height, width = image.shape
    times = max(1, round(width / (8 * height)))
    return labelled(to_picture(image.repeat_interleave(times, 0)[..., None].expand(-1, -1, 3)), label)
