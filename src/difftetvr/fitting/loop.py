"""The optimisation loop: from images to colours, densities and vertices of a mesh that refines itself."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import NoneType
from typing import Any, Protocol

import torch

from difftetvr import memory
from difftetvr.capture.capture import Capture
from difftetvr.errors import FitError, shown
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.processes import ALONE, Processes
from difftetvr.fitting.records.checkpoint import Checkpoint, alone_with, require_no_folder
from difftetvr.fitting.records.history import History
from difftetvr.fitting.records.result import FitResult, Progress
from difftetvr.fitting.refinement import Strategy
from difftetvr.fitting.trainer import Trainer
from difftetvr.inputs import require_type
from difftetvr.interrupts import InterruptFlag
from difftetvr.mesh.tetmesh import TetMesh


def fit(
    capture: Capture,
    config: FitConfig | None = None,
    *,
    mesh: TetMesh | None = None,
    strategy: Strategy | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
    processes: Processes | None = None,
) -> FitResult:
    """Optimises colours, densities and vertices of a tetrahedral mesh so that its renderings match images.

    The same capture, options and machine give the same result, also when the run was killed in between and resumed.

    Args:
        capture: Cameras and images; those of ``capture.test`` are never trained on.
        config: Options; default: those of the Tooth benchmark.
        mesh: Mesh to begin with; default: that of ``config``, a file or one made for the capture.
        strategy: How the mesh is refined, for strategies of your own; default: as ``config.refine`` says.
        checkpoint: File to save the state to before the first iteration, every ``config.checkpoint_seconds``, after the
            last one, and when interrupted by SIGINT, SIGTERM or SIGHUP.
        resume: Go on from ``checkpoint`` if it exists; ``mesh`` is then the checkpoint's.
        on_progress: Called after every iteration.
        processes: Those that fit together, see `difftetvr.fitting.Processes`; each makes this call with the same
            arguments and gets the same result, the first saves the checkpoint. Default: this one alone.

    Returns:
        The mesh, its field and the metrics on the held-out views.

    Raises:
        CaptureError: The images do not allow what the options ask for.
        FitError: The checkpoint cannot be read, written, or is of another run or of one that is going on, the initial
            mesh does not suit the options or the images, the loss is not finite, or another process has ended or has
            come to another mesh.
        MeshError: The file of the initial mesh cannot be read or holds an invalid mesh, or the grid is too large.
        KeyboardInterrupt: The run was interrupted; the checkpoint is saved.
    """
    _require_kinds(capture, config, mesh, strategy, on_progress)
    require_type(processes, (Processes, NoneType), "processes", "pass what Processes.joined() gives", FitError)
    require_type(checkpoint, (str, os.PathLike, NoneType), "checkpoint", "pass the name of a file", FitError)
    path = Path(checkpoint) if checkpoint is not None else None
    processes = processes or ALONE
    with alone_with(path) if path is not None and processes.is_first else contextlib.nullcontext():
        trainer = prepare(
            capture,
            config or FitConfig(),
            mesh=mesh,
            strategy=strategy,
            resume_from=path if resume else None,
            processes=processes,
        )
        return optimise(trainer, path, on_progress)


def prepare(
    capture: Capture,
    config: FitConfig,
    *,
    mesh: TetMesh | None = None,
    strategy: Strategy | None = None,
    resume_from: Path | None = None,
    processes: Processes = ALONE,
) -> Trainer:
    """The first half of :func:`fit`: everything that can fail before the first iteration, without writing anything.

    Args:
        capture: Cameras and images.
        config: Options.
        mesh: Mesh to begin with; default: that of ``config``, a file or one made for the capture.
        strategy: How the mesh is refined; default: as ``config.refine`` says.
        resume_from: Checkpoint to go on from if it exists.
        processes: Those that fit together.

    Raises:
        CaptureError: The images do not allow what the options ask for.
        FitError: The checkpoint cannot be read or is of another run, the device does not exist, or the initial mesh
            does not suit the options or the images, or the processes do not begin with the same.
        MeshError: The file of the initial mesh cannot be read or holds an invalid mesh, or the grid is too large.
        BackendError: The device has no back end.
    """
    with processes.in_order():
        if resume_from is not None and resume_from.exists():
            trainer = Trainer.resume(capture, config, Checkpoint.load(resume_from), strategy, processes)
        else:
            trainer = Trainer(capture, config, mesh, strategy, processes)
    kind = trainer.mesh.vertices.device.type
    processes.require_same(
        kind,
        f"Not all of the {processes.count} processes have a device of the kind {kind}; start as many on each machine "
        "as it has GPUs, or give --device cpu.",
    )
    # Nothing is written before all have read what there was.
    trainer.require_agreement()
    return trainer


def optimise(
    trainer: Trainer, path: Path | None = None, on_progress: Callable[[Progress], None] | None = None
) -> FitResult:
    """The second half of :func:`fit`: iterates to the end and evaluates.

    Args:
        trainer: Where to begin.
        path: Checkpoint to write.
        on_progress: Called after every iteration.

    Raises:
        FitError: The checkpoint cannot be written, or the loss is not finite.
        KeyboardInterrupt: The run was interrupted; the checkpoint is saved.
    """
    with optimising():
        iterate(trainer, path, on_progress)
        tested: list[int] = trainer.capture.test_indices.tolist()
        trainer.align(tested)
        evaluation = trainer.evaluate(tested)
    return FitResult(trainer.mesh, trainer.field(), evaluation, trainer.history, trainer.config, trainer.cameras)


def _require_kinds(capture: object, config: object, mesh: object, strategy: object, on_progress: object) -> None:
    """Checks what callers of :func:`fit` pass, before anything is made of it."""
    require_type(capture, Capture, "capture", "pass a difftetvr.Capture, such as of load_capture", FitError)
    require_type(config, (FitConfig, NoneType), "config", "pass a difftetvr.FitConfig", FitError)
    require_type(mesh, (TetMesh, NoneType), "mesh", "pass a difftetvr.TetMesh", FitError)
    if strategy is not None and (isinstance(strategy, type) or not callable(getattr(strategy, "refine", None))):
        raise FitError(f"strategy is {shown(strategy)}; pass one that refines, such as Exchange().")
    if on_progress is not None and not callable(on_progress):
        raise FitError(f"on_progress is {shown(on_progress)}; pass a function.")


class Run(Protocol):
    """What iterates: a reconstruction of any kind, between two iterations."""

    config: Any  # a RunOptions
    history: History
    processes: Processes
    iteration: int

    def step(self) -> None:
        """One iteration."""

    def glance(self) -> None:
        """Notes how held-out views look, for the curves."""

    def progress(self, seconds: float, is_interrupted: Callable[[], bool]) -> Any:
        """A summary for a display, which may hold the run up until it is interrupted."""
        ...

    def checkpoint(self) -> Checkpoint:
        """The state, to be saved."""
        ...


def iterate(trainer: Run, path: Path | None, on_progress: Callable[[Any], None] | None) -> None:
    """Iterates to the end, with glances and checkpoints on the way.

    Args:
        trainer: Where to begin; its options say how far to go, how often to glance and to save.
        path: Checkpoint to write.
        on_progress: Called after every iteration, with what the run calls its progress.

    Raises:
        FitError: The checkpoint cannot be written, or what an iteration raises.
        KeyboardInterrupt: The run was interrupted; the checkpoint is saved.
    """
    config, history, processes = trainer.config, trainer.history, trainer.processes
    file = path if processes.is_first else None
    if file is not None and trainer.iteration < config.steps:
        # A full disk or a forbidden folder is found before the work, not with its result.
        require_no_folder(file)
        trainer.checkpoint().save(file)
    start = time.perf_counter() - history.seconds
    saved = time.perf_counter()
    with InterruptFlag(active=path is not None, patient=processes.count > 1) as interrupt:
        # A signal may reach one process in this iteration and another in the next.
        stopped = processes.any(interrupt.raised)
        while trainer.iteration < config.steps and not stopped:
            trainer.step()
            last = trainer.iteration == config.steps
            if config.evaluate_every and (trainer.iteration % config.evaluate_every == 0 or last):
                trainer.glance()
            history.seconds = time.perf_counter() - start
            if on_progress is not None:
                watched = time.perf_counter()
                on_progress(trainer.progress(history.seconds, lambda: interrupt.raised))
                start += time.perf_counter() - watched  # looking at a run, or holding it up, is no part of it
            due = time.perf_counter() - saved >= config.checkpoint_seconds
            if file is not None and (due or last):
                trainer.checkpoint().save(file)
                saved = time.perf_counter()
            stopped = processes.any(interrupt.raised)
        if stopped:
            if file is not None:
                trainer.checkpoint().save(file)
            # Once one process has left, who has started them may kill the others.
            processes.any(stopped)
            raise KeyboardInterrupt


@contextmanager
def optimising() -> Iterator[None]:
    """What every loop that optimises runs in: memory that is freed is kept, and the renderer has the cores."""
    with one_torch_thread(), memory.kept():
        yield


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Leaves the cores to the renderer.

    Torch's share of an iteration is many small operations. With several threads each of them waits for all cores,
    which the renderer's threads keep busy: on 2 busy cores that made an iteration 12 times longer. One thread also
    keeps the order of torch's sums.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
