"""What a device knows of the latest iterations, and the history does not know yet."""

from __future__ import annotations

import math
from dataclasses import astuple

import torch

from difftetvr.errors import FitError
from difftetvr.fitting.metrics import psnr_of_mse
from difftetvr.fitting.records.history import History, MoveTotals


class Unread:
    """Losses, errors and moves of vertices on a device: reading them one by one, the host would wait for each."""

    def __init__(self) -> None:
        """Nothing is unread yet."""
        self._iterations: list[int] = []
        self._errors: list[torch.Tensor] = []
        self._moves: torch.Tensor | None = None

    def add(self, iteration: int, loss: torch.Tensor, error: torch.Tensor) -> None:
        """Take note of an iteration.

        Args:
            iteration: Iterations done before it.
            loss: Its loss, a float64 scalar.
            error: The mean squared error of its views, likewise.
        """
        self._iterations.append(iteration)
        self._errors.append(torch.stack((loss, error)))

    def add_moves(self, counts: torch.Tensor) -> None:
        """Take note of one step of vertices: (4,) int64, in the order of :class:`~difftetvr.fitting.StepReport`."""
        counts = torch.nn.functional.pad(counts, (1, 0), value=1)
        self._moves = counts if self._moves is None else self._moves + counts

    def read_errors(self, history: History) -> None:
        """Complete a history with losses and PSNR.

        Raises:
            FitError: A loss is not finite.
        """
        if not self._errors:
            return
        rows = torch.stack(self._errors).tolist()
        iterations = self._iterations
        self._iterations, self._errors = [], []
        for iteration, (loss, error) in zip(iterations, rows, strict=True):
            if not math.isfinite(loss):
                raise FitError(
                    f"The loss of iteration {iteration} is not finite; check the images or lower the learning rate."
                )
            history.loss.append(loss)
            history.psnr.append(psnr_of_mse(error))

    def read_moves(self, history: History) -> None:
        """Complete a history with moves of vertices."""
        if self._moves is not None:
            read = self._moves.tolist()
            self._moves = None
            history.moves = MoveTotals(*(a + b for a, b in zip(astuple(history.moves), read, strict=True)))
