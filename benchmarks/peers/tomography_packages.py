"""Voxels by scikit-image and MBIRJAX from the parallel projections that meshes are fitted to, in the same columns.

python benchmarks/peers/tomography_packages.py SCAN [--truth VOLUME] [--rows sart mbir] [--relaxation 0.15 ...]
    [--passes 20] [--sharpness 1 ...] [--snr 30] [--iterations 20] [--holdout-every N] [--csv FILE] [--keep FOLDER]

SCAN is what `difftetvr project` makes of a parallel geometry with an odd number of voxels a side and of pixels in a
row, as wide as the voxels, and as many rows as there are slices. "sart" is `skimage.transform.iradon_sart`, slice by
slice, at least 0, without weights; "mbir" is MBIRJAX's `ParallelBeamModel.recon`, at least 0, weighted by one over the
scan's variances. SART keeps the pass that predicts held-out views best; where several relaxations or values of
sharpness are given, each is a row: choose among them by the held-out projections. Nothing that makes a row sees the
truth.

Columns are those of `tomography_voxels.py`, by its own projector of constant voxels. Seconds of MBIRJAX include its
compilation.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from rich.console import Console
from tomography_projector import VoxelProjector
from tomography_scan import VoxelScan
from tomography_slices import Slices
from tomography_voxels import Bench, Row, print_rows

from difftetvr.capture import ProjectionCapture, load_volume
from difftetvr.errors import CaptureError, DiffTetError

ROWS = ("sart", "mbir")
SEED = 0  # MBIRJAX draws the order of voxels from numpy's global generator


@dataclass(frozen=True)
class PackageSart:
    """Options of scikit-image's SART.

    Attributes:
        relaxation: Of each view's update.
        passes: Over all views, at most: the best by held-out views is kept.
    """

    relaxation: float = 0.15
    passes: int = 20


@dataclass(frozen=True)
class Mbir:
    """Options of MBIRJAX.

    Attributes:
        sharpness: Greater is sharper and noisier.
        snr: Signal-to-noise ratio in dB that its regularisation assumes.
        iterations: At most.
    """

    sharpness: float = 1.0
    snr: float = 30.0
    iterations: int = 20


def package(module: str, name: str) -> ModuleType:
    """A package that is no dependency of the project.

    Raises:
        CaptureError: It is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise CaptureError(f"{name} cannot be imported ({error}); install it: pip install {name}") from error


def sart(scan: VoxelScan, options: PackageSart, watch: Callable[[str], None]) -> torch.Tensor:
    """(N^3) densities by scikit-image, at least 0."""
    slices = Slices.of(scan)
    slices.require_middle_pixel()
    projector = VoxelProjector(scan.geometry, slices.size)

    def judge(images: np.ndarray, step: int) -> float:
        psnr = scan.held_out_psnr(slices.volume(images), projector)
        watch(f"scikit-image, relaxation {options.relaxation:g}, pass {step}: held-out views {psnr:.3f} dB")
        return psnr

    return slices.volume(best_pass(slices.sinograms, slices.degrees.astype(np.float32), options, judge))


def best_pass(
    sinograms: np.ndarray, degrees: np.ndarray, options: PackageSart, judge: Callable[[np.ndarray, int], float]
) -> np.ndarray:
    """Slices by scikit-image's SART, at least 0, of the last pass before one that is judged worse.

    Args:
        sinograms: (slices, views, N), the middle of whose columns sees the axis; N is odd.
        degrees: (views,) in the same precision, which is that of the slices.
        options: Relaxation and number of passes.
        judge: Takes (slices, N, N) and the number of passes that made them.
    """
    update = package("skimage.transform", "scikit-image").iradon_sart
    images = np.zeros((len(sinograms), sinograms.shape[2], sinograms.shape[2]), sinograms.dtype)
    best, best_score = images.copy(), -math.inf
    for step in range(options.passes):
        for image, sinogram in zip(images, sinograms, strict=True):
            turned = np.ascontiguousarray(sinogram.T)
            image[:] = update(turned, degrees, image, clip=(0.0, math.inf), relaxation=options.relaxation)
        score = judge(images, step + 1)
        if score < best_score:
            break
        best, best_score = images.copy(), score
    return best


def mbir(scan: VoxelScan, options: Mbir) -> torch.Tensor:
    """(N^3) densities by MBIRJAX, at least 0."""
    # By default it takes two devices for two cores, and ends the process where one waits 40 s for the other.
    os.environ.setdefault("MBIRJAX_NUM_CPU_DEVICES", "1")
    mbirjax = package("mbirjax", "mbirjax")
    slices = Slices.of(scan)
    sinograms, weights = (part.transpose(1, 0, 2) for part in (slices.sinograms, slices.weights))
    np.random.seed(SEED)  # noqa: NPY002
    model = mbirjax.ParallelBeamModel(sinograms.shape, np.radians(slices.degrees))
    model.set_params(
        recon_shape=(slices.size,) * 3,
        delta_voxel=1.0,
        use_ror_mask=False,
        positivity_flag=True,
        sharpness=options.sharpness,
        snr_db=options.snr,
    )
    found, _ = model.recon(
        sinograms, weights=weights, max_iterations=options.iterations, logfile_path=None, print_logs=False
    )
    return slices.volume(np.asarray(found).transpose(2, 0, 1))


def rows_of(bench: Bench, options: argparse.Namespace) -> Iterator[tuple[Row, torch.Tensor]]:
    """All rows that are asked for, one after another."""
    scan, size = bench.scan, bench.scan.geometry.shape[1]
    for relaxation in options.relaxation if "sart" in options.rows else ():
        make = partial(sart, scan, PackageSart(relaxation, options.passes), bench.watch)
        yield bench.row(f"scikit-image SART, relaxation {relaxation:g}", size, make)
    for sharpness in options.sharpness if "mbir" in options.rows else ():
        make = partial(mbir, scan, Mbir(sharpness, options.snr, options.iterations))
        yield bench.row(f"MBIRJAX, sharpness {sharpness:g}", size, make)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan")
    parser.add_argument("--truth")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--relaxation", type=float, nargs="+", default=[PackageSart().relaxation])
    parser.add_argument("--passes", type=int, default=PackageSart().passes)
    parser.add_argument("--sharpness", type=float, nargs="+", default=[Mbir().sharpness])
    parser.add_argument("--snr", type=float, default=Mbir().snr)
    parser.add_argument("--iterations", type=int, default=Mbir().iterations)
    parser.add_argument("--holdout-every", type=int, default=10)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--keep", type=Path)
    return parser.parse_args()


def main() -> None:
    options, console = arguments(), Console()
    torch.set_num_threads(1)
    truth = None if options.truth is None else load_volume(options.truth).values
    capture = ProjectionCapture.load(options.scan, options.holdout_every)
    bench = Bench(capture, truth, lambda line: console.print(line, highlight=False))
    print_rows(bench, rows_of(bench, options), options, console)


if __name__ == "__main__":
    try:
        main()
    except DiffTetError as error:
        sys.exit(str(error))
