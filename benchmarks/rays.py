"""What bundles of rays cost beside a pinhole camera, channels and scalars beside colours, and values at places.

A grid of cubes, six cells each, with random colours and densities on its vertices; 65 536 rays from outside, and as
many from a point inside. All pairs that are compared alternate in one process; best of some repetitions after one that
compiles the kernels. Bundles include all that is done for one: checks, hierarchy, search for entries.

    python benchmarks/rays.py [--cubes 37] [--repetitions 9]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping

import torch
from rich.console import Console
from rich.table import Table

import difftetvr as dtv

SIDE = 256
KNOTS = 16
Passes = tuple[float, float]


def passes(mesh: dtv.TetMesh, field: dtv.Field, view: dtv.Camera | dtv.Rays) -> Passes:
    """Seconds of a rendering and of its backward pass."""
    leaves = [part.detach().clone().requires_grad_() for part in (mesh.vertices, field.color, field.density)]
    start = time.perf_counter()
    image = dtv.render(mesh.with_vertices(leaves[0]), dtv.Field(leaves[1], leaves[2]), view)
    middle = time.perf_counter()
    (image.color.sum() + image.optical_depth.sum()).backward()
    return middle - start, time.perf_counter() - middle


def passes_of_scalars(
    mesh: dtv.TetMesh, scalar: torch.Tensor, function: dtv.TransferFunction, camera: dtv.Camera, learns_function: bool
) -> Passes:
    """The same of scalars behind a transfer function, which is known or wants derivatives, too."""
    leaves = [part.detach().clone().requires_grad_() for part in (mesh.vertices, scalar)]
    parts = [part.detach().clone().requires_grad_(learns_function) for part in (function.opacity, function.color)]
    start = time.perf_counter()
    seen = dtv.ScalarField(leaves[1], dtv.TransferFunction(function.scalar, *parts), 3.0, (0.0, 1.0))
    image = dtv.render(mesh.with_vertices(leaves[0]), seen, camera)
    middle = time.perf_counter()
    image.color.sum().backward()
    return middle - start, time.perf_counter() - middle


def best(actions: Mapping[str, Callable[[], Passes]], repetitions: int) -> dict[str, Passes]:
    """The least times of actions that take turns, after one turn that does not count."""
    times: dict[str, list[Passes]] = {name: [] for name in actions}
    for _ in range(repetitions + 1):
        for name, action in actions.items():
            times[name].append(action())
    return {name: (min(f for f, _ in rows[1:]), min(b for _, b in rows[1:])) for name, rows in times.items()}


def show(console: Console, title: str, found: Mapping[str, Passes]) -> None:
    """Print times, and their ratio to the first row's."""
    table = Table(title=title)
    for heading in ("", "forward ms", "backward ms", "both, ratio"):
        table.add_column(heading, justify="left" if not heading else "right")
    first = sum(next(iter(found.values())))
    for name, (forward, backward) in found.items():
        table.add_row(name, f"{1e3 * forward:.1f}", f"{1e3 * backward:.1f}", f"{(forward + backward) / first:.2f}")
    console.print(table)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cubes", type=int, default=37)
    parser.add_argument("--repetitions", type=int, default=9)
    options = parser.parse_args()
    console, generator = Console(), torch.Generator().manual_seed(0)
    mesh = dtv.TetMesh.grid((options.cubes,) * 3)
    count = mesh.num_vertices
    density = 3.0 * torch.rand(count, generator=generator)
    fields = {c: dtv.Field(torch.rand(count, c, generator=generator), density) for c in (3, 0, 1, 8, 16, 64)}
    outside = dtv.Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5), width=SIDE, height=SIDE)
    inside = dtv.Camera.look_at((0.6, 0.55, 0.4), (0.5, 0.9, 0.5), width=SIDE, height=SIDE)
    console.print(f"{mesh.num_cells:,} cells, {SIDE} x {SIDE} rays, float32")
    for name, camera in (("from outside", outside), ("from inside", inside)):
        views = {"pinhole camera": camera, "the same rays": camera.rays()}
        found = {label: lambda view=view: passes(mesh, fields[3], view) for label, view in views.items()}
        show(console, name, best(found, options.repetitions))
    channels = {f"{c} channels": lambda field=field: passes(mesh, field, outside) for c, field in fields.items()}
    show(console, "channels", best(channels, options.repetitions))
    knots = torch.linspace(0.0, 1.0, KNOTS)
    function = dtv.TransferFunction(knots, *(torch.rand(shape, generator=generator) for shape in (KNOTS, (KNOTS, 3))))
    scalars = {"colours and densities": lambda: passes(mesh, fields[3], outside)}
    for name, learns in (("scalars, a function that is known", False), ("and one that is learned", True)):
        scalars[name] = lambda learns=learns: passes_of_scalars(mesh, density / 3.0, function, outside, learns)
    show(console, f"scalars behind a function of {KNOTS} knots", best(scalars, options.repetitions))
    points = torch.rand(1_000_000, 3, generator=generator)

    def probed() -> Passes:
        start = time.perf_counter()
        dtv.probe(mesh, density, points)
        return time.perf_counter() - start, 0.0

    def voxelised() -> Passes:
        start = time.perf_counter()
        dtv.voxelise(mesh, density, (0.5 / 256,) * 3, 1.0 / 256, (256,) * 3)
        return time.perf_counter() - start, 0.0

    places = best({"probe, 10^6 points": probed, "voxelise, 256^3": voxelised}, 3)
    show(console, "values at places", places)


if __name__ == "__main__":
    main()
