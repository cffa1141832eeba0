"""The article's Fig. 9: what adaptive subdivision does to the error, for its strategy and for ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table
from tooth_runs import KUHN_CELLS, METHODS, Run, results_of

PICTURE = Path("docs/images/tooth_figure9.png")
CELLS = KUHN_CELLS["20 k"]
LINES: dict[str, dict[str, Any]] = {
    "stars, vertices fixed (article)": METHODS["star"],
    "stars, vertices move": {"refine": "star"},
    "bisection by predicted gain, fixed": METHODS["bisection"],
    "growth, vertices move": {"refine": "grow"},
    "exchange, vertices move (default)": METHODS["exchange"],
    "uniform grid of the final size": {"refine": "none", "move": False},
}


def figure9(processes: int) -> Table:
    runs = [Run(name, {"cells": CELLS, "evaluate_every": 40, **options}) for name, options in LINES.items()]
    results = results_of("figure9", runs, processes)
    report = Table(title=f"Fig. 9: refinement to {CELLS:,} cells")
    for heading in ("strategy", "cells at first", "cells", "PSNR, dB", "cells with Q < 0.2"):
        report.add_column(heading, justify="left" if heading == "strategy" else "right")
    for result in results:
        first = result["refinements"][0]["cells_before"] if result["refinements"] else result["cells"]
        report.add_row(
            result["name"], f"{first:,}", f"{result['cells']:,}", f"{result['psnr']:.2f}", f"{result['thin']:.0%}"
        )
    draw(results)
    return report


def draw(results: list[dict[str, Any]]) -> None:
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    quality, size = figure.subplots(1, 2)
    for result in results:
        iterations, psnr = zip(*result["evaluations"], strict=True)
        quality.plot(iterations, psnr, label=result["name"])
        steps = [(0, result["refinements"][0]["cells_before"] if result["refinements"] else result["cells"])]
        steps += [(record["iteration"], record["cells"]) for record in result["refinements"]]
        steps.append((iterations[-1], result["cells"]))
        size.step(*zip(*steps, strict=True), where="post", label=result["name"])
    quality.set_ylabel("PSNR of 4 held-out views (dB)")
    size.set_ylabel("cells")
    for axes in (quality, size):
        axes.set_xlabel("iteration")
        axes.grid(alpha=0.3)
    figure.legend(*quality.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    canvas.print_png(str(PICTURE))
