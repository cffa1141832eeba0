"""Pages of `difftetvr export`: their size, and what a browser draws against `render`, by WebGL 2 and by WebGPU.

Three views of each, two from outside and one from inside, 320 x 240 pixels; needs Chromium, which draws without a GPU
here. Models with color and density are given, simulations are those of the folder of example data, where it is.

    python benchmarks/pages.py [MODEL ...] [--meshes FOLDER OF DATA/meshes]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

import difftetvr as dtv
from difftetvr.fitting.metrics import psnr
from difftetvr.mesh.io import load_data, scalar_of

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from view.browser import CHROMIUM, WEBGPU_OPTIONS, Browser, rendered  # noqa: E402  the driver of the tests

BACKGROUND = (0.2, 0.4, 0.6)  # of which 8 bits hold each exactly
DIRECTIONS = ((0.45, -1.0, 0.35), (-1.1, 0.7, 0.4), (0.1, 0.05, 0.03))  # in longest sides from the middle
Scene = tuple[str, Callable[[], tuple[dtv.TetMesh, dtv.Field | dtv.ScalarField]]]


def simulation(path: Path, scalar: str, function: dtv.TransferFunction) -> tuple[dtv.TetMesh, dtv.ScalarField]:
    """A scalar of a mesh."""
    found = scalar_of(load_data(path, flat="drop", loose=True), scalar)
    lower, upper = found.mesh.bounds()
    return found.mesh, dtv.ScalarField(found.values, function, 25.0 / float((upper - lower).max()))


def scenes(models: list[Path], meshes: Path) -> Iterator[Scene]:
    """Names of volumes and how they are read."""
    for model in models:
        yield str(model), lambda model=model: dtv.load(model)
    if meshes.is_dir():
        default = dtv.TransferFunction.default()
        post = dtv.TransferFunction.load(ROOT / "docs" / "images" / "simulation.json")
        yield "post.vtk, pressure", lambda: simulation(meshes / "post.vtk", "Pressure", default)
        yield "bluntfin.npz, density", lambda: simulation(meshes / "bluntfin.npz", "density", default)
        yield (
            "oxygen-post.npz, momentum",
            lambda: simulation(meshes / "oxygen-post.npz", "momentum:magnitude", post),
        )


def cameras(mesh: dtv.TetMesh) -> Iterator[dtv.Camera]:
    """Views from outside and inside."""
    lower, upper = mesh.bounds().double()
    center, size = 0.5 * (lower + upper), float((upper - lower).max())
    for direction in DIRECTIONS:
        eye = center + 1.5 * size * torch.tensor(direction, dtype=torch.float64)
        yield dtv.Camera.look_at(eye, center, (0.0, 0.0, 1.0), 0.9, 320, 240)


def drawn_by(
    browser: Browser, page: Path, mesh: dtv.TetMesh, field: dtv.Field | dtv.ScalarField
) -> tuple[float, list[dict[str, float]]]:
    """Least PSNR of a page's pictures in a browser, and what happened to their rays."""
    browser.open(page)
    names = {"#webgl": "WebGL 2", "#webgpu": "WebGPU"}
    if browser.run("difftetvr.renderer") != names[browser.fragment]:
        sys.exit(f"This Chromium has no {names[browser.fragment]} to offer.")
    ratios, audits = [], []
    for camera in cameras(mesh):
        pixels, audit = rendered(browser, camera, BACKGROUND)
        with torch.no_grad():
            truth = dtv.render(mesh, field, camera, torch.tensor(BACKGROUND)).color.clamp(0.0, 1.0)
        ratios.append(psnr(torch.from_numpy(pixels).float(), truth))
        audits.append(audit)
    return min(ratios), audits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/data/meshes"))
    options = parser.parse_args()
    if CHROMIUM is None:
        sys.exit("There is no Chromium here, in which pages could be drawn.")
    print("| volume | cells | page (MB) | least PSNR (dB), WebGL 2 | WebGPU | most cells of a ray | rays lost |")
    print("|---|---|---|---|---|---|---|")
    with (
        tempfile.TemporaryDirectory() as folder,
        Browser(fragment="#webgl") as webgl,
        Browser(options=WEBGPU_OPTIONS, fragment="#webgpu") as webgpu,
    ):
        for name, make in scenes(options.models, options.meshes):
            mesh, field = make()
            page = dtv.view.save_page(Path(folder) / "a.html", mesh, field)
            (gl, audits), (gpu, others) = (drawn_by(b, Path(folder) / "a.html", mesh, field) for b in (webgl, webgpu))
            audits += others
            most, lost = max(a["mostSteps"] for a in audits), sum(a["lost"] + a["bounded"] for a in audits)
            size = len(page.text) / 1e6
            print(f"| {name} | {mesh.num_cells} | {size:.2f} | {gl:.1f} | {gpu:.1f} | {most} | {lost} |", flush=True)


if __name__ == "__main__":
    main()
