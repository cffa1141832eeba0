"""TensorBoard: curves, held-out pictures and the quality of cells of a run, while it goes on."""

from __future__ import annotations

import contextlib
import importlib.util
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import torch

from difftetvr.errors import FitError
from difftetvr.files import require_writable_folder
from difftetvr.fitting.records.result import Picture, Progress

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

_EVERY = 10


class TensorBoardLogger:
    """Writes what TensorBoard shows of a run; a context manager to be passed as ``on_progress``.

    Curves get a point every ten iterations. Whenever the run has looked at held-out views, and in the end, their PSNR,
    their pictures (the truth on the left) and a histogram of the quality of the cells follow; without held-out views
    the picture is that of the last view. A run that goes on from a checkpoint replaces what was written beyond it.
    Where nothing can be written any more, such as on a full disk, a warning says so and the run goes on without.

    Args:
        folder: Where to write; created where there is none. ``tensorboard --logdir FOLDER`` shows it.

    Raises:
        FitError: TensorBoard is not installed, or nothing can be written into the folder.
    """

    def __init__(self, folder: str | Path) -> None:
        require_tensorboard()
        self._folder = Path(folder)
        self._writer: SummaryWriter | None = None
        self._glanced_at: int | None = None
        self._refinements: int | None = None
        self._has_failed = False
        require_writable_folder(self._folder, FitError)

    def __enter__(self) -> TensorBoardLogger:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None and not self._has_failed:
            with self._warning():
                self._writer.close()

    def __call__(self, progress: Progress) -> None:
        """Writes what is new."""
        if not self._has_failed:
            with self._warning():
                self._write(progress)

    @contextlib.contextmanager
    def _warning(self) -> Iterator[None]:
        """Context for writing, which logs may fail to, but not a run."""
        try:
            yield
        except OSError as error:
            self._has_failed = True
            warnings.warn(
                LogWarning(
                    f"Logs cannot be written into {self._folder} any more ({error.strerror}); the run goes on without."
                ),
                stacklevel=3,
            )

    def _write(self, progress: Progress) -> None:
        at = progress.iteration
        if self._writer is None:
            from torch.utils.tensorboard import SummaryWriter  # late: the package takes a second

            self._writer = SummaryWriter(str(self._folder), purge_step=at)
        is_last = at == progress.iterations
        if at % _EVERY == 0 or is_last:
            self._add_curves(self._writer, progress)
        if progress.refinements != self._refinements:
            self._add_refinement(self._writer, progress)
        if progress.glanced_at not in (None, self._glanced_at) or is_last:
            self._add_pictures(self._writer, progress)
        self._glanced_at, self._refinements = progress.glanced_at, progress.refinements

    @staticmethod
    def _add_curves(writer: SummaryWriter, progress: Progress) -> None:
        moves = progress.moves
        curves = {
            "train/loss": progress.loss,
            "train/psnr": progress.train_psnr,
            "mesh/cells": progress.cells,
            "moves/refused": moves.refused / max(1, moves.moved + moves.refused),
            "time/seconds": progress.seconds,
        }
        for name, value in curves.items():
            writer.add_scalar(name, value, progress.iteration)

    def _add_refinement(self, writer: SummaryWriter, progress: Progress) -> None:
        last = progress.last_refinement
        if last is None or self._refinements is None:
            return  # none yet, or one of before the run was resumed
        writer.add_scalar("refinement/achieved", last.achieved, last.iteration)
        if last.predicted is not None:
            writer.add_scalar("refinement/predicted", last.predicted, last.iteration)

    @staticmethod
    def _add_pictures(writer: SummaryWriter, progress: Progress) -> None:
        at = progress.iteration
        if progress.held_out_psnr is not None:
            writer.add_scalar("held_out/psnr", progress.held_out_psnr, at)
        for view in progress.glanced_views:
            writer.add_image(f"held_out/view_{view}", _sheet(progress.picture(view)), at)
        if not progress.glanced_views:
            writer.add_image("train/last_view", _sheet(progress.picture()), at)
        writer.add_histogram("mesh/quality", progress.mesh.quality().cpu(), at)


def require_tensorboard() -> None:
    """Checks that the package is there, before anything else is done.

    Raises:
        FitError: It is not.
    """
    if importlib.util.find_spec("tensorboard") is None:
        raise FitError("Logs are written by tensorboard, which is not installed; pip install 'difftetvr[tensorboard]'.")


class LogWarning(UserWarning):
    """Logs of a run that goes on end."""


def _sheet(picture: Picture) -> torch.Tensor:
    """(3, H, 2 W) truth and reconstruction beside each other."""
    return torch.cat((picture.truth, picture.rendered), 1).clamp(0.0, 1.0).permute(2, 0, 1)
