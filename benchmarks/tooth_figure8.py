"""The article's Fig. 8: learning rates of colour and position, lambda and beta, with marks where cells are inverted.

Vertices move as in the article, by Adam in world units with the regulariser in the loss, here with exact gradients;
once as they come, once through the guard. Uniform grid of 5 k cells, 1000 iterations of one view.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table
from tooth_runs import KUHN_CELLS, Run, captures, changed, results_of, version

import difftetvr as dtv
from difftetvr.fitting import softplus_regularizer
from difftetvr.fitting.parameters import FieldParameters
from difftetvr.fitting.records.evaluation import evaluate
from difftetvr.mesh.motion import guard_move

PICTURE = Path("docs/images/tooth_figure8.png")
ITERATIONS = 1000
BETAS = (0.9, 0.99)


OURS = Run(
    "steps in altitudes, guarded",
    {
        "cells": KUHN_CELLS["5 k"],
        "iterations": ITERATIONS,
        "refine": "none",
        **changed(motion={"boundary": "fixed"}),
    },
)
"""The same grid, iterations and fixed boundary, moved as `fit` does."""


@dataclass(frozen=True)
class ArticleRun:
    """Colours and positions optimised together as in the article: constant rates, lambda times the regulariser."""

    color_rate: float = 0.03
    position_rate: float = 0.0
    weight: float = 10.0
    beta: float = 100.0
    guarded: bool = False

    @property
    def name(self) -> str:
        """What it is called."""
        return ", ".join(f"{name} {value:g}" for name, value in asdict(self).items())

    def key(self) -> str:
        """What tells it from all others."""
        return json.dumps([version(), ITERATIONS, asdict(self)])


def measure(run: ArticleRun) -> dict[str, Any]:
    torch.set_num_threads(1)
    capture, _ = captures(128)
    config = dtv.FitConfig(refine="none", move=False, iterations=ITERATIONS)
    lower, upper = capture.bounds.tolist()
    mesh = dtv.TetMesh.grid((8, 8, 13), lower, upper)
    assert mesh.num_cells == KUHN_CELLS["5 k"]
    parameters = FieldParameters(mesh, config, capture.density_units_at(mesh.vertices))
    vertices = mesh.vertices.clone().requires_grad_(run.position_rate > 0)
    mover = torch.optim.Adam([vertices], lr=run.position_rate or 1.0, betas=BETAS, eps=1e-15)
    inner = torch.ones(mesh.num_vertices, 1)
    inner[mesh.topology.boundary_faces.unique().long()] = 0.0
    views = capture.train_indices.tolist()
    start = time.perf_counter()
    for iteration in range(ITERATIONS):
        mesh = mesh.with_vertices(vertices)
        view = views[config.views_at(iteration, len(views))[0]]
        parameters.zero_grad()
        mover.zero_grad()
        image = dtv.render(mesh, parameters.field(), capture.cameras[view]).color
        loss = (image - capture.images[view]).square().mean()
        if run.position_rate:
            loss = loss + run.weight * softplus_regularizer(mesh, run.beta)
        loss.backward()
        parameters.step(run.color_rate, config.haze_penalty)
        if run.position_rate:
            move_vertices(vertices, inner, mover, mesh, run.guarded)
    mesh = mesh.with_vertices(vertices.detach())
    tested = evaluate(mesh, parameters.detached_field(), capture, capture.test_indices.tolist())
    return {
        "key": run.key(),
        "name": run.name,
        "psnr": tested.mean_psnr,
        "inverted": int((mesh.volumes() <= 0).sum()),
        "seconds": time.perf_counter() - start,
    }


def move_vertices(
    vertices: torch.Tensor, inner: torch.Tensor, mover: torch.optim.Adam, mesh: dtv.TetMesh, guarded: bool
) -> None:
    """A step of Adam for the inner vertices; what the guard refuses is taken back."""
    before = vertices.detach().clone()
    vertices.grad *= inner
    mover.step()
    if guarded:
        move = vertices.detach() - before
        with torch.no_grad():
            vertices.copy_(guard_move(mesh.with_vertices(before), move).vertices)


def sweep(name: str, values: list[float], **fixed: Any) -> list[ArticleRun]:
    return [ArticleRun(**{**fixed, name: value}) for value in values]


def figure8(processes: int) -> Table:
    rates = [1e-6, 5e-6, 1e-5, 1e-4, 3e-4, 1e-3, 3e-3]
    sweeps = {
        "rate of colours": ("color_rate", sweep("color_rate", [0.005, 0.01, 0.03, 0.06, 0.08, 0.1, 0.2])),
        "rate of positions, no guard": ("position_rate", sweep("position_rate", rates)),
        "rate of positions, guarded": ("position_rate", sweep("position_rate", rates, guarded=True)),
        "lambda, no guard": ("weight", sweep("weight", [0.001, 0.01, 0.1, 1.0, 10.0, 100.0], position_rate=1e-3)),
        "beta, no guard": ("beta", sweep("beta", [1.0, 3.0, 10.0, 30.0, 100.0, 300.0], position_rate=1e-3)),
    }
    runs = [run for _, members in sweeps.values() for run in members]
    results = iter(results_of("figure8", runs, processes, measure))
    ours = results_of("figure8", [OURS], processes)[0]
    report = Table(title="Fig. 8: held-out PSNR in dB, and inverted cells")
    for heading in ("sweep", "value", "PSNR", "inverted cells"):
        report.add_column(heading, justify="left" if heading == "sweep" else "right")
    points = {}
    for name, (option, members) in sweeps.items():
        points[name] = [(getattr(run, option), next(results)) for run in members]
        for value, result in points[name]:
            report.add_row(name, f"{value:g}", f"{result['psnr']:.2f}", str(result["inverted"]))
    draw(points, ours["psnr"])
    return report


def draw(points: dict[str, list[tuple[float, dict[str, Any]]]], ours: float) -> None:
    figure = Figure(figsize=(10, 7), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = {
        "rate of colours (positions fixed)": ["rate of colours"],
        "rate of positions, world units": ["rate of positions, no guard", "rate of positions, guarded"],
        "lambda": ["lambda, no guard"],
        "beta": ["beta, no guard"],
    }
    for axes, (label, names) in zip(figure.subplots(2, 2).flat, panels.items(), strict=True):
        for name in names:
            x, results = zip(*points[name], strict=True)
            y = [result["psnr"] for result in results]
            (line,) = axes.plot(x, y, "o-", markersize=4, label=name)
            bad = [(a, b) for a, b, result in zip(x, y, results, strict=True) if result["inverted"]]
            if bad:
                axes.plot(*zip(*bad, strict=True), "x", color="red", markersize=11, markeredgewidth=2)
            line.set_zorder(1)
        if "colours" not in label:
            axes.axhline(ours, color="tab:green", linestyle="--", label="steps in altitudes, guarded")
        axes.set_xscale("log")
        axes.set_xlabel(label)
        axes.set_ylabel("held-out PSNR (dB)")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.suptitle("A red cross marks runs that end with inverted cells")
    canvas.print_png(str(PICTURE))
