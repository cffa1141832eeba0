"""The panel of a run: how far it has come, its curves, its pause, and how many cells its mesh may have."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from difftetvr.errors import counted
from difftetvr.fitting.records.result import Progress
from difftetvr.view.live.panels.desk import Desk

_FIRST = -1.0  # its place above all other panels
_TELL_SECONDS = 0.5
_MOST_POINTS = 1000  # of a curve; then every second one is left out
_LEAST_SHARE, _MOST_SHARE, _STEPS = 0.1, 5.0, 0.05  # of the budget at first, on the slider
_CURVES = (("training PSNR, dB", "#5a96f0"), ("held-out PSNR, dB", "#faa028"))


class RunPanel:
    """Shows a run, and takes what it is to do.

    Args:
        desk: What it works with.
        progress: Where the run stands.
    """

    def __init__(self, desk: Desk, progress: Progress) -> None:
        self._desk, gui = desk, desk.server.gui
        self._told, budget = -math.inf, progress.budget
        self._asked: int | None = None
        with gui.add_folder("Run", order=_FIRST):
            self._status = gui.add_markdown("")
            self._bar = gui.add_progress_bar(0.0)
            self._pause = gui.add_checkbox("Pause", False)
            if budget is not None:
                least, most, step = (max(1, round(share * budget)) for share in (_LEAST_SHARE, _MOST_SHARE, _STEPS))
                self._cells = gui.add_slider("Cells at most", min(least, budget), most, step, budget)
                self._cells.on_update(self._ask)
            self._training, self._held_out = (_Curve(desk, *look, progress.iterations) for look in _CURVES)

    @property
    def is_paused(self) -> bool:
        """Whether the run is to wait."""
        return bool(self._pause.value)

    def hold(self, is_paused: bool) -> None:
        """Has the run wait, or go on, as a hand would."""
        self._pause.value = is_paused

    def ask(self, cells: int) -> None:
        """Asks for another number of cells, as a hand would."""
        self._cells.value = cells
        self._asked = cells

    def take_budget(self) -> int | None:
        """How many cells the mesh is to have at most, if that has been changed; once."""
        asked, self._asked = self._asked, None
        return asked

    def refuse(self, sentence: str) -> None:
        """Says that what was asked for cannot be."""
        self._desk.complain(sentence)

    def tell(self, progress: Progress) -> None:
        """Shows where the run stands, now and then."""
        self._training.note(progress.iteration, progress.train_psnr)
        if progress.held_out_psnr is not None and progress.glanced_at is not None:
            self._held_out.note(progress.glanced_at, progress.held_out_psnr)
        now, is_last = time.monotonic(), progress.iteration == progress.iterations
        if now - self._told < _TELL_SECONDS and not (is_last or self.is_paused):
            return
        self._told = now
        held_out = "" if progress.held_out_psnr is None else f", held out {progress.held_out_psnr:.2f} dB"
        self._status.content = (
            f"Iteration {progress.iteration:,} of {progress.iterations:,}, {counted(progress.cells, 'cell')}  \n"
            f"training {progress.train_psnr:.2f} dB{held_out}, loss {progress.loss:.2e}"
        )
        self._bar.value = 100.0 * progress.iteration / max(1, progress.iterations)
        self._training.draw()
        self._held_out.draw()

    def _ask(self, event: Any) -> None:
        if event.client_id is not None:
            self._asked = int(self._cells.value)


class _Curve:
    """A curve over iterations, of so many points that it can be sent again and again.

    Args:
        desk: What it works with.
        label: What it shows.
        color: Of its line.
        iterations: How far it may go.
    """

    def __init__(self, desk: Desk, label: str, color: str, iterations: int) -> None:
        self._points: list[tuple[float, float]] = []
        self._plot = desk.server.gui.add_uplot(
            (np.zeros(1), np.zeros(1)),
            ({"label": "iteration"}, {"label": label, "stroke": color, "width": 1.5}),
            scales={"x": {"time": False, "range": (0.0, float(iterations))}},  # viser loses bounds that follow data
            aspect=2.2,
            visible=False,
        )

    def note(self, iteration: int, value: float) -> None:
        """Adds a point, unless the iteration has one or the value is none."""
        if math.isfinite(value) and (not self._points or iteration > self._points[-1][0]):
            self._points.append((float(iteration), value))
            if len(self._points) > _MOST_POINTS:
                self._points = self._points[1::2]

    def draw(self) -> None:
        """Brings what is seen up to date; a single point is no curve."""
        if len(self._points) > 1:
            self._plot.data = tuple(np.array(self._points).T.copy())
            self._plot.visible = True
