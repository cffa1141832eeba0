"""Runs of the Tooth studies, kept as JSON lines: a study that was interrupted goes on where it stopped."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch

import difftetvr as dtv
from difftetvr.capture import Capture
from difftetvr.fitting.motion import Motion
from difftetvr.fitting.records.evaluation import evaluate
from difftetvr.fitting.refinement import Exchange, Grow, Star

STUDY = Path("out/study")
VALIDATION_VIEWS = 16
KUHN_CELLS = {"5 k": 4992, "20 k": 19656, "79 k": 79002, "303 k": 302940}
"""Cells of the standard grids, and the budget of every method."""

METHODS: dict[str, dict[str, Any]] = {
    "uniform": {"refine": "none", "move": False, "iterations": 1000},
    "star": {"refine": "star", "move": False},
    "bisection": {
        "refine": "grow",
        "move": False,
        "grow": Grow(share=0.0, flips=False, boundary="fixed"),
    },
    "moving": {"refine": "none"},
    "exchange": {},
}
"""The columns of the main table. Uniform grids are at their best with 1000 iterations, all others take 2400."""


@dataclass(frozen=True)
class Run:
    """A reconstruction of the Tooth to make.

    Attributes:
        name: What it is called in tables.
        options: Fields of FitConfig.
        size: Pixels of the views' sides.
    """

    name: str
    options: dict[str, Any]
    size: int = 128

    def config(self) -> dtv.FitConfig:
        """Options to make it with."""
        return dtv.FitConfig(**{"evaluate_every": 0, **self.options})

    def key(self) -> str:
        """What tells it from all others."""
        return json.dumps([version(), self.size, self.config().to_json()], sort_keys=True)


@cache
def captures(size: int) -> tuple[Capture, Capture]:
    """The benchmark's views, and others to choose settings by, which are neither trained nor tested on."""
    benchmark = dtv.VolumeCapture(width=size, height=size).build()
    validation = dtv.VolumeCapture(
        width=size, height=size, views=VALIDATION_VIEWS, orbit="random", seed=7, test_every=0
    ).build()
    return benchmark, validation


def measure(run: Run) -> dict[str, Any]:
    """Makes a run; its numbers, and the mesh's."""
    torch.set_num_threads(1)
    capture, validation = captures(run.size)
    result = dtv.fit(capture, run.config())
    seen = evaluate(result.mesh, result.field, validation, range(VALIDATION_VIEWS))
    quality = result.mesh.quality()
    return {
        "key": run.key(),
        "name": run.name,
        "cells": result.mesh.num_cells,
        "vertices": result.mesh.num_vertices,
        "psnr": result.metrics["psnr"],
        "ssim": result.metrics["ssim"],
        "validation": seen.mean_psnr,
        "train": result.metrics["train_psnr"],
        "seconds": result.metrics["seconds"],
        "inverted": int((result.mesh.volumes() <= 0).sum()),
        "least_quality": float(quality.min()),
        "thin": float((quality < 0.2).float().mean()),
        "moves": result.metrics["moves"],
        "refinements": result.metrics["refinements"],
        "evaluations": result.history.evaluations,
    }


def results_of(
    study: str, runs: Iterable[Any], processes: int, make: Callable[[Any], dict[str, Any]] = measure
) -> list[dict[str, Any]]:
    """Results of runs in their order; those that are missing are made, several at a time, and kept.

    Args:
        study: Name of the file of results.
        runs: What to make; each has a ``key()``.
        processes: How many at a time; more than one spoils the times.
        make: Makes one.
    """
    STUDY.mkdir(parents=True, exist_ok=True)
    path = STUDY / f"{study}.jsonl"
    known = dict(_known(path))
    runs = list(runs)
    missing = {run.key(): run for run in runs if run.key() not in known}
    with ProcessPoolExecutor(processes) as pool:
        for done in as_completed([pool.submit(make, run) for run in missing.values()]):
            result = done.result()
            known[result["key"]] = result
            with path.open("a") as file:
                file.write(json.dumps(result) + "\n")
            print(f"  {result['name']}: {result['psnr']:.2f} dB held out, {result['seconds']:.0f} s", flush=True)
    return [known[run.key()] for run in runs]


def _known(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Results of a file by key; a last line that a kill has cut short is left out."""
    for line in path.read_text().splitlines() if path.exists() else ():
        with suppress(json.JSONDecodeError):
            result = json.loads(line)
            yield result["key"], result


@cache
def version() -> str:
    """What tells this state of the package from others: results of other code are of no use."""
    digest = hashlib.sha256()
    for file in sorted(Path(dtv.__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def spread(values: list[float]) -> str:
    """Mean and range of a number over seeds."""
    mean = sum(values) / len(values)
    return f"{mean:.2f}" if len(values) == 1 else f"{mean:.2f} ({min(values):.2f} to {max(values):.2f})"


def changed(**parts: Any) -> dict[str, Any]:
    """Options of FitConfig from changes of its parts, e.g. ``exchange={"rounds": 3}``."""
    kinds = {"exchange": Exchange, "grow": Grow, "star": Star, "motion": Motion}
    return {
        name: dataclasses.replace(kinds[name](), **value) if name in kinds else value for name, value in parts.items()
    }
