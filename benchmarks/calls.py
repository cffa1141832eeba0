"""What a call costs beside its rays, and what a mesh's order in memory does to it.

- An image of 8 x 8 pixels of 384 cells: next to nothing is computed, so this is the time of the host; by each renderer,
  and along bundles of rays that see all of the mesh, or begin among its cells. How many kernels a call launches, traces
  and compiles once all are there.
- A grid of 64^3 cubes, six cells each, as it is made and with its vertices and cells shuffled, and a mesh after forty
  rounds in which edges were halved and others collapsed, as it is and sorted along a curve. Pairs alternate in one
  process.
- The time to find the order of such a mesh, which happens once for each topology.

    python benchmarks/calls.py [--cubes 64] [--repetitions 9]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping

import drjit as dr
import torch
from rich.console import Console
from rich.table import Table

import difftetvr as dtv
from difftetvr.mesh.changes.bisection import bisect_edges
from difftetvr.mesh.changes.collapse import collapse_edges
from difftetvr.mesh.topology.topology import Topology
from difftetvr.rendering.preparation import RENDERERS
from difftetvr.rendering.search.hierarchy import curve_order

Passes = tuple[float, float]


def passes(mesh: dtv.TetMesh, rays: dtv.Camera | dtv.Rays, renderer: str = "marching", moves: bool = True) -> Passes:
    """Seconds of a rendering and of its backward pass, of colours and densities that depend on the place."""
    leaves = [part.clone().requires_grad_() for part in (mesh.vertices, mesh.vertices.square().sum(1))]
    mesh = mesh.with_vertices(mesh.vertices.clone().requires_grad_(moves))
    start = time.perf_counter()
    image = dtv.render(mesh, dtv.Field(*leaves), rays, renderer=renderer)
    middle = time.perf_counter()
    (image.color.sum() + image.optical_depth.sum()).backward()
    return middle - start, time.perf_counter() - middle


def turns(actions: Mapping[str, Callable[[], Passes]], repetitions: int) -> dict[str, list[Passes]]:
    """Times of actions that take turns, after one turn that does not count."""
    times: dict[str, list[Passes]] = {name: [] for name in actions}
    for _ in range(repetitions + 1):
        for name, action in actions.items():
            times[name].append(action())
    return {name: rows[1:] for name, rows in times.items()}


def renumbered(mesh: dtv.TetMesh, vertices: torch.Tensor, cells: torch.Tensor) -> dtv.TetMesh:
    """A mesh with its vertices and cells in another order."""
    place = torch.empty_like(vertices)
    place[vertices] = torch.arange(len(vertices))
    tets = place[mesh.tets.long()][cells].to(torch.int32)
    return dtv.TetMesh.from_valid(mesh.vertices[vertices].contiguous(), Topology(tets, len(vertices)))


def shuffled(mesh: dtv.TetMesh, generator: torch.Generator) -> dtv.TetMesh:
    """A mesh whose neighbours are anywhere in memory."""
    counts = mesh.num_vertices, mesh.num_cells
    return renumbered(mesh, *(torch.randperm(count, generator=generator) for count in counts))


def along_a_curve(mesh: dtv.TetMesh) -> dtv.TetMesh:
    """A mesh whose neighbours are near each other in memory."""
    return renumbered(mesh, curve_order(mesh.vertices), curve_order(mesh.vertices[mesh.tets.long()].mean(1)))


def exchanged(mesh: dtv.TetMesh, rounds: int, generator: torch.Generator) -> dtv.TetMesh:
    """A mesh in which, again and again, a hundredth of the edges is halved and as many cells are taken away."""
    for _ in range(rounds):
        before, count = mesh.num_cells, len(mesh.topology.edges)
        mesh = bisect_edges(mesh, torch.randperm(count, generator=generator)[: count // 100]).mesh
        edges = torch.randperm(len(mesh.topology.edges), generator=generator)
        cost = torch.rand(len(edges), generator=generator)
        end = torch.randint(2, (len(edges),), generator=generator)
        mesh = collapse_edges(mesh, edges, end, cost, limit=mesh.num_cells - before).mesh
    return mesh


def show_host_time(console: Console, repetitions: int) -> None:
    """Time and kernels of calls in which next to nothing is computed."""
    mesh = dtv.TetMesh.grid((4, 4, 4))
    camera = dtv.Camera.look_at((3.0, 2.5, 2.0), (0.5, 0.5, 0.5), width=8, height=8)
    inside = dtv.Rays(*(torch.rand(2, 64, 3, generator=torch.Generator().manual_seed(0)) + 0.01))
    calls: dict[str, Callable[[], Passes]] = {"camera, marching, vertices too": lambda: passes(mesh, camera)}
    for renderer in RENDERERS:
        calls[f"camera, {renderer}"] = lambda renderer=renderer: passes(mesh, camera, renderer, False)
    for renderer in RENDERERS[:2]:
        for name, rays in (("bundle", camera.rays()), ("bundle that begins among cells", inside)):
            calls[f"{name}, {renderer}"] = lambda rays=rays, renderer=renderer: passes(mesh, rays, renderer, False)
    turns(calls, 20)
    times = turns(calls, 30 * repetitions)
    table = Table(title=f"{mesh.num_cells} cells, 8 x 8 rays, best and median ms")
    for heading in ("", "render", "", "backward", ""):
        table.add_column(heading, justify="left" if not table.columns else "right")
    for name, rows in times.items():
        ordered = [sorted(row[place] for row in rows) for place in range(2)]
        numbers = [f"{1e3 * column[place]:.2f}" for column in ordered for place in (0, len(column) // 2)]
        table.add_row(name, *numbers)
    console.print(table)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        passes(mesh, camera)  # recorded anew where the flag is set
        dr.kernel_history_clear()
        passes(mesh, camera)
    kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    traced = sum(entry["recording_mode"] != dr.KernelRecordingMode.Replayed for entry in kernels)
    compiled = sum(not entry["cache_hit"] for entry in kernels)
    console.print(f"both together launch {len(kernels)} kernels, trace {traced} and compile {compiled}")


def show_orders(console: Console, title: str, meshes: Mapping[str, dtv.TetMesh], repetitions: int) -> None:
    """Times of one mesh in several orders, and their ratio to the first row's."""
    camera = dtv.Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5), width=256, height=256)
    starts = {}
    for name, mesh in meshes.items():
        mesh.topology.cell_adjacency  # noqa: B018  which every change of a mesh finds anyhow
        start = time.perf_counter()
        passes(mesh, camera)
        starts[name] = time.perf_counter() - start
    found = turns({name: lambda mesh=mesh: passes(mesh, camera) for name, mesh in meshes.items()}, repetitions)
    best = {name: [min(row[k] for row in rows) for k in range(2)] for name, rows in found.items()}
    table = Table(title=f"{title}, 256 x 256 pixels")
    for heading in ("", "forward ms", "backward ms", "both, ratio", "order, found once, ms"):
        table.add_column(heading, justify="left" if not heading else "right")
    first = sum(next(iter(best.values())))
    for name, (forward, backward) in best.items():
        cells = (f"{1e3 * forward:.1f}", f"{1e3 * backward:.1f}", f"{(forward + backward) / first:.2f}")
        table.add_row(name, *cells, f"{1e3 * (starts[name] - forward - backward):.0f}")
    console.print(table)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cubes", type=int, default=64)
    parser.add_argument("--repetitions", type=int, default=9)
    options = parser.parse_args()
    console, generator = Console(), torch.Generator().manual_seed(0)
    show_host_time(console, options.repetitions)
    grid = dtv.TetMesh.grid((options.cubes,) * 3)
    orders = {"as it is made": grid, "shuffled": shuffled(grid, generator)}
    show_orders(console, f"grid of {grid.num_cells:,} cells", orders, options.repetitions)
    changed = exchanged(dtv.TetMesh.grid((options.cubes // 2,) * 3), 40, generator)
    orders = {"along a curve": along_a_curve(changed), "as it is": changed, "shuffled": shuffled(changed, generator)}
    show_orders(console, f"{changed.num_cells:,} cells after 40 exchanges", orders, options.repetitions)


if __name__ == "__main__":
    main()
