"""Time and memory of a reconstruction by the size of its mesh: an iteration, and a round of exchange.

The Tooth in large views, from a grid of as many cells as are asked for, all vertices moving. Each row is a process of
its own, so that its peak memory is that of nothing else; what it needs before the first iteration stands beside it.

    python benchmarks/scale.py [--cells 1000000 10000000] [--size 512] [--iterations 8]
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from unittest.mock import patch

import torch
from rich.console import Console
from rich.table import Table

import difftetvr as dtv
from difftetvr import memory
from difftetvr.fitting.refinement import Exchange
from difftetvr.fitting.trainer import Trainer

_VIEWS = 16
_FIRST_ITERATIONS = 4


def peak_gib() -> float:
    """The most memory that this process has had so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def measure(cells: int, size: int, iterations: int) -> dict[str, float]:
    """A row: seconds and peak memory of what comes after each other."""
    torch.set_num_threads(1)  # as fit does
    capture = dtv.VolumeCapture(width=size, height=size, views=_VIEWS).build()
    began, due = time.perf_counter(), False
    with patch.object(Exchange, "is_due", lambda *_: due), memory.kept():  # as fit keeps it
        trainer = Trainer(capture, dtv.FitConfig(iterations=2400, cells=cells, evaluate_every=0))
        row = {"start s": time.perf_counter() - began, "start GiB": peak_gib()}
        for _ in range(_FIRST_ITERATIONS):  # kernels and memory are there from then on
            trainer.step()
        before = time.perf_counter()
        for _ in range(iterations):
            trainer.step()
        row |= {"iteration s": (time.perf_counter() - before) / iterations, "iterations GiB": peak_gib()}
        due, before = True, time.perf_counter()
        trainer._refine_if_due()
        row |= {"refinement s": time.perf_counter() - before, "refinement GiB": peak_gib()}
        due, before = False, time.perf_counter()
        trainer.step()
        row["next iteration s"] = time.perf_counter() - before
    changed = trainer.history.refinements[-1]
    moved = changed.removed + changed.added + changed.flipped
    return row | {
        "cells": trainer.mesh.num_cells,
        "changes": moved,
        "error": changed.error_after / changed.error_before,
    }


def main() -> None:
    """Print a table with a row for each number of cells."""
    parser = argparse.ArgumentParser(description="Time and memory of a reconstruction by the size of its mesh.")
    parser.add_argument("--cells", type=int, nargs="+", default=[1_000_000, 10_000_000])
    parser.add_argument("--size", type=int, default=512, help="pixels of the views' sides")
    parser.add_argument(
        "--iterations", type=int, default=8, help="of which the mean is taken; moves are every other one"
    )
    parser.add_argument("--row", action="store_true", help="measure in this process, and print JSON")
    arguments = parser.parse_args()
    if arguments.row:
        print(json.dumps(measure(arguments.cells[0], arguments.size, arguments.iterations)))
        return
    console, rows = Console(), []
    for cells in arguments.cells:
        command = [sys.executable, __file__, "--row", "--cells", str(cells), "--size", str(arguments.size)]
        command += ["--iterations", str(arguments.iterations)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        rows.append(json.loads(done.stdout))
    table = Table(title=f"{arguments.size} x {arguments.size} pixels, seconds and peak memory in GiB")
    for heading in rows[0]:
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))
    console.print(table)


if __name__ == "__main__":
    main()
