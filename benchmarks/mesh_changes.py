"""Time of every change of a mesh of a million cells, on one core.

python benchmarks/mesh_changes.py [cells]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import torch
from rich.console import Console
from rich.table import Table

from difftetvr.mesh import (
    MeshChange,
    TetMesh,
    Topology,
    bisect_edges,
    collapse_edges,
    independent_edges,
    insert_delaunay,
    long_edges,
    remove_cells,
    star_subdivision,
)
from difftetvr.mesh.topology.incidence import cell_edges

REPETITIONS = 3
EXCHANGED = 0.08
"""Share of the cells that an exchange moves."""


def fresh(mesh: TetMesh) -> TetMesh:
    """The same mesh with no table but the neighbours, which whoever renders has, and the edges that scores are for."""
    topology = Topology(mesh.tets, mesh.num_vertices, mesh.topology.cell_adjacency)
    topology.cached("edges", lambda: mesh.topology.edges)
    return TetMesh.from_valid(mesh.vertices, topology)


def operations(mesh: TetMesh) -> dict[str, Callable[[TetMesh], MeshChange]]:
    generator = torch.Generator().manual_seed(0)
    num_edges, budget = len(mesh.topology.edges), int(EXCHANGED * mesh.num_cells)
    scores = torch.rand(num_edges, generator=generator)
    both_ends = torch.arange(2).repeat_interleave(num_edges)
    vertices = torch.randperm(mesh.num_vertices, generator=generator)[: mesh.num_vertices // 20]
    empty = torch.rand(mesh.num_cells, generator=generator) < 0.5

    def bisect(mesh: TetMesh, budget: int | None) -> MeshChange:
        return bisect_edges(mesh, independent_edges(mesh, scores, long_edges(mesh), budget))

    def collapse(mesh: TetMesh, count: int) -> MeshChange:
        edges = torch.arange(num_edges).repeat(2)[:count]
        return collapse_edges(mesh, edges, both_ends[:count], scores.repeat(2)[:count], limit=budget)

    return {
        f"bisect long edges, {EXCHANGED:.0%} of the cells": lambda mesh: bisect(mesh, budget),
        "bisect as many long edges as possible": lambda mesh: bisect(mesh, None),
        f"collapse {EXCHANGED:.0%} of the cells, one end of each edge": lambda mesh: collapse(mesh, num_edges),
        f"collapse {EXCHANGED:.0%} of the cells, both ends of each edge": lambda mesh: collapse(mesh, 2 * num_edges),
        "stars of 5 % of the vertices": lambda mesh: star_subdivision(mesh, vertices),
        "remove half of the cells": lambda mesh: remove_cells(mesh, empty),
    }


def seconds(mesh: TetMesh, operation: Callable[[TetMesh], MeshChange], warm: bool) -> tuple[float, MeshChange]:
    """Best time of the process, which other work on the machine disturbs least."""
    best = float("inf")
    for _ in range(REPETITIONS):
        if not warm:
            mesh = fresh(mesh)
        start = time.process_time()
        change = operation(mesh)
        best = min(best, time.process_time() - start)
    return best, change


def insertion(cells: int) -> tuple[float, MeshChange]:
    """Time to insert a point per hundred cells into the Delaunay mesh of random points, once: Qhull takes its time."""
    generator = torch.Generator().manual_seed(0)
    mesh = TetMesh.delaunay(torch.rand((int(cells / 6.6), 3), generator=generator, dtype=torch.float64))
    points = mesh.vertices[mesh.tets[::100].long()].mean(1)
    start = time.process_time()
    change = insert_delaunay(mesh, points)
    return time.process_time() - start, change


def main() -> None:
    torch.set_num_threads(1)
    cells = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    side = round((cells / 6) ** (1 / 3))
    mesh = TetMesh.grid((side, side, side))
    _ = mesh.topology.edges, mesh.topology.vertex_cells, cell_edges(mesh.topology), mesh.topology.boundary_faces
    table = Table(title=f"{mesh.num_cells:,} cells, one core, CPU time, torch {torch.__version__}")
    for heading in ("change", "cells after", "tables to build", "tables there"):
        table.add_column(heading, justify="left" if heading == "change" else "right")
    for name, operation in operations(mesh).items():
        cold, change = seconds(mesh, operation, warm=False)
        warm, _ = seconds(mesh, operation, warm=True)
        table.add_row(name, f"{change.mesh.num_cells:,}", f"{cold:.2f} s", f"{warm:.2f} s")
    needed, change = insertion(cells)
    table.add_row("insert 1 % as many points (random points)", f"{change.mesh.num_cells:,}", f"{needed:.1f} s", "")
    Console().print(table)


if __name__ == "__main__":
    main()
