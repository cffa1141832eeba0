"""Transfer functions found from images of known scalars.

The protocol of Weiss and Westermann (Differentiable Direct Volume Rendering, 2022): eight views on a Fibonacci sphere,
a random start, 200 iterations with all views; PSNR and SSIM over white, of these views and of eight others. On the
Tooth, resampled to a grid of tetrahedra, with images of that grid and with images of the scan itself by fine ray
marching; and, where the folder of example data is given, on two simulations' own meshes.

    python benchmarks/transfer.py [FOLDER OF DATA/meshes] [--size 96] [--cells 200000] [--report FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

import difftetvr as dtv
from difftetvr.inverse import TransferConfig, volume_on_grid
from difftetvr.mesh.io import load_data, scalar_of
from difftetvr.view.transfer_report import save_transfer_report

POST = Path(__file__).parents[1] / "docs" / "images" / "simulation.json"
VIEWS = 8


def capture_of(mesh: dtv.TetMesh, field: dtv.ScalarField, size: int, name: str) -> dtv.Capture:
    """Eight views on a Fibonacci sphere, and eight others that are held out."""
    lower, upper = mesh.bounds()
    center, radius = (0.5 * (lower + upper)).tolist(), 1.2 * float((upper - lower).max())
    cameras = dtv.capture.fibonacci_orbit(VIEWS, center, radius, width=size, height=size)
    cameras += dtv.capture.random_orbit(VIEWS, center, radius, width=size, height=size)
    with torch.no_grad():
        images = [dtv.render(mesh, field, camera) for camera in cameras]
    color, alpha = torch.stack([i.color for i in images]), torch.stack([i.alpha for i in images])
    test = torch.arange(2 * VIEWS) >= VIEWS
    return dtv.Capture(cameras, color.clamp(min=0), alpha.clamp(0, 1), test, mesh.bounds(), name)


def scan_capture(size: int) -> dtv.Capture:
    """The same views of the scan itself."""
    parts = [
        dtv.VolumeCapture(views=VIEWS, width=size, height=size, test_every=0, orbit=orbit).build()
        for orbit in ("fibonacci", "random")
    ]
    images, alphas = (torch.cat([getattr(part, name)[:] for part in parts]) for name in ("images", "alphas"))
    test = torch.arange(2 * VIEWS) >= VIEWS
    return dtv.Capture(parts[0].cameras + parts[1].cameras, images, alphas, test, parts[0].bounds, "scan")


def simulation(path: Path, scalar: str) -> tuple[dtv.TetMesh, torch.Tensor]:
    """A scalar of a mesh."""
    found = scalar_of(load_data(path, flat="drop", loose=True), scalar)
    return found.mesh, found.values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", nargs="?", type=Path, default=Path("../shared/data/meshes"))
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--cells", type=int, default=200_000)
    parser.add_argument("--iterations", type=int, default=200)
    parser.add_argument("--report", type=Path)
    options = parser.parse_args()
    volume, function = dtv.VolumeCapture().load_volume()
    grid = volume_on_grid(volume, options.cells)
    scenes = [("Tooth, images of the grid", *grid, function, (0.0, 1.0), None)]
    scenes.append(("Tooth, images of the scan", *grid, function, (0.0, 1.0), scan_capture(options.size)))
    if options.meshes.is_dir():
        post = dtv.TransferFunction.load(POST)
        found = simulation(options.meshes / "oxygen-post.npz", "momentum:magnitude")
        scenes.append(("oxygen post, speed", *found, post, None, None))
        found = simulation(options.meshes / "bluntfin.npz", "density")
        scenes.append(("blunt fin, density", *found, dtv.TransferFunction.default(), None, None))
    print("| scalar | cells | start, dB | PSNR, dB | SSIM | held out, dB | held out, SSIM | s |")
    print("|---|---|---|---|---|---|---|---|")
    for name, mesh, values, truth, value_range, capture in scenes:
        lower, upper = mesh.bounds()
        if capture is None:
            field = dtv.ScalarField(values, truth, 25.0 / float((upper - lower).max()), value_range)
            capture = capture_of(mesh, field, options.size, name)
        config = TransferConfig(value_range=value_range, iterations=options.iterations)
        result = dtv.fit_transfer(mesh, values, capture, config)
        trained, tested = result.training, result.held_out
        row = f"| {name} | {mesh.num_cells:,} | {result.start_quality.mean_psnr:.2f} | {trained.mean_psnr:.2f} | "
        row += f"{trained.mean_ssim:.4f} | {tested.mean_psnr:.2f} | {tested.mean_ssim:.4f} | {result.seconds:.0f} |"
        print(row, flush=True)
        if options.report is not None:
            options.report.mkdir(parents=True, exist_ok=True)
            file = options.report / f"{name.split(',')[0].replace(' ', '_')}_{capture.name.split(' ')[0]}.png"
            save_transfer_report(file, mesh, result, capture, truth)


if __name__ == "__main__":
    main()
