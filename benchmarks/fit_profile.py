"""Where a reconstruction spends its time: the parts of an iteration and of a refinement.

The Tooth from its views, with the options of a fit; some cycles of iterations and a refinement are done first, so that
kernels are there and the mesh is as irregular as in a run. Times are exclusive: what a part calls counts there.

    python benchmarks/fit_profile.py [--cells 20000 303000] [--sizes 128] [--cycles 2]
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch
from rich.console import Console
from rich.table import Table

import difftetvr as dtv
from difftetvr.capture.truth import Truth
from difftetvr.fitting import gradients
from difftetvr.fitting.parameters import FieldParameters
from difftetvr.fitting.positions import VertexOptimizer
from difftetvr.fitting.refinement import exchange_round
from difftetvr.fitting.refinement.pixels import Judgement
from difftetvr.fitting.trainer import Trainer
from difftetvr.rendering.search import memory_order

ITERATIONS = 2400
PARTS: dict[str, tuple[Any, str]] = {
    "rendering": (gradients, "render"),
    "its backward pass": (torch.Tensor, "backward"),
    "truth": (Truth, "image"),
    "steps of the field": (FieldParameters, "step"),
    "steps of vertices": (VertexOptimizer, "advance"),
    "order in memory": (memory_order, "_ordered"),
    "models of images": (Judgement, "model"),
    "flips": (exchange_round._Round, "flip"),
    "search for flips": (exchange_round, "find_flips"),
    "collapses": (exchange_round._Round, "collapse"),
    "bisections": (exchange_round._Round, "bisect"),
    "what edges win": (exchange_round, "bisection_gains"),
    "errors before and after": (Judgement, "error"),
    "carrying parameters": (Trainer, "_apply"),
}


class Stopwatch:
    """Exclusive seconds of parts, by name."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self._running = ["the rest"]
        self._since = time.perf_counter()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Time a part."""
        self._pass(name)
        self.calls[name] += 1
        self._running.append(name)
        try:
            yield
        finally:
            self._pass(name)
            self._running.pop()

    def _pass(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[self._running[-1]] += now - self._since
        self._since = now

    def reset(self) -> None:
        """Forget all."""
        self.seconds.clear()
        self.calls.clear()
        self._since = time.perf_counter()

    def watch(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function that is timed."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.part(name):
                return function(*args, **kwargs)

        return timed


def profile(capture: dtv.Capture, cells: int, cycles: int) -> tuple[Stopwatch, int, int]:
    """Times of some cycles, their iterations, and cells of the mesh."""
    trainer = Trainer(capture, dtv.FitConfig(iterations=ITERATIONS, cells=cells, evaluate_every=0))
    watch = Stopwatch()
    with ExitStack() as stack:
        for name, (owner, attribute) in PARTS.items():
            stack.enter_context(patch.object(owner, attribute, watch.watch(name, getattr(owner, attribute))))

        def run(refinements: int) -> int:
            first, goal = trainer.iteration, len(trainer.history.refinements) + refinements
            while len(trainer.history.refinements) < goal:
                trainer.step()
            return trainer.iteration - first

        run(2)
        watch.reset()
        iterations = run(cycles)
        watch._pass("")
    return watch, iterations, trainer.mesh.num_cells


def main() -> None:
    """Print a table for each size of views and number of cells."""
    parser = argparse.ArgumentParser(description="Where a reconstruction spends its time.")
    parser.add_argument("--cells", type=int, nargs="+", default=[20_000, 303_000])
    parser.add_argument("--sizes", type=int, nargs="+", default=[128], help="pixels of the views' sides")
    parser.add_argument("--cycles", type=int, default=2, help="refinements, and the iterations up to each")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # as fit does
    console = Console()
    for size in arguments.sizes:
        capture = dtv.VolumeCapture(width=size, height=size).build()
        for cells in arguments.cells:
            watch, iterations, count = profile(capture, cells, arguments.cycles)
            table = Table(title=f"{count} cells, {size} x {size} pixels, per cycle of {iterations // arguments.cycles}")
            for heading in ("part", "calls", "seconds", "ms a call", "share"):
                table.add_column(heading, justify="left" if heading == "part" else "right")
            total = sum(watch.seconds.values())
            for name, seconds in watch.seconds.most_common():
                calls = watch.calls[name]
                each = f"{1e3 * seconds / calls:.2f}" if calls else ""
                row = (name, calls / arguments.cycles, seconds / arguments.cycles)
                table.add_row(row[0], f"{row[1]:g}", f"{row[2]:.2f}", each, f"{seconds / total:.0%}")
            table.add_row("all", "", f"{total / arguments.cycles:.2f}", "", "100%")
            console.print(table)


if __name__ == "__main__":
    main()
