"""Time the marching renderer and its gradients against VTK's volume mappers, all in one run.

Scene: the cube [-0.5, 0.5]^3 as a Kuhn grid of 64^3 x 6 cells, seen at 512 x 512 from four directions that fill most of
the image. Colours are 0.5 + 0.45 sin(k_c . x) with another wave vector each, densities 2 + 2 sin(9 x) sin(8 y) sin(7 z)
per unit length: smooth, nowhere zero, mean alpha about 0.8. The large row is the paper's 177 x 100 x 100 cubes (10.6
million cells) with the same field. Every number is a median; every repetition takes another of the four views, so that
nothing a renderer keeps from the last view helps it. VTK's view of the data structure is built before the clock starts,
as are the kernels.

    python benchmarks/vtk_compare.py [--repetitions 5] [--skip-vtk] [--skip-large]
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import render
from difftetvr.rendering.cameras.pinhole import Camera

PIXELS = 512
# The planes whose arrangement a Kuhn grid is, in units of its cubes.
PLANES = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -1, 0], [0, 1, -1], [1, 0, -1]], dtype=torch.float64)


@dataclass(frozen=True)
class Case:
    """A grid of cubes, its mesh and field, and the views it is timed on."""

    name: str
    shape: tuple[int, int, int]
    mesh: TetMesh
    field: Field
    cameras: list[Camera]

    @property
    def steps(self) -> list[int]:
        """Number of (ray, cell) pairs of each view."""
        return [count_crossings(self.shape, self.mesh, camera) for camera in self.cameras]


def smooth_field(points: torch.Tensor) -> Field:
    """The benchmark's field at (V, 3) points in the unit cube around the origin."""
    waves = torch.tensor([[7.0, 3.0, 2.0], [-3.0, 8.0, 4.0], [2.0, -5.0, 9.0]])
    x, y, z = points.unbind(dim=1)
    density = 2.0 + 2.0 * torch.sin(9.0 * x) * torch.sin(8.0 * y) * torch.sin(7.0 * z)
    return Field(0.5 + 0.45 * torch.sin(points @ waves.T), density)


def make_case(name: str, shape: tuple[int, int, int]) -> Case:
    """A benchmark case; the longest side of the grid is 1."""
    sides = torch.tensor(shape, dtype=torch.float64) / max(shape)
    mesh = TetMesh.grid(shape, (-0.5 * sides).tolist(), (0.5 * sides).tolist())
    eyes = [(1.05, 0.62, 0.48), (-0.57, 1.08, 0.44), (-0.98, -0.66, 0.57), (0.61, -0.95, -0.68)]
    cameras = [Camera.look_at(eye, (0.0, 0.0, 0.0), width=PIXELS, height=PIXELS) for eye in eyes]
    _ = mesh.topology.cell_adjacency  # built before any clock starts
    return Case(name, shape, mesh, smooth_field(mesh.vertices), cameras)


def count_crossings(shape: tuple[int, int, int], mesh: TetMesh, camera: Camera) -> int:
    """Number of (ray, cell) pairs: a ray meets one cell more than it crosses planes of the grid inside the box."""
    pose = camera.world_to_camera.double()
    lower, upper = mesh.bounds().double()
    cubes = torch.tensor(shape, dtype=torch.float64) / (upper - lower)
    eye = (-pose[:3, :3].T @ pose[:3, 3] - lower) * cubes
    rays = (camera.ray_directions().reshape(-1, 3) @ pose[:3, :3]) * cubes
    first, second = -eye / rays, (torch.tensor(shape, dtype=torch.float64) - eye) / rays
    t_in = torch.minimum(first, second).amax(dim=1).clamp(min=0.0)
    t_out = torch.maximum(first, second).amin(dim=1)
    hit = t_out > t_in
    # A hair inside the box, so that its own sides do not count.
    margin = 1e-9 * (t_out - t_in)
    ends = [((eye + t[:, None] * rays) @ PLANES.T).floor() for t in (t_in + margin, t_out - margin)]
    return int(((ends[1] - ends[0]).abs().sum(dim=1) + 1.0)[hit].sum())


def median_ms(run: Callable[[Camera], Callable[[], object]], case: Case, repetitions: int) -> float:
    """Median time of ``run(camera)()`` in ms; ``run(camera)`` itself prepares and is not timed."""
    times = []
    for k in range(-1, repetitions):  # the first one warms up
        timed = run(case.cameras[k % len(case.cameras)])
        start = time.perf_counter()
        timed()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times[1:])


def forward(case: Case) -> Callable[[Camera], Callable[[], object]]:
    """An image without gradients."""
    return lambda camera: lambda: render(case.mesh, case.field, camera)


def backward(case: Case, with_vertices: bool, with_forward: bool) -> Callable[[Camera], Callable[[], object]]:
    """The gradients of an image: to colours and densities, or to positions as well."""
    field = Field(case.field.color.clone().requires_grad_(), case.field.density.clone().requires_grad_())
    mesh = case.mesh.with_vertices(case.mesh.vertices.clone().requires_grad_(with_vertices))
    leaves = [field.color, field.density, *([mesh.vertices] if with_vertices else [])]
    weights = torch.rand(PIXELS, PIXELS, 3, generator=torch.Generator().manual_seed(0))

    def prepare(camera: Camera) -> Callable[[], object]:
        if with_forward:
            return lambda: torch.autograd.grad(render(mesh, field, camera).color, leaves, weights)
        color = render(mesh, field, camera).color
        return lambda: torch.autograd.grad(color, leaves, weights)

    return prepare


def vtk_mapper(case: Case, kind: str) -> Callable[[Camera], Callable[[], object]]:
    """A rendering with one of VTK's mappers."""
    import vtk_scene

    make = {"ray cast": vtk_scene.ray_cast_mapper, "projected": vtk_scene.projected_tetrahedra_mapper}[kind]
    grid = vtk_scene.unstructured_grid(case.mesh, case.field)
    view = vtk_scene.VtkView(make(grid), case.cameras[0], 0.1, 10.0)

    def prepare(camera: Camera) -> Callable[[], object]:
        view.look(camera)
        return view.render

    return prepare


def measure(case: Case, repetitions: int, with_vtk: bool) -> list[tuple[str, float]]:
    """(what, ms) of everything that is timed on a case."""
    jobs = [
        ("ours, forward", forward(case)),
        ("ours, backward to colours and densities", backward(case, False, False)),
        ("ours, backward to all", backward(case, True, False)),
        ("ours, forward + backward to colours and densities", backward(case, False, True)),
        ("ours, forward + backward to all", backward(case, True, True)),
    ]
    if with_vtk:
        jobs.insert(0, ("VTK ray cast, partial pre-integration", vtk_mapper(case, "ray cast")))
        jobs.insert(1, ("VTK projected tetrahedra", vtk_mapper(case, "projected")))
    return [(what, median_ms(job, case, repetitions)) for what, job in jobs]


def report(console: Console, case: Case, results: list[tuple[str, float]], per_step_of_small: float | None) -> float:
    """Print a case's table; returns the forward time per step in ns."""
    steps = statistics.mean(case.steps)
    reference = dict(results)["ours, forward"]
    per_step = 1e6 * reference / steps
    table = Table(title=f"{case.name}: {case.mesh.num_cells:,} cells, {steps / 1e6:.1f} M steps a view")
    for column in ("", "ms", "ns / step", "time / our forward"):
        table.add_column(column, justify="left" if column == "" else "right", no_wrap=True)
    for what, ms in results:
        table.add_row(what, f"{ms:.0f}", f"{1e6 * ms / steps:.2f}", f"{ms / reference:.2f}")
    console.print(table)
    if per_step_of_small is not None:
        console.print(f"Forward per step: {per_step / per_step_of_small:.2f} times that of the small mesh.")
    return per_step


def processor() -> str:
    """The processor's name."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Time the marching renderer against VTK's volume mappers.")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--skip-vtk", action="store_true", help="time only our own renderer")
    parser.add_argument("--skip-large", action="store_true", help="leave out the mesh of 10.6 million cells")
    options = parser.parse_args()
    console = Console(width=110)
    console.print(
        f"{processor()}, {os.cpu_count()} threads, {platform.system()}; Dr.Jit {version('drjit')}, {PIXELS}^2 pixels"
    )
    small = make_case("64 x 64 x 64 cubes", (64, 64, 64))
    per_step = report(console, small, measure(small, options.repetitions, not options.skip_vtk), None)
    if not options.skip_large:
        large = make_case("177 x 100 x 100 cubes", (177, 100, 100))
        report(console, large, measure(large, options.repetitions, False), per_step)


if __name__ == "__main__":
    main()
