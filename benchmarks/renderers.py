"""Time and memory of the three renderers against mesh size, resolution and depth complexity.

The scene is that of vtk_compare.py: the cube [-0.5, 0.5]^3 as a Kuhn grid with a smooth field, seen from outside. Every
row runs in a process of its own: three repetitions after one that compiles the kernels, medians. "Forward" is
`render` without gradients, "backward" the backward pass with gradients of colours, densities and positions. "Memory" is
the peak of the process beyond what it held with mesh, adjacency and field (Linux only), over both passes and with the
gradients; one copy of them a thread and the kernels' machine code are in it.

    python benchmarks/renderers.py [--repetitions 3] [--skip-large]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

RENDERERS = ("marching", "linked-list", "projected")
CASES = [(32, 512), (64, 256), (64, 512), (64, 1024), (119, 512)]
"""Cubes a side (six cells each), and pixels a side."""
LARGE = 119
_STATUS = Path("/proc/self/status")


def resident(key: str) -> float:
    """MiB of VmRSS or VmHWM; NaN where the system does not tell."""
    if not _STATUS.exists():
        return float("nan")
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(key + ":"))
    return int(line.split()[1]) / 1024


def forget_peak() -> None:
    """Let VmHWM begin anew."""
    if _STATUS.exists():
        Path("/proc/self/clear_refs").write_text("5")


def seconds(action: Callable[[], object], repetitions: int) -> float:
    """Median time of an action."""
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def measure(cubes: int, pixels: int, renderer: str, repetitions: int) -> dict[str, float]:
    """One row, in this process."""
    from vtk_compare import smooth_field

    from difftetvr.mesh import Field, TetMesh
    from difftetvr.rendering import Camera, OrderWarning, render

    warnings.simplefilter("error", OrderWarning)
    camera = Camera.look_at((1.05, 0.62, 0.48), (0.0, 0.0, 0.0), width=pixels, height=pixels)
    small = TetMesh.grid((2, 2, 2))
    render(small, smooth_field(small.vertices), camera.with_size(16, 16), renderer=renderer)  # loads compiler and all
    mesh = TetMesh.grid((cubes,) * 3, (-0.5,) * 3, (0.5,) * 3)
    _ = mesh.topology.cell_adjacency
    field = smooth_field(mesh.vertices)
    leaves = [t.detach().clone().requires_grad_() for t in (mesh.vertices, field.color, field.density)]

    def forward() -> None:
        with torch.no_grad():
            render(mesh, field, camera, renderer=renderer)

    def graph() -> torch.Tensor:
        image = render(mesh.with_vertices(leaves[0]), Field(leaves[1], leaves[2]), camera, renderer=renderer)
        return image.color.square().sum()

    def backward() -> float:
        loss = graph()
        start = time.perf_counter()
        loss.backward()
        return time.perf_counter() - start

    before = resident("VmRSS")
    forget_peak()
    forward()
    backward()
    memory = resident("VmHWM") - before
    result = {"forward": seconds(forward, repetitions)}
    result["backward"] = statistics.median(backward() for _ in range(repetitions))
    return result | {"memory": memory}


def row(cubes: int, pixels: int, renderer: str, repetitions: int) -> dict[str, float]:
    """One row, in a process of its own."""
    arguments = [str(a) for a in (cubes, pixels, renderer, repetitions)]
    done = subprocess.run(
        [sys.executable, __file__, "--row", *arguments], stdout=subprocess.PIPE, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def depth_complexity(cubes: int, pixels: int) -> float:
    """Mean number of cells of the rays that meet any."""
    from difftetvr.mesh import TetMesh
    from difftetvr.rendering import Camera
    from difftetvr.rendering.inspection import inspect_rays

    camera = Camera.look_at((1.05, 0.62, 0.48), (0.0, 0.0, 0.0), width=pixels, height=pixels)
    counts = inspect_rays(TetMesh.grid((cubes,) * 3, (-0.5,) * 3, (0.5,) * 3), camera).depth_complexity
    return float(counts[counts > 0].double().mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--skip-large", action="store_true")
    parser.add_argument("--row", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.row:
        cubes, pixels, renderer, repetitions = options.row
        print(json.dumps(measure(int(cubes), int(pixels), renderer, int(repetitions))))
        return
    table = Table(title="The three renderers")
    for heading in ("cells", "pixels", "cells a ray", "renderer", "forward ms", "backward ms", "memory MiB"):
        table.add_column(heading, justify="right")
    for cubes, pixels in CASES:
        if cubes == LARGE and options.skip_large:
            continue
        complexity = depth_complexity(cubes, pixels)
        for renderer in RENDERERS:
            found = row(cubes, pixels, renderer, options.repetitions)
            numbers = (f"{1e3 * found['forward']:,.0f}", f"{1e3 * found['backward']:,.0f}", f"{found['memory']:,.0f}")
            table.add_row(f"{6 * cubes**3:,}", f"{pixels} x {pixels}", f"{complexity:.0f}", renderer, *numbers)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
