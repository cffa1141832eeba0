"""Time and peak memory of building a mesh from plain arrays: validation, orientation, adjacency, boundary faces.

python benchmarks/mesh_build.py
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
import time
from multiprocessing.connection import Connection

import torch
from rich.console import Console
from rich.table import Table

from difftetvr.mesh import TetMesh

GRIDS = ((64, 64, 64), (177, 100, 100))


def measure(shape: tuple[int, int, int], connection: Connection) -> None:
    grid = TetMesh.grid(shape)
    vertices, tets = grid.vertices, grid.tets
    start = time.perf_counter()
    mesh = TetMesh(vertices, tets)
    topology = mesh.topology
    boundary = len(topology.boundary_faces)
    built = time.perf_counter() - start
    peak = peak_gigabytes()
    start = time.perf_counter()
    _ = topology.faces, topology.edges, topology.vertex_cells
    rest = time.perf_counter() - start
    connection.send((mesh.num_cells, boundary, built, peak, rest, peak_gigabytes()))


def peak_gigabytes() -> float:
    """Peak resident memory of this process, the libraries' own included."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e9 if sys.platform == "darwin" else peak * 1024 / 1e9


def main() -> None:
    table = Table(title=f"TetMesh(vertices, tets), torch {torch.__version__}, CPU")
    for heading in (
        "cells",
        "boundary faces",
        "checked, oriented, adjacency, boundary",
        "peak memory",
        "faces, edges, incidence",
        "peak memory",
    ):
        table.add_column(heading, justify="right")
    # A process of its own for each size, since peak memory only ever grows.
    context = multiprocessing.get_context("spawn")
    for shape in GRIDS:
        receiver, sender = context.Pipe(duplex=False)
        worker = context.Process(target=measure, args=(shape, sender))
        worker.start()
        sender.close()
        cells, boundary, built, peak, rest, final = receiver.recv()
        worker.join()
        table.add_row(
            f"{cells:,}", f"{boundary:,}", f"{built:.2f} s", f"{peak:.2f} GB", f"{rest:.2f} s", f"{final:.2f} GB"
        )
    Console().print(table)


if __name__ == "__main__":
    main()
