"""Pages of `difftetvr export`: their size, and what a browser draws against `render`, by WebGL 2 and by WebGPU.

Three views of each, two from outside and one from inside, 320 x 240 pixels; needs Chromium, which draws without a GPU
here. Models with color and density are given, simulations are those of the folder of example data, where it is.

    python benchmarks/pages.py [MODEL ...] [--meshes FOLDER OF DATA/meshes]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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
Field = dtv.Field | dtv.ScalarField
Scene = tuple[str, Callable[[], tuple[dtv.TetMesh, Field]]]


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


@dataclass
class Drawn:
    """What a browser makes of a page: its pictures, least PSNR (dB), what happened to rays, mean milliseconds."""

    pictures: list[torch.Tensor]
    ratio: float
    audits: list[dict[str, float]]
    milliseconds: float


def drawn_by(browser: Browser, page: Path, views: list[dtv.Camera], truths: list[torch.Tensor]) -> Drawn:
    """Draws some views, each twice, so that the time is that of drawing alone."""
    browser.open(page)
    names = {"#webgl": "WebGL 2", "#webgpu": "WebGPU"}
    if browser.run("difftetvr.renderer") != names[browser.fragment]:
        sys.exit(f"This Chromium has no {names[browser.fragment]} to offer.")
    browser.wait_for("/pixels in/.test(document.querySelector('.drawn').textContent)")  # it rests
    pictures, audits, seconds = [], [], 0.0
    for camera in views:
        rendered(browser, camera, BACKGROUND)
        began = time.perf_counter()
        pixels, audit = rendered(browser, camera, BACKGROUND)
        seconds += time.perf_counter() - began
        pictures.append(torch.from_numpy(pixels).float())
        audits.append(audit)
    ratio = min(psnr(picture, truth) for picture, truth in zip(pictures, truths, strict=True))
    return Drawn(pictures, ratio, audits, 1000.0 * seconds / len(views))


def row_of(name: str, page: Path, mesh: dtv.TetMesh, field: Field, browsers: list[Browser]) -> str:
    """Of the table."""
    text = dtv.view.save_page(page, mesh, field).text
    views = list(cameras(mesh))
    with torch.no_grad():
        background = torch.tensor(BACKGROUND)
        truths = [dtv.render(mesh, field, view, background).color.clamp(0.0, 1.0) for view in views]
    gl, gpu = (drawn_by(browser, page, views, truths) for browser in browsers)
    apart = sum(int((a != b).any(dim=-1).sum()) for a, b in zip(gl.pictures, gpu.pictures, strict=True))
    audits = gl.audits + gpu.audits
    most, lost = max(a["mostSteps"] for a in audits), sum(a["lost"] + a["bounded"] for a in audits)
    ratios = f"{gl.ratio:.1f} | {gpu.ratio:.1f} | {apart}"
    times = f"{gl.milliseconds:.0f} | {gpu.milliseconds:.0f}"
    return f"| {name} | {mesh.num_cells} | {len(text) / 1e6:.2f} | {ratios} | {most} | {lost} | {times} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/data/meshes"))
    options = parser.parse_args()
    if CHROMIUM is None:
        sys.exit("There is no Chromium here, in which pages could be drawn.")
    print("| volume | cells | page (MB) | least PSNR (dB), WebGL 2 | WebGPU | pixels that differ ", end="")
    print("| most cells of a ray | rays lost | ms a picture, WebGL 2 | WebGPU |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    with (
        tempfile.TemporaryDirectory() as folder,
        Browser(fragment="#webgl") as webgl,
        Browser(options=WEBGPU_OPTIONS, fragment="#webgpu") as webgpu,
    ):
        for name, make in scenes(options.models, options.meshes):
            print(row_of(name, Path(folder) / "a.html", *make(), [webgl, webgpu]), flush=True)


if __name__ == "__main__":
    main()
