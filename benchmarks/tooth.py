"""The studies of moving vertices and of refinement on the Tooth: tables and plots of docs/results.md.

python benchmarks/tooth.py table [SIZE ...]      every method at 5 k, 20 k, 79 k, 303 k cells
python benchmarks/tooth.py seeds [SIZE ...]      the rows that are quoted, with three seeds
python benchmarks/tooth.py candidates            what lifts 20 k cells, and what does not
python benchmarks/tooth.py large                 views of 512 x 512
python benchmarks/tooth.py figure8               the article's Fig. 8: rates, lambda, beta
python benchmarks/tooth.py figure9               the article's Fig. 9: adaptive subdivision

Results are kept in out/study, so an interrupted study goes on. --processes N makes N runs at a time; times then suffer.
"""

from __future__ import annotations

import argparse
import sys

from rich.console import Console
from rich.table import Table
from tooth_runs import KUHN_CELLS, METHODS, Run, changed, results_of, spread

SEEDS = (0, 1, 2)
QUOTED = ("uniform", "exchange")
CANDIDATES = {
    "default": {},
    "boundary vertices neither slide nor go": changed(exchange={"boundary": "fixed"}, motion={"boundary": "fixed"}),
    "no flips": changed(exchange={"flips": False}),
    "14 rounds until 65 %": changed(exchange={"rounds": 14, "until": 0.65}),
    "80 rounds": changed(exchange={"rounds": 80}),
    "moves from single views": changed(motion={"every": 1}),
    "two views an iteration": {"batch_views": 2},
    "4800 iterations, 80 rounds": changed(iterations=4800, exchange={"rounds": 80}),
    "l1 loss": {"loss": "l1"},
    "SSIM in the loss": {"loss": "l1-ssim"},
    "no moves": {"move": False},
}


def table(sizes: list[str], processes: int) -> Table:
    runs = [
        Run(f"{method}, {size}", {"cells": KUHN_CELLS[size], **options})
        for size in sizes
        for method, options in METHODS.items()
    ]
    results = iter(results_of("table", runs, processes))
    report = Table(title="Held-out PSNR in dB, one seed")
    for heading in ("cells", *METHODS):
        report.add_column(heading, justify="right")
    for size in sizes:
        row = [next(results) for _ in METHODS]
        assert not any(result["inverted"] for result in row)
        report.add_row(size, *(f"{result['psnr']:.2f}" for result in row))
    return report


def seeds(sizes: list[str], processes: int) -> Table:
    runs = [
        Run(f"{method}, {size}, seed {seed}", {"cells": KUHN_CELLS[size], "seed": seed, **METHODS[method]})
        for size in sizes
        for method in QUOTED
        for seed in SEEDS
    ]
    results = iter(results_of("table", runs, processes))
    report = Table(
        title=f"Held-out PSNR in dB over {len(SEEDS)} seeds; SSIM, training and seconds are those of exchange"
    )
    for heading in ("cells", *QUOTED, "SSIM", "training", "inverted cells", "seconds"):
        report.add_column(heading, justify="right")
    for size in sizes:
        rows = [[next(results) for _ in SEEDS] for _ in QUOTED]
        last = rows[-1]
        report.add_row(
            size,
            *(spread([result["psnr"] for result in row]) for row in rows),
            spread([result["ssim"] for result in last]),
            spread([result["train"] for result in last]),
            str(sum(result["inverted"] for row in rows for result in row)),
            f"{last[0]['seconds']:.0f}",
        )
    return report


def candidates(processes: int) -> Table:
    runs = [Run(name, {"cells": KUHN_CELLS["20 k"], **options}) for name, options in CANDIDATES.items()]
    results = results_of("table", runs, processes)
    base = results[0]
    report = Table(title="20 k cells, one change at a time; PSNR in dB on views for validation and for the test")
    for heading in ("change", "validation", "against the default", "test", "cells with Q < 0.2"):
        report.add_column(heading, justify="left" if heading == "change" else "right")
    for run, result in zip(runs, results, strict=True):
        report.add_row(
            run.name,
            f"{result['validation']:.2f}",
            f"{result['validation'] - base['validation']:+.2f}",
            f"{result['psnr']:.2f}",
            f"{result['thin']:.0%}",
        )
    return report


def large(processes: int) -> Table:
    """As far as CPUs go in minutes: a quarter of the iterations."""
    options = {"cells": KUHN_CELLS["303 k"], "iterations": 600, "deterministic": False}
    few_rounds = changed(exchange={"rounds": 10, "views": 6})
    runs = [
        Run("uniform", {**options, "refine": "none", "move": False}, 512),
        Run("exchange", {**options, **few_rounds}, 512),
    ]
    report = Table(title="303 k cells, 512 x 512 pixels, 600 iterations; held-out PSNR in dB")
    for heading in ("method", "PSNR", "SSIM", "training", "inverted cells", "seconds"):
        report.add_column(heading, justify="left" if heading == "method" else "right")
    for result in results_of("large", runs, processes):
        report.add_row(
            result["name"],
            f"{result['psnr']:.2f}",
            f"{result['ssim']:.4f}",
            f"{result['train']:.2f}",
            str(result["inverted"]),
            f"{result['seconds']:.0f}",
        )
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=("table", "seeds", "candidates", "large", "figure8", "figure9"))
    parser.add_argument("sizes", nargs="*", metavar="SIZE", help="5k, 20k, 79k, 303k; default: all")
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args()
    by_name = {size.replace(" ", ""): size for size in KUHN_CELLS}
    unknown = [size for size in options.sizes if size not in by_name]
    if unknown:
        sys.exit(f"There is no size {unknown[0]}; choose among {', '.join(by_name)}.")
    sizes = [by_name[size] for size in options.sizes] or list(KUHN_CELLS)
    console = Console()
    if options.study == "table":
        console.print(table(sizes, options.processes))
    elif options.study == "seeds":
        console.print(seeds(sizes, options.processes))
    elif options.study == "candidates":
        console.print(candidates(options.processes))
    elif options.study == "large":
        console.print(large(options.processes))
    elif options.study == "figure8":
        from tooth_figure8 import figure8

        console.print(figure8(options.processes))
    else:
        from tooth_figure9 import figure9

        console.print(figure9(options.processes))


if __name__ == "__main__":
    main()
