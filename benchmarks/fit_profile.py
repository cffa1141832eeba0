"""Where a reconstruction spends its time: the parts of an iteration and of a refinement.

The Tooth from its views, with the options of a fit; some cycles of iterations and a refinement are done first, so that
kernels are there and the mesh is as irregular as in a run. Times are exclusive: what a part calls counts there. A cycle
after those that are timed is watched by the profilers of Dr.Jit and PyTorch; what neither accounts for of the time of
the others, which nobody watched, is Python's.

    python benchmarks/fit_profile.py [--cells 20000 303000 1000000] [--sizes 128 512] [--cycles 2]
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import drjit as dr
import torch
from rich.console import Console
from rich.table import Table
from torch.profiler import ProfilerActivity

import difftetvr as dtv
from difftetvr.capture.truth import Truth
from difftetvr.fitting import gradients
from difftetvr.fitting.parameters import FieldParameters
from difftetvr.fitting.positions import VertexOptimizer
from difftetvr.fitting.refinement import exchange_round
from difftetvr.fitting.refinement.iterate_mean import IterateMean
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
    "evaluation": (Trainer, "glance"),
    "means": (Trainer, "_even_out"),
    "adding to means": (IterateMean, "add"),
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


@dataclass(frozen=True)
class Profile:
    """What was measured of some cycles.

    Attributes:
        watch: Seconds of parts, of all cycles.
        iterations: Iterations of a cycle.
        cells: Cells of the mesh.
        kernels: Seconds of one more cycle in Dr.Jit's kernels.
        pytorch: Seconds of it in PyTorch's operations.
    """

    watch: Stopwatch
    iterations: float
    cells: int
    kernels: float
    pytorch: float


def profile(capture: dtv.Capture, cells: int, cycles: int) -> Profile:
    """Where the time of some cycles goes."""
    config = dtv.FitConfig(iterations=ITERATIONS, cells=cells)
    trainer = Trainer(capture, config)
    watch = Stopwatch()

    def run(refinements: int) -> int:
        first, goal = trainer.iteration, len(trainer.history.refinements) + refinements
        while len(trainer.history.refinements) < goal:
            trainer.step()
            if trainer.iteration % config.evaluate_every == 0:
                trainer.glance()
        return trainer.iteration - first

    run(2)
    with ExitStack() as stack:
        for name, (owner, attribute) in PARTS.items():
            stack.enter_context(patch.object(owner, attribute, watch.watch(name, getattr(owner, attribute))))
        watch.reset()
        iterations = run(cycles)
        watch._pass("")
    return Profile(watch, iterations / cycles, trainer.mesh.num_cells, *seconds_by_layer(lambda: run(1)))


def seconds_by_layer(work: Callable[[], Any]) -> tuple[float, float]:
    """Seconds in Dr.Jit's kernels, and in PyTorch's operations."""
    dr.kernel_history_clear()
    with (
        dr.scoped_set_flag(dr.JitFlag.KernelHistory, True),
        torch.profiler.profile(activities=[ProfilerActivity.CPU]) as log,
    ):
        work()
    kernels = sum(entry["execution_time"] for entry in dr.kernel_history()) / 1e3
    # Functions of one's own have events, too, in which kernels run.
    pytorch = sum(event.self_cpu_time_total for event in log.key_averages() if event.key.startswith("aten::"))
    return kernels, pytorch / 1e6


def table_of(found: Profile, size: int, cycles: int) -> Table:
    """Parts by their share, and below them the layers."""
    seconds = {name: total / cycles for name, total in found.watch.seconds.most_common()}
    whole = sum(seconds.values())
    title = f"{found.cells} cells, {size} x {size} pixels, per cycle of {found.iterations:g}"
    table = Table(title=title)
    for heading in ("part", "calls", "seconds", "ms a call", "share"):
        table.add_column(heading, justify="left" if heading == "part" else "right")
    for name, spent in seconds.items():
        calls = found.watch.calls[name] / cycles
        each = f"{1e3 * spent / calls:.2f}" if calls else ""
        table.add_row(name, f"{calls:g}", f"{spent:.2f}", each, f"{spent / whole:.0%}")
    table.add_row("all", "", f"{whole:.2f}", "", "100%", end_section=True)
    layers = {"kernels": found.kernels, "PyTorch": found.pytorch}
    for name, spent in (layers | {"Python": whole - sum(layers.values())}).items():
        table.add_row(name, "", f"{spent:.2f}", "", f"{spent / whole:.0%}")
    return table


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
            console.print(table_of(profile(capture, cells, arguments.cycles), size, arguments.cycles))


if __name__ == "__main__":
    main()
