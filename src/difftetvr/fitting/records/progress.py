"""Progress on the terminal: a live bar, or plain lines where the output is no terminal."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Column

from difftetvr import terminal
from difftetvr.errors import counted
from difftetvr.fitting.records.history import RefinementRecord
from difftetvr.fitting.records.result import Progress as Status

_LINE_SECONDS = 5.0
_BAR_WIDTH = 12


class ProgressDisplay:
    """Shows where a run stands, its last refinement, and the time left.

    A context manager to be passed as ``on_progress``.

    Args:
        console: Where to print; default: standard output.
    """

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or terminal.console()
        # Where both do not fit, the text is cut off, not the bar.
        bar = BarColumn(bar_width=_BAR_WIDTH, table_column=Column(min_width=_BAR_WIDTH, no_wrap=True))
        text = TextColumn("{task.fields[status]}", markup=False, table_column=Column(ratio=1, no_wrap=True))
        self._bar = Progress(bar, text, console=self._console) if self._console.is_terminal else None
        self._task = self._bar.add_task("", total=None, status="starting") if self._bar else None
        self._begin: tuple[float, int] | None = None
        self._line_due = 0.0
        self._refinements: int | None = None

    def __enter__(self) -> ProgressDisplay:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar:
            self._bar.stop()

    def __call__(self, status: Status) -> None:
        """Shows a new status."""
        now = time.monotonic()
        if self._begin is None:
            # The first iteration compiles kernels; the speed is that of those after it.
            self._begin = (now, status.iteration)
        elapsed, done = now - self._begin[0], status.iteration - self._begin[1]
        speed = done / elapsed if elapsed > 0 and done else None
        self._tell_refinement(status)
        if self._bar and self._task is not None:
            text = _describe(status, speed)
            self._bar.update(self._task, completed=status.iteration, total=status.iterations, status=text)
        elif now >= self._line_due or status.iteration == status.iterations:
            self._line_due = now + _LINE_SECONDS
            self._console.print(_describe(status, speed), highlight=False, soft_wrap=True)

    def _tell_refinement(self, status: Status) -> None:
        """A line of its own for every refinement, above the bar; not for those before a run was resumed."""
        is_new = self._refinements is not None and status.refinements > self._refinements
        self._refinements = status.refinements
        if is_new and status.last_refinement is not None:
            text = _describe_refinement(status.refinements, status.last_refinement)
            self._console.print(text, highlight=False, soft_wrap=True)


def _describe(status: Status, speed: float | None) -> str:
    """What matters most comes first: a narrow terminal cuts the end off."""
    held_out = f" (held out {status.held_out_psnr:.2f})" if status.held_out_psnr is not None else ""
    parts = [f"{status.iteration}/{status.iterations}"]
    if speed is not None:
        parts.append(f"{_clock((status.iterations - status.iteration) / speed)} left")
    parts += [f"PSNR {status.train_psnr:.2f} dB{held_out}", counted(status.cells, "cell")]
    if status.moves.steps:
        parts.append(f"{counted(status.moves.refused, 'move')} refused")
    parts.append(f"loss {status.loss:.2e}")
    if speed is not None:
        parts.append(f"{speed:.1f} it/s")
    return "  ".join(parts)


def _describe_refinement(count: int, last: RefinementRecord) -> str:
    predicted = "-" if last.predicted is None else f"{last.predicted:.1e}"
    changes = f"-{last.removed} +{last.added} vertices, {counted(last.flipped, 'flip')}"
    return f"  refinement {count}: {changes}, gain {last.achieved:.1e} (predicted {predicted})"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
