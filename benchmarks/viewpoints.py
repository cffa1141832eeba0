"""Views found by gradient ascent of the image's entropy against the best of many sampled ones.

The protocol of Weiss and Westermann (Differentiable Direct Volume Rendering, 2022): eight climbs, against 256 and 1024
views spread over the sphere; with scouts, and from the middles of the octants as there. On the Tooth, resampled to a
grid of tetrahedra, and, where the folder of example data is given, on the blunt fin and the liquid-oxygen post.

    python benchmarks/viewpoints.py [FOLDER OF DATA/meshes] [--samples 256 1024] [--size 128]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

import difftetvr as dtv
from difftetvr.inverse import ViewpointConfig, sample_viewpoints
from difftetvr.mesh.io import load_data, scalar_of

POST = Path(__file__).parents[1] / "docs" / "images" / "simulation.json"


def tooth() -> tuple[dtv.TetMesh, dtv.ScalarField]:
    """The scan on a grid of 138 000 tetrahedra."""
    volume, function = dtv.VolumeCapture().load_volume()
    lower, upper = volume.bounds
    cells = [round(40 * extent) for extent in (upper - lower).tolist()]
    mesh = dtv.TetMesh.grid(cells, lower.tolist(), upper.tolist())
    places = 2.0 * (mesh.vertices - lower) / (upper - lower) - 1.0
    values = torch.nn.functional.grid_sample(
        torch.from_numpy(volume.values)[None, None], places[None, None, None], align_corners=True
    )
    return mesh, dtv.ScalarField(values.flatten(), function, 25.0, (0.0, 1.0))


def simulation(path: Path, scalar: str, function: dtv.TransferFunction) -> tuple[dtv.TetMesh, dtv.ScalarField]:
    """A scalar of a mesh."""
    found = scalar_of(load_data(path, flat="drop", loose=True), scalar)
    lower, upper = found.mesh.bounds()
    return found.mesh, dtv.ScalarField(found.values, function, 25.0 / float((upper - lower).max()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", nargs="?", type=Path, default=Path("../shared/data/meshes"))
    parser.add_argument("--samples", nargs="+", type=int, default=[256, 1024])
    parser.add_argument("--size", type=int, default=128)
    options = parser.parse_args()
    scenes = {"Tooth": tooth}
    if options.meshes.is_dir():
        default, post = dtv.TransferFunction.default(), dtv.TransferFunction.load(POST)
        scenes["blunt fin"] = lambda: simulation(options.meshes / "bluntfin.npz", "density", default)
        scenes["oxygen post"] = lambda: simulation(options.meshes / "oxygen-post.npz", "momentum:magnitude", post)
    counts = " | ".join(f"best of {count}" for count in options.samples)
    print(f"| volume | entropy of | {counts} | octants | scouts | images | s | s of {options.samples[-1]} |")
    print("|---|---|" + "---|" * (len(options.samples) + 5))
    for name, make in scenes.items():
        mesh, field = make()
        for measure in ("opacity", "color"):
            size = {"width": options.size, "height": options.size}
            config = ViewpointConfig(measure=measure, **size)
            start = time.perf_counter()
            search = dtv.best_viewpoint(mesh, field, config)
            seconds = time.perf_counter() - start
            octants = dtv.best_viewpoint(mesh, field, ViewpointConfig(measure=measure, scouts=0, **size))
            sampled = []
            for count in options.samples:
                start = time.perf_counter()
                sampled.append(max(view.entropy for view in sample_viewpoints(mesh, field, count, config)))
                sampling = time.perf_counter() - start
            values = " | ".join(f"{value:.5f}" for value in (*sampled, octants.best.entropy, search.best.entropy))
            print(
                f"| {name} | {measure} | {values} | {search.renderings} | {seconds:.1f} | {sampling:.1f} |", flush=True
            )


if __name__ == "__main__":
    main()
