"""Descriptions of meshes, captures and results as tables for the terminal."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import torch
from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from difftetvr.capture.capture import Capture
from difftetvr.capture.degenerate import why_degenerate
from difftetvr.capture.packed import Masks
from difftetvr.capture.projections.projection_capture import ProjectionCapture
from difftetvr.capture.volumes.summary import VolumeSummary
from difftetvr.capture.volumes.value_range import range_text
from difftetvr.errors import counted
from difftetvr.fitting.records.evaluation import Evaluation
from difftetvr.mesh.field import Field
from difftetvr.mesh.frame import WORLD
from difftetvr.mesh.harmonics import COUNTS
from difftetvr.mesh.io import Defects
from difftetvr.mesh.making.delaunay_check import is_convex, is_delaunay
from difftetvr.mesh.making.overlaps import overlapping_cells
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering.cameras.lens import LensCamera

_QUALITY_BINS = 10
_BAR_WIDTH = 30
_SIZES_SHOWN = 4


@dataclass(frozen=True)
class _Bar:
    """A horizontal bar, of blocks where the output's encoding is known to have them."""

    length: int

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(("#" if options.ascii_only else "█") * self.length)

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(self.length, self.length)


def mesh_tables(name: str, mesh: TetMesh, field: Field | None, defects: Defects | None = None) -> list[Table]:
    """Size, soundness, bounds and attributes of a mesh, and the histogram of its cells' quality Q.

    Args:
        name: Title, such as the file's name.
        mesh: The mesh.
        field: Its colours and densities, if it has any.
        defects: What was wrong with the cells of its file, if it comes from one.
    """
    lower, upper = mesh.bounds().tolist()
    table = _table(name)
    table.add_row("cells", f"{mesh.num_cells:,}")
    _add_soundness(table, mesh, defects)
    table.add_row(
        "vertices", f"{mesh.num_vertices:,}, {'double' if mesh.vertices.dtype == torch.float64 else 'single'} precision"
    )
    if mesh.is_conforming:
        table.add_row("boundary faces", f"{mesh.topology.boundary_faces.shape[0]:,}")
        convex = is_convex(mesh.vertices, mesh.topology)
        table.add_row("convex", "yes" if convex else "no")
        table.add_row("Delaunay", "yes" if convex and is_delaunay(mesh.vertices, mesh.topology) else "no")
    table.add_row("bounds", f"{_point(lower)} to {_point(upper)}")
    if mesh.origin != WORLD:
        table.add_row("counted from", f"{_point(list(mesh.origin))}, as it lies far from (0, 0, 0)")
    table.add_row("volume", f"{float(mesh.volumes().double().sum()):.6g}")
    if field is None:
        table.add_row("color and density", "none")
    else:
        location = field.location_on(mesh)
        table.add_row("color", f"per {location}, {_range(field.color)}")
        if field.harmonics is not None:
            table.add_row("harmonics", f"bands up to {COUNTS.index(field.harmonics.shape[1])}")
        table.add_row("density", f"per {location}, {_range(field.density)} per unit length")
    return [table, _quality_table(mesh)]


def _add_soundness(table: Table, mesh: TetMesh, defects: Defects | None) -> None:
    """What is wrong with the cells, in rows that say "none" where nothing is."""
    overlapping = int(overlapping_cells(mesh).sum())
    table.add_row("overlapping cells", f"{overlapping:,}" if overlapping else "none")
    if defects is None:
        return
    table.add_row("flat cells", f"{defects.flat:,}, left out" if defects.flat else "none")
    for what, count in (
        ("repeated cells", defects.repeated),
        ("cells not finite", defects.not_finite),
    ):
        if count:
            table.add_row(what, f"{count:,}, left out")
    if not mesh.is_conforming:
        table.add_row("faces of 3 or more cells", f"{defects.crowded_faces:,}")
        table.add_row("faces with both cells on one side", f"{defects.folded_faces:,}")


def data_table(point_data: dict[str, torch.Tensor], cell_data: dict[str, torch.Tensor]) -> Table | None:
    """Place, components and range of a mesh's data.

    Args:
        point_data: Arrays of one row for each vertex.
        cell_data: Arrays of one row for each cell.

    Returns:
        The table; None where there are no data.
    """
    if not point_data and not cell_data:
        return None
    table = Table(title="data", title_justify="left")
    for column in ("name", "per", "components", "range"):
        table.add_column(column, justify="right" if column == "components" else "left", overflow="fold")
    for place, arrays in (("vertex", point_data), ("cell", cell_data)):
        for name, values in arrays.items():
            shape = " x ".join(str(n) for n in values.shape[1:]) or "1"
            table.add_row(Text(name), place, shape, _finite_range(values))
    return table


def run_table(name: str, config: dict[str, Any], metrics: dict[str, Any]) -> Table:
    """What a model was fitted to, and how well.

    Args:
        name: Title.
        config: Options of the run, as its config.json has them.
        metrics: Numbers of its result, as its metrics.json has them; empty for a run that has not ended.
    """
    table = _table(name)
    rows: list[tuple[str, Any]] = [("capture", config.get("capture"))]
    rows += [("iterations", metrics.get("iterations")), ("seconds", metrics.get("seconds"))]
    rows += [("held-out PSNR (dB)", metrics.get("psnr")), ("held-out SSIM", metrics.get("ssim"))]
    for key, value in rows:
        if value is not None:
            table.add_row(key, Text(f"{value:.4g}" if isinstance(value, float) else str(value)))
    return table


def capture_table(name: str, capture: Capture) -> Table:
    """Number and size of the images, split and bounds of a capture."""
    lower, upper = capture.bounds.tolist()
    table = _table(name)
    table.add_row("views", _views(capture))
    sizes = Counter(capture.image_sizes).most_common()
    table.add_row("image size" if len(sizes) == 1 else "image sizes", _sizes(sizes))
    lenses = Counter(camera.model for camera in capture.cameras if isinstance(camera, LensCamera)).most_common()
    if lenses:
        table.add_row("lenses", ", ".join(f"{model} ({counted(count, 'view')})" for model, count in lenses))
    table.add_row("alpha", "known" if capture.alphas is not None else "unknown")
    table.add_row("colours", "linear" if capture.encoding == "linear" else "sRGB-encoded, as stored")
    if capture.points is not None:
        table.add_row("sparse points", f"{capture.points.shape[0]:,}")
    table.add_row("bounds", f"{_point(lower)} to {_point(upper)}")
    if capture.surroundings > 1.0:
        table.add_row("surroundings", f"{capture.surroundings:.3g} times as large")
    if capture.valid is not None:
        table.add_row("masked", f"{100.0 * _masked_share(capture.valid):.1f} % of the pixels")
    if (reason := why_degenerate(capture)) is not None:
        table.add_row("degenerate", reason)
    table.add_row("density unit", f"{capture.density_unit:g} per unit length")
    return table


def scan_table(name: str, scan: ProjectionCapture) -> Table:
    """Number and size of the views, geometry and line integrals of projections."""
    geometry, values = scan.geometry, scan.line_integrals
    _, height, width = geometry.shape
    lower, upper = geometry.bounds.tolist()
    unit = "" if geometry.unit is None else f" {geometry.unit}"
    table = _table(name)
    table.add_row("views", _views(scan))
    table.add_row("pixels", f"{width} x {height}")
    table.add_row("rays", "parallel" if geometry.detector.source is None else "from a source")
    if geometry.angles is not None:
        table.add_row("angles", f"{range_text((float(geometry.angles.min()), float(geometry.angles.max())))} degrees")
    table.add_row("box", f"{_point(lower)} to {_point(upper)}{unit}")
    known = values if scan.valid is None else values[scan.valid]
    table.add_row("line integrals", range_text((float(known.min()), float(known.max()))))
    table.add_row("variance", "estimated" if scan.variance is None else "known")
    if scan.valid is not None:
        table.add_row("left out", f"{100.0 * (1.0 - len(known) / values.numel()):.2g} % of the pixels")
    return table


def _views(capture: Capture | ProjectionCapture) -> str:
    train, test = len(capture.train_indices), len(capture.test_indices)
    return f"{train + test} ({train} training, {test} held out)"


def volume_table(name: str, summary: VolumeSummary) -> Table:
    """Resolution, spacing and values of a volume."""
    table = _table(name)
    table.add_row("resolution", " x ".join(str(n) for n in summary.resolution))
    table.add_row("spacing", " x ".join(f"{s:.4g}" for s in summary.spacing))
    missing = f", {summary.missing:,} not finite" if summary.missing else ""
    ends = "none is finite" if summary.ends is None else range_text(summary.ends)
    table.add_row("values", f"{summary.dtype}, {ends}{missing}")
    for share, value in summary.quantiles.items():
        table.add_row(f"{100 * share:g} % below", f"{value:.6g}")
    if summary.value_range is None:
        table.add_row("0 to 1", "nothing: all values are the same")
    else:
        table.add_row("0 to 1", f"values {range_text(summary.value_range)}; --value-range says otherwise")
    return table


def evaluation_table(evaluation: Evaluation, lpips: list[float] | None = None) -> Table:
    """PSNR and SSIM per view, LPIPS where it is known, and their means."""
    columns = {"PSNR (dB)": [f"{value:.2f}" for value in _with_mean(evaluation.psnr)]}
    columns["SSIM"] = [f"{value:.4f}" for value in _with_mean(evaluation.ssim)]
    if lpips is not None:
        columns["LPIPS"] = [f"{value:.4f}" for value in _with_mean(lpips)]
    table = Table()
    for column in ("view", *columns):
        table.add_column(column, justify="right")
    names = [*map(str, evaluation.views), "mean"] if evaluation.views else []
    for row, name in enumerate(names):
        if name == "mean":
            table.add_section()
        table.add_row(name, *(values[row] if values else "-" for values in columns.values()))
    return table


def _with_mean(values: list[float]) -> list[float]:
    return [*values, sum(values) / len(values)] if values else []


def _quality_table(mesh: TetMesh) -> Table:
    quality = mesh.quality().detach().double().cpu()
    counts = torch.histc(quality.clamp(0, 1), _QUALITY_BINS, 0.0, 1.0).long().tolist()
    table = Table(title=f"quality Q: least {quality.min():.3g}, mean {quality.mean():.3g}", title_justify="left")
    for column in ("Q", "cells", ""):
        table.add_column(column, justify="left" if not column else "right")
    for i, count in enumerate(counts):
        bar = _Bar(round(_BAR_WIDTH * count / max(counts)))
        table.add_row(f"{i / _QUALITY_BINS:.1f} - {(i + 1) / _QUALITY_BINS:.1f}", f"{count:,}", bar)
    return table


def _table(title: str) -> Table:
    # As Text, because rich reads markup in plain strings, and square brackets may be part of a file's name.
    table = Table(title=Text(title), title_justify="left", show_header=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    return table


def _sizes(sizes: list[tuple[tuple[int, int], int]]) -> str:
    """The sizes in pixels that views have, the most frequent first, each with the number of its views."""
    if len(sizes) == 1:
        (width, height), _ = sizes[0]
        return f"{width} x {height}"
    shown = [f"{width} x {height} ({counted(count, 'view')})" for (width, height), count in sizes[:_SIZES_SHOWN]]
    others = len(sizes) - len(shown)
    return ", ".join([*shown, counted(others, "other size")] if others else shown)


def _masked_share(valid: Masks) -> float:
    """Share of all views' pixels that are not valid."""
    masks = [valid[view] for view in range(len(valid))]
    return sum(int((~mask).sum()) for mask in masks) / sum(mask.numel() for mask in masks)


def _point(values: list[float]) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in values) + ")"


def _finite_range(values: torch.Tensor) -> str:
    if not values.is_floating_point():
        integers = values.numpy()  # torch finds no least one of uint64
        return f"{integers.min()} to {integers.max()}"
    finite = values[values.isfinite()]
    if not finite.numel():
        return "no finite values"
    missing = values.numel() - finite.numel()
    return _range(finite) + (f", {missing:,} not finite" if missing else "")


def _range(values: torch.Tensor) -> str:
    return f"{float(values.min()):.4g} to {float(values.max()):.4g}"
