"""A real scan whose axis is not in the middle of its detector: found by gradient, and slices beside FBP and SART.

python benchmarks/peers/tomography_axis.py SCAN.h5 [--cells 20000] [--tv 0.005] [--passes 12] [--report FOLDER]

SCAN.h5 is a Data Exchange file of parallel projections with few rows, such as tomopy's tooth. The mesh finds where
the axis is along with it, beginning in the middle; the others are told. Filtered back-projection and SART are those of
scikit-image (`pip install scikit-image`), a slice for each row, of pixels as wide as its own; SART keeps the pass
that predicts held-out views best. One of ten views is held out; how well these are predicted, as measured, is the
column, by exact line integrals of constant voxels and of the mesh.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tomography_packages import PackageSart, best_pass, package

from difftetvr.capture import ProjectionCapture, project_volume
from difftetvr.errors import DiffTetError
from difftetvr.fitting.metrics import psnr_of_mse
from difftetvr.inverse.tomography import TomographyConfig, TomographyResult, reconstruct
from difftetvr.sampling import voxelise
from difftetvr.view.pictures import below, beside, labelled, save_picture, to_picture

HOLDOUT_EVERY = 10
WINDOWS = ("ramp", "hann")
SHOWN = 340  # pixels of a slice, from its middle


@dataclasses.dataclass(frozen=True)
class CenteredRows:
    """Sinograms about a known axis, with one column more than the detector, the middle one of which sees the axis.

    Attributes:
        capture: The scan, with the axis where it was found.
        sinograms: (rows, views, N) line integrals of the training views, linear between pixels; N is odd.
        degrees: (views,) their angles.
    """

    capture: ProjectionCapture
    sinograms: np.ndarray
    degrees: np.ndarray

    @staticmethod
    def of(capture: ProjectionCapture, axis: float) -> CenteredRows:
        """About an axis in pixels from the left edge of the first one."""
        _, _, width = capture.geometry.shape
        measured = capture.line_integrals[capture.train_indices].double().numpy()
        size = width + 1 - width % 2
        places = axis - 0.5 + np.arange(size) - size // 2
        rows = [
            [np.interp(places, np.arange(width), line, left=0.0, right=0.0) for line in measured[:, row]]
            for row in range(measured.shape[1])
        ]
        assert capture.geometry.angles is not None
        return CenteredRows(capture, np.array(rows), capture.geometry.angles[capture.train_indices].numpy())

    @property
    def size(self) -> int:
        """N."""
        return self.sinograms.shape[2]

    @property
    def pitch(self) -> float:
        """Side of a pixel of the detector and of the slices."""
        return float(self.capture.geometry.detector.columns.reshape(-1, 3)[0].norm())

    def held_out_psnr(self, slices: np.ndarray) -> float:
        """Mean PSNR in dB of the held-out views by (rows, N, N) slices, the first one on top."""
        capture, rows = self.capture, len(slices)
        half = 0.5 * self.pitch * torch.tensor([self.size, self.size, rows], dtype=torch.float64)
        test = capture.test_indices
        geometry = dataclasses.replace(capture.geometry.select(test), bounds=torch.stack((-half, half)))
        values = torch.from_numpy(slices[::-1].copy()).permute(1, 2, 0).float() / self.pitch
        errors = (project_volume(values, geometry) - capture.line_integrals[test]).double().square().flatten(1).mean(1)
        peak = float(capture.line_integrals.max())
        return sum(psnr_of_mse(float(error) / peak**2) for error in errors) / len(test)


def back_projected(scan: CenteredRows, window: str) -> np.ndarray:
    """(rows, N, N) by filtered back-projection."""
    inverse = package("skimage.transform", "scikit-image").iradon
    slices = [inverse(s.T, theta=scan.degrees, filter_name=window, circle=True) for s in scan.sinograms]
    return np.array(slices)


def sart(scan: CenteredRows, options: PackageSart) -> np.ndarray:
    """(rows, N, N) by SART, at least 0, of the pass that predicts held-out views best."""
    return best_pass(scan.sinograms, scan.degrees, options, lambda slices, _: scan.held_out_psnr(slices))


def sliced(result: TomographyResult, scan: CenteredRows) -> np.ndarray:
    """(N, N) of the mesh in the middle of the first row, at the middles of the pixels of the others."""
    pitch, first = scan.pitch, -scan.pitch * (scan.size // 2)
    height = 0.5 * pitch * (len(scan.sinograms) - 1)
    lattice = (first, first, height), (pitch, pitch, pitch), (scan.size, scan.size, 1)
    values = voxelise(result.mesh, result.field.density, *lattice)
    return values[..., 0].numpy() * pitch


def picture(images: dict[str, np.ndarray]) -> Image.Image:
    """The middles of slices beside one another and, below, a third of each, enlarged."""
    top = max(float(np.quantile(image, 0.999)) for image in images.values())

    def row(width: int, labels: list[str]) -> Image.Image:
        panels = []
        for image, label in zip(images.values(), labels, strict=True):
            first = max(0, (len(image) - width) // 2)
            part = torch.from_numpy(image[first : first + width, first : first + width].copy() / top)
            panels.append(labelled(to_picture(part[..., None].expand(-1, -1, 3)), label))
        return beside(panels)

    return below([row(SHOWN, list(images)), row(SHOWN // 3, [""] * len(images))])


def rows_of(path: Path, options: argparse.Namespace) -> Iterator[tuple[str, str, float, float, np.ndarray]]:
    """Name, numbers, held-out PSNR, seconds and the first slice of each method."""
    start = time.perf_counter()
    config = TomographyConfig(cells=options.cells, align="axis", total_variation=options.tv, evaluate_every=0)
    given = ProjectionCapture.load(path, HOLDOUT_EVERY)
    found = reconstruct(given, config)
    seconds = time.perf_counter() - start
    axis = 0.5 * given.geometry.shape[2] - found.alignment.to_json()["axis_shift_pixels"]
    print(f"The axis was found {axis:.2f} pixels from the left edge.\n")
    scan = CenteredRows.of(ProjectionCapture.load(path, HOLDOUT_EVERY, center=axis), axis)
    by_sart = PackageSart(passes=options.passes)
    numbers = scan.sinograms.shape[0] * scan.size**2
    methods: list[tuple[str, Callable[[], np.ndarray]]] = [
        *((f"FBP, {window} window", lambda window=window: back_projected(scan, window)) for window in WINDOWS),
        (f"SART, relaxation {by_sart.relaxation:g}", lambda: sart(scan, by_sart)),
    ]
    for name, make in methods:
        start = time.perf_counter()
        slices = make()
        yield name, f"{numbers:,}", scan.held_out_psnr(slices), time.perf_counter() - start, slices[0]
    unknowns = f"{found.mesh.num_vertices:,} and as many places"
    yield f"{found.mesh.num_cells:,} cells", unknowns, found.score.mean_psnr, seconds, sliced(found, scan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("--cells", type=int, default=20_000)
    parser.add_argument("--tv", type=float, default=0.005)
    parser.add_argument("--passes", type=int, default=12)
    parser.add_argument("--report", type=Path, default=Path("out/real_scan"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    images = {}
    lines = ["| | numbers | held-out views, dB | s |", "|---|---|---|---|"]
    for name, numbers, psnr, seconds, image in rows_of(options.scan, options):
        lines.append(f"| {name} | {numbers.replace(',', ' ')} | {psnr:.2f} | {seconds:.0f} |")
        images[name] = image
    print("\n".join(lines))
    options.report.mkdir(parents=True, exist_ok=True)
    save_picture(options.report / "slices.png", picture(images))


if __name__ == "__main__":
    try:
        main()
    except DiffTetError as error:
        sys.exit(str(error))
