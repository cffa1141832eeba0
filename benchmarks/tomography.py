"""Meshes from the projections that voxels are fitted to in `peers/tomography_voxels.py`, in the same columns.

python benchmarks/tomography.py SCAN [--truth VOLUME] [--rows moving fixed] [--cells 350000 1000000] [--tv 0.004 ...]
    [--iterations 1500] [--rounds 30] [--rays 65536] [--holdout-every N] [--csv FILE] [--keep FOLDER]

SCAN is what `difftetvr fit` takes as projections. "moving" is a mesh whose vertices move and that exchanges cells,
"fixed" the uniform grid of as many cells, of which the densities alone are learned. Where several weights of the total
variation are given, each is a row; choose among them by the held-out projections. Nothing that makes a row sees the
truth. Unknowns are densities, and of moving meshes the coordinates of as many vertices.

Held-out PSNR is against the views as they were measured, noise and all, with the greatest line integral as peak; PSNR
in 3-D is at the middles of the truth's voxels, with its greatest value as peak. Seconds are those of the iterations and
of the solver after them, of this process on its cores (CPU) and by the clock.
"""

from __future__ import annotations

import argparse
import csv
import resource
import time
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

from rich.console import Console
from rich.table import Table

from difftetvr.capture import ProjectionCapture
from difftetvr.files import atomic_write
from difftetvr.fitting import ProgressDisplay
from difftetvr.inverse.tomography import TomographyConfig, TomographyResult, reconstruct
from difftetvr.inverse.tomography.measurements import Measurements
from difftetvr.mesh.io import save
from difftetvr.view.scan_report import Truth, read_truth, volume_psnr

ROWS = ("moving", "fixed")


@dataclass(frozen=True)
class Row:
    """A row of the table; PSNR in dB, NaN where it is not known."""

    mesh: str
    total_variation: float
    cells: int
    unknowns: int
    cpu_seconds: float
    wall_seconds: float
    projection_psnr: float
    residual_in_noise: float
    volume_psnr: float


def configs_of(options: argparse.Namespace) -> list[tuple[str, TomographyConfig]]:
    """Names of all rows, with how they are made."""
    rounds = replace(TomographyConfig().exchange, rounds=options.rounds)
    common = TomographyConfig(iterations=options.iterations, rays=options.rays, exchange=rounds, evaluate_every=0)
    made = []
    for name, cells, weight in product(options.rows, options.cells, options.tv):
        config = replace(common, cells=cells, total_variation=weight)
        made.append((name, config if name == "moving" else replace(config, move=False, refine="none")))
    return made


def row_of(
    name: str, config: TomographyConfig, capture: ProjectionCapture, truth: Truth | None, console: Console
) -> tuple[Row, TomographyResult]:
    """Makes a row."""
    before, start = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    with ProgressDisplay(console) as display:
        result = reconstruct(capture, config, on_progress=display)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    scan = Measurements(capture, result.mesh.vertices.device)
    row = Row(
        name,
        config.total_variation,
        result.mesh.num_cells,
        result.mesh.num_vertices * (4 if config.move else 1),
        cpu,
        wall,
        result.score.mean_psnr,
        result.score.mean_noise,
        float("nan") if truth is None else volume_psnr(result, scan, truth),
    )
    return row, result


def table_of(rows: list[Row], title: str) -> Table:
    """The rows, to be printed."""
    table = Table(title=title)
    columns = ("mesh", "TV", "cells", "unknowns", "CPU s", "wall s", "held-out projections, dB", "/ noise", "3-D, dB")
    for heading in columns:
        table.add_column(heading, justify="left" if heading == "mesh" else "right")
    for row in rows:
        sizes = (f"{row.cells:,}", f"{row.unknowns:,}", f"{row.cpu_seconds:.0f}", f"{row.wall_seconds:.0f}")
        quality = (f"{row.projection_psnr:.2f}", f"{row.residual_in_noise:.3f}", f"{row.volume_psnr:.2f}")
        table.add_row(row.mesh, f"{row.total_variation:g}", *sizes, *quality)
    return table


def write_csv(path: Path, rows: list[Row]) -> None:
    """All rows so far, whole or not at all."""
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(Row.__dataclass_fields__), lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan")
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--cells", type=int, nargs="+", default=[350_000])
    parser.add_argument("--tv", type=float, nargs="+", default=[0.004])
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--rays", type=int, default=65_536)
    parser.add_argument("--holdout-every", type=int, default=10)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    capture = ProjectionCapture.load(options.scan, options.holdout_every)
    truth = None if options.truth is None else read_truth(options.truth)
    console, rows = Console(), []
    for name, config in configs_of(options):
        row, result = row_of(name, config, capture, truth, console)
        rows.append(row)
        if options.csv is not None:
            write_csv(options.csv, rows)
        if options.keep is not None:
            options.keep.mkdir(parents=True, exist_ok=True)
            file = options.keep / f"{name}-{row.cells}-{row.total_variation:g}.vtu"
            save(file, result.mesh, point_data={"density": result.field.density})
    views = f"{len(capture.train_indices)} views to learn from, {len(capture.test_indices)} held out"
    console.print(table_of(rows, f"{options.scan}: {views}"))


if __name__ == "__main__":
    main()
