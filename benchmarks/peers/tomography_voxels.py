"""Voxels from the projections that meshes are fitted to: FDK or FBP, OS-SART, and least squares with total variation.

python benchmarks/peers/tomography_voxels.py SCAN [--truth VOLUME] [--sizes 128 256] [--rows fdk sart tv blurred]
    [--holdout-every N] [--bin N] [--tv 0.00625 ...] [--cutoffs 0.3 ...] [--csv FILE] [--keep FOLDER]

SCAN is what `difftetvr fit` takes as projections. Where several weights of the total variation or several cut-off
frequencies are given, each is a row; choose among them by the held-out projections, quickest with fewer pixels (--bin).
Nothing that makes a row sees the truth. "blurred" is the truth itself after a Gaussian of so many voxels.

Held-out PSNR is against the views as they were measured, noise and all, with the greatest line integral as peak; PSNR
in 3-D is at the middles of the truth's voxels with peak 1. A row's seconds are those of all its levels, of this
process on its cores (CPU) and by the clock.
"""

from __future__ import annotations

import argparse
import csv
import math
import resource
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.ndimage import gaussian_filter
from tomography_fdk import Feldkamp, feldkamp
from tomography_iterations import Sart, Variational, sart, variational
from tomography_projector import VoxelProjector
from tomography_scan import VoxelScan, binned

from difftetvr.capture import ProjectionCapture, load_volume
from difftetvr.files import atomic_write
from difftetvr.fitting.metrics import psnr_of_mse

BLURS = (1.0, 1.5)
ROWS = ("fdk", "sart", "tv", "blurred")


@dataclass(frozen=True)
class Row:
    """A row of the table; PSNR in dB, NaN where it is not known."""

    method: str
    size: int
    unknowns: int
    cpu_seconds: float
    wall_seconds: float
    projection_psnr: float
    volume_psnr: float


class Bench:
    """Reconstructions of one scan, each a row."""

    def __init__(self, capture: ProjectionCapture, truth: torch.Tensor | None, watch: Callable[[str], None]) -> None:
        """For a scan, and (X, Y, Z) values that nothing but the last column looks at."""
        self.scan, self.watch = VoxelScan.of(capture), watch
        self._truth = None if truth is None else truth.permute(2, 1, 0).float().contiguous()

    def row(self, name: str, size: int, make: Callable[[], torch.Tensor]) -> tuple[Row, torch.Tensor]:
        """Make a volume and judge it."""
        cpu, start = cpu_seconds(), time.perf_counter()
        volume = make()
        spent = (cpu_seconds() - cpu, time.perf_counter() - start)
        projector = VoxelProjector(self.scan.geometry, size)
        psnr = self.scan.held_out_psnr(volume, projector)
        found = Row(name, size, size**3, *spent, psnr, self.psnr_of_volume(volume, size))
        self.watch(f"{name} {size}^3: {psnr:.2f} dB held out, {found.volume_psnr:.2f} dB in 3-D, {spent[0]:.0f} CPU s")
        return found, volume

    def psnr_of_volume(self, volume: torch.Tensor, size: int) -> float:
        """PSNR at the middles of the truth's voxels; NaN without a truth, or where voxels do not nest."""
        if self._truth is None or any(n % size for n in self._truth.shape):
            return math.nan
        cube = volume.reshape(size, size, size)
        for axis, count in enumerate(self._truth.shape):
            cube = cube.repeat_interleave(count // size, axis)
        return psnr_of_mse(float((cube - self._truth).double().square().mean()))

    def blurred(self, sigma: float) -> tuple[Row, torch.Tensor]:
        """The truth after a Gaussian."""
        assert self._truth is not None
        smooth = torch.from_numpy(gaussian_filter(self._truth.numpy(), sigma, mode="nearest")).reshape(-1)
        return self.row(f"truth blurred, sigma {sigma:g} voxels", len(self._truth), lambda: smooth)


def cpu_seconds() -> float:
    """Seconds that cores have spent on this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def rows_of(bench: Bench, options: argparse.Namespace) -> Iterator[tuple[Row, torch.Tensor]]:
    """All rows that are asked for, one after another."""
    scan, watch = bench.scan, bench.watch
    backprojection = "FBP" if scan.geometry.detector.source is None else "FDK"
    for size in options.sizes:
        for cutoff in options.cutoffs if "fdk" in options.rows else ():
            make = partial(feldkamp, scan, size, Feldkamp(cutoff))
            yield bench.row(f"{backprojection}, Hann to {cutoff:g}", size, make)
        if "sart" in options.rows:
            yield bench.row("OS-SART", size, partial(sart, scan, size, Sart(), watch))
        for weight in options.tv if "tv" in options.rows else ():
            make = partial(variational, scan, size, Variational(weight), watch)
            yield bench.row(f"total variation {weight:g}", size, make)
    if "blurred" in options.rows and options.truth is not None:
        yield from (bench.blurred(sigma) for sigma in BLURS)


def table_of(rows: list[Row], title: str) -> Table:
    table = Table(title=title)
    for heading in ("method", "N", "unknowns", "CPU s", "wall s", "held-out projections, dB", "3-D, dB"):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for row in rows:
        seconds = (f"{row.cpu_seconds:.0f}", f"{row.wall_seconds:.0f}")
        psnr = (f"{row.projection_psnr:.2f}", f"{row.volume_psnr:.2f}")
        table.add_row(row.method, str(row.size), f"{row.unknowns:,}", *seconds, *psnr)
    return table


def write_csv(path: Path, rows: list[Row]) -> None:
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(Row.__dataclass_fields__), lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def print_rows(
    bench: Bench, found: Iterable[tuple[Row, torch.Tensor]], options: argparse.Namespace, console: Console
) -> None:
    """Print rows as one table, and write them and their volumes as they come where `--csv` and `--keep` say so."""
    rows = []
    for row, volume in found:
        rows.append(row)
        if options.csv is not None:
            write_csv(options.csv, rows)
        if options.keep is not None:
            options.keep.mkdir(parents=True, exist_ok=True)
            name = f"{row.method.replace(',', '').replace(' ', '-')}-{row.size}.npy"
            np.save(options.keep / name, volume.reshape([row.size] * 3).numpy().T)
    views = f"{len(bench.scan.train)} views to learn from, {len(bench.scan.test)} held out"
    console.print(table_of(rows, f"{options.scan}: {views}"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan")
    parser.add_argument("--truth")
    parser.add_argument("--sizes", type=int, nargs="+", default=[128])
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--holdout-every", type=int, default=10)
    parser.add_argument("--bin", type=int, default=1)
    parser.add_argument("--tv", type=float, nargs="+", default=[Variational().weight])
    parser.add_argument("--cutoffs", type=float, nargs="+", default=[Feldkamp().cutoff])
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    capture = binned(ProjectionCapture.load(options.scan, options.holdout_every), options.bin)
    truth = None if options.truth is None else load_volume(options.truth).values
    console = Console()
    bench = Bench(capture, truth, lambda line: console.print(line, highlight=False))
    print_rows(bench, rows_of(bench, options), options, console)


if __name__ == "__main__":
    main()
