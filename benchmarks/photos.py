"""Reconstructions from photographs and NeRF-synthetic views: what adaptivity and directional colours buy.

python benchmarks/photos.py CAPTURE [--downscale N] [--cells N] [--iterations N] [--validate] [--rows default ...]

CAPTURE is what `difftetvr fit` takes. Each row is one reconstruction with the options chosen for the images, but
for what its name says; "grid" is uniform, and neither moves nor refines. Every row runs in a process of its own, so
that its peak of memory is its own. Options are chosen with --validate, which looks at no test view: every eighth
training view is held out in their place. Seconds of processors are those of all threads, whatever else goes on.
"""

from __future__ import annotations

import argparse
import dataclasses
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from difftetvr.capture import Capture

_KEPT_ASIDE = 8
_GRID = {"move": False, "refine": "none", "start": "grid"}
ROWS: dict[str, dict[str, Any]] = {
    "default": {},
    "no-harmonics": {"harmonics": 0},
    "grid": _GRID,
    "grid-no-harmonics": _GRID | {"harmonics": 0},
    "l1-ssim": {"loss": "l1-ssim"},
    "start-grid": {"start": "grid"},
    "start-points": {"start": "points"},
    "no-free-space": {"free_space": 0.0},
    "pace-1": {"pace": 1.0},
}


def for_validation(capture: Capture) -> Capture:
    """The training views alone, every eighth of them held out."""
    import torch

    views = capture.train_indices.tolist()
    chosen = {
        name: None if getattr(capture, name) is None else torch.stack([getattr(capture, name)[view] for view in views])
        for name in ("images", "alphas", "valid")
    }
    test = torch.arange(len(views)) % _KEPT_ASIDE == _KEPT_ASIDE // 2
    return dataclasses.replace(capture, cameras=[capture.cameras[view] for view in views], test=test, **chosen)


def measure(
    source: str, downscale: int, options: dict[str, int | None], name: str, validate: bool = False
) -> dict[str, float]:
    """One reconstruction: quality on the held-out views, seconds, MiB at its peak."""
    import difftetvr as dtv

    capture = dtv.load_capture(source, downscale=downscale)
    if validate:
        capture = for_validation(capture)
    start, busy = time.perf_counter(), time.process_time()
    result = dtv.fit(capture, dtv.FitConfig(evaluate_every=0, **options, **ROWS[name]))
    return {
        "cells": result.mesh.num_cells,
        "psnr": result.metrics["psnr"],
        "ssim": result.metrics["ssim"],
        "train": result.metrics["train_psnr"],
        "seconds": time.perf_counter() - start,
        "busy": time.process_time() - busy,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--cells", type=int)
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--validate", action="store_true", help="hold training views out and look at no test view")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS)[:4])
    options = parser.parse_args()
    table = Table(title=f"{options.capture}, downscale {options.downscale}; PSNR in dB")
    for heading in ("row", "cells", "held out", "SSIM", "training", "seconds", "of processors", "MiB"):
        table.add_column(heading, justify="left" if heading == "row" else "right")
    for name in options.rows:
        with ProcessPoolExecutor(1) as process:
            chosen = {"cells": options.cells, "iterations": options.iterations}
            asked = (options.capture, options.downscale, chosen, name, options.validate)
            found = process.submit(measure, *asked).result()
        quality = (f"{found['psnr']:.2f}", f"{found['ssim']:.4f}", f"{found['train']:.2f}")
        spent = (f"{found['seconds']:.0f}", f"{found['busy']:.0f}", f"{found['memory']:,.0f}")
        table.add_row(name, f"{found['cells']:,}", *quality, *spent)
        print(name, *quality, flush=True)
    Console().print(table)


if __name__ == "__main__":
    main()
