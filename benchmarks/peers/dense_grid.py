"""A peer: what a voxel grid with harmonics makes of the same images in the same minutes, and when.

python benchmarks/peers/dense_grid.py CAPTURE [--minutes 30] [--downscale N] [--validate] [-o OUT]

One after the other on this machine, each in a process of its own: a grid as Plenoxels has it (`voxel_fit.py`), and a
mesh by `dtv.fit` with the options chosen for the images, in as many iterations as a short run before says will take
that long. The time of evaluations does not count. OUT.csv holds seconds and mean PSNR of the held-out views, OUT.png
shows them. With --validate, every tenth training view is held out and no test view is looked at.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import os
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from voxel_fit import Settings, VoxelFit

import difftetvr as dtv
from difftetvr.capture import Capture
from difftetvr.fitting.loop import prepare
from difftetvr.fitting.records.evaluation import evaluate

MOMENTS = (0.02, 0.04, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Shares of the time at which held-out views are looked at."""
PILOT_ITERATIONS, PILOT_OF = 300, 2400
"""Iterations of the run that says how long one takes, the first ones of a run of so many."""
KEPT_ASIDE = 10
"""One training view of so many is a validation view."""
LABELS = {"voxels": "voxel grid, as Plenoxels", "mesh": "tetrahedral mesh, dtv.fit"}

Curve = list[tuple[float, float]]


def for_validation(capture: Capture) -> Capture:
    """The training views alone, some of them held out."""
    views = capture.train_indices.tolist()
    return dataclasses.replace(
        capture,
        cameras=[capture.cameras[view] for view in views],
        images=torch.stack([capture.images[view] for view in views]),
        alphas=None if capture.alphas is None else torch.stack([capture.alphas[view] for view in views]),
        test=torch.arange(len(views)) % KEPT_ASIDE == KEPT_ASIDE // 2,
        valid=None,
    )


def voxels(capture: Capture, seconds: float) -> Curve:
    """Seconds, and PSNR in dB, of a voxel grid."""
    held_out = capture.test_indices.tolist()
    fit = VoxelFit(capture, Settings())
    curve = [(spent, fit.psnr(held_out)) for spent in fit.run(seconds, [share * seconds for share in MOMENTS])]
    print(f"voxels: {fit.steps:,} steps, {fit.rays / curve[-1][0]:,.0f} rays a second that meet something")
    return curve


def mesh(capture: Capture, seconds: float, iterations: int | None) -> Curve:
    """Seconds, and PSNR in dB, of a mesh."""
    iterations = iterations or mesh_iterations(capture, seconds)
    trainer = prepare(capture, dtv.FitConfig(evaluate_every=0, iterations=iterations))
    waiting, spent, curve = [share * iterations for share in MOMENTS], 0.0, []
    background = trainer.config.evaluation_background()
    for iteration in range(iterations):
        start = time.perf_counter()
        trainer.step()
        spent += time.perf_counter() - start
        if iteration + 1 >= waiting[0]:
            waiting.pop(0)
            field = trainer.parameters.detached_field()
            found = evaluate(trainer.mesh, field, capture, capture.test_indices.tolist(), background)
            curve.append((spent, found.mean_psnr or 0.0))
    print(f"mesh: {iterations:,} iterations, {trainer.mesh.num_cells:,} cells, {spent:.0f} s")
    return curve


def mesh_iterations(capture: Capture, seconds: float) -> int:
    """Iterations that take about so long, by the beginning of a run; its first steps, which compile kernels, left out.

    Cells gather where the object is, so that later iterations take longer, or less long, than these.
    """
    trainer = prepare(capture, dtv.FitConfig(evaluate_every=0, iterations=PILOT_OF))
    taken: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(PILOT_ITERATIONS):
        start, rounds = time.perf_counter(), len(trainer.history.refinements)
        trainer.step()
        taken[len(trainer.history.refinements) > rounds].append(time.perf_counter() - start)
    step, refinement = statistics.median(taken[False]), statistics.median(taken[True])
    per_step = len(taken[True]) / PILOT_ITERATIONS
    return max(1, int(seconds / (step + (refinement - step) * per_step)))


def measure(name: str, options: argparse.Namespace) -> Curve:
    """The curve of one method."""
    torch.set_num_threads(1)  # as `dtv.fit` does: the cores are the kernels'
    capture = dtv.load_capture(options.capture, downscale=options.downscale)
    capture = for_validation(capture) if options.validate else capture
    seconds = 60.0 * options.minutes
    return voxels(capture, seconds) if name == "voxels" else mesh(capture, seconds, options.iterations)


def draw(curves: dict[str, Curve], title: str, path: Path) -> None:
    """Write the plot of PSNR against time."""
    figure = Figure(figsize=(7, 5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name, curve in curves.items():
        axes.plot(*zip(*curve), "o-", markersize=4, label=f"{LABELS[name]}: {curve[-1][1]:.2f} dB")
    axes.set_xscale("log")
    axes.set_xlabel("seconds of fitting")
    axes.set_ylabel("PSNR of held-out views (dB)")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    axes.set_title(title, fontsize=10)
    canvas.print_png(str(path))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--iterations", type=int, help="of the mesh; default: as many as take that long")
    parser.add_argument("--validate", action="store_true")
    parser.add_argument("--rows", nargs="+", choices=LABELS, default=list(LABELS))
    parser.add_argument("-o", "--output", default="out/dense_grid")
    options = parser.parse_args()
    output, curves = Path(options.output), {}
    output.parent.mkdir(parents=True, exist_ok=True)
    for name in options.rows:
        with ProcessPoolExecutor(1) as process:
            curves[name] = process.submit(measure, name, options).result()
        print(name, *(f"{seconds:.0f} s {psnr:.2f} dB" for seconds, psnr in curves[name]), sep="\n  ", flush=True)
        with output.with_suffix(".csv").open("w", newline="") as file:
            rows = [(name, f"{seconds:.2f}", f"{psnr:.4f}") for name in curves for seconds, psnr in curves[name]]
            csv.writer(file).writerows([("method", "seconds", "psnr"), *rows])
    stages = ", ".join(f"{longest}" for _, longest in Settings().stages)
    name, cores = Path(options.capture).name, len(os.sched_getaffinity(0))
    views = "validation" if options.validate else "test"
    title = f"{name}, downscale {options.downscale}, {options.minutes:g} min each on {cores} cores, {views} views\n"
    draw(
        curves,
        title + f"voxels along the longest side: {stages}; degree {Settings().degree}",
        output.with_suffix(".png"),
    )


if __name__ == "__main__":
    main()
