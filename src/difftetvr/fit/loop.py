"""The optimisation loop: from images to colours and densities on a tetrahedral mesh."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from difftetvr.backend import default_device, get_backend
from difftetvr.capture.capture import Capture
from difftetvr.errors import CaptureError
from difftetvr.fit.checkpoint import (
    Checkpoint,
    History,
    describe_capture,
    require_no_folder,
    require_same_capture,
)
from difftetvr.fit.config import FitConfig, grid_cubes
from difftetvr.fit.errors import FitError
from difftetvr.fit.evaluation import evaluate, true_image
from difftetvr.fit.interrupt import InterruptFlag
from difftetvr.fit.losses import LOSSES
from difftetvr.fit.metrics import psnr_of_mse
from difftetvr.fit.parameters import FieldParameters
from difftetvr.fit.result import FitResult, Progress
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.render import render

_GLANCE_VIEWS = 4


class Trainer:
    """A reconstruction between two iterations; its state alone decides how it goes on.

    Attributes:
        capture: Images and cameras.
        config: Options.
        mesh: The mesh, on the device that everything runs on.
        parameters: Colours and densities under optimisation.
        iteration: Iterations done.
        history: Losses, PSNR and time so far.
    """

    def __init__(self, capture: Capture, config: FitConfig, mesh: TetMesh | None = None) -> None:
        """Prepares the first iteration on ``mesh``, by default the grid that the options ask for.

        Raises:
            CaptureError: The background needs alpha that the capture lacks.
            FitError: The device does not exist.
        """
        require_fittable(capture, config)
        self.capture = capture
        self.config = config
        self.mesh = (mesh or build_grid(capture, config)).to(device=resolve_device(config.device))
        self.parameters = FieldParameters(self.mesh, config, capture.density_unit)
        self.iteration = 0
        self.history = History()
        self._train_views: list[int] = capture.train_indices.tolist()
        self._capture_description = describe_capture(capture)

    def step(self) -> None:
        """One iteration: renders its views, accumulates their gradients, moves the parameters.

        Raises:
            FitError: The loss is not finite.
        """
        self.parameters.zero_grad()
        batch = self.config.views_at(self.iteration, len(self._train_views))
        background = self.config.background_at(self.iteration)
        losses, errors = [], []
        for position in batch:
            loss, error = self._accumulate(self._train_views[position], background, 1.0 / len(batch))
            losses.append(loss)
            errors.append(error)
        if not all(math.isfinite(loss) for loss in losses):
            raise FitError(
                f"The loss of iteration {self.iteration} is not finite; check the images or lower the learning rate."
            )
        self.parameters.step(self.config.rate_at(self.iteration), self.config.haze_penalty)
        self.history.loss.append(sum(losses) / len(losses))
        self.history.psnr.append(psnr_of_mse(sum(errors) / len(errors)))
        self.iteration += 1

    def glance(self) -> None:
        """Notes the mean PSNR over a few held-out views, for the curves; decides nothing."""
        tested = self.capture.test_indices.tolist()
        views = tested[:: max(1, math.ceil(len(tested) / _GLANCE_VIEWS))]
        seen = evaluate(
            self.mesh, self.parameters.detached_field(), self.capture, views, self.config.evaluation_background()
        ).mean_psnr
        if seen is not None:
            self.history.evaluations.append((self.iteration, seen))

    def checkpoint(self) -> Checkpoint:
        """The state, to be saved."""
        mesh = {"vertices": self.mesh.vertices, "tets": self.mesh.tets}
        tensors = mesh | self.parameters.state()
        return Checkpoint(self.iteration, self.config, self._capture_description, tensors, self.history)

    @staticmethod
    def resume(capture: Capture, config: FitConfig, checkpoint: Checkpoint) -> Trainer:
        """Goes on from a checkpoint.

        Raises:
            FitError: The checkpoint is of a run with other options or images, or lacks something.
        """
        checkpoint.config.require_same_run(config)
        trainer = Trainer(capture, config, checkpoint.mesh())
        require_same_capture(checkpoint.capture, trainer._capture_description)
        checkpoint.require_tensors_like(trainer.checkpoint().tensors)
        trainer.parameters.restore(checkpoint.tensors)
        trainer.iteration = checkpoint.iteration
        trainer.history = checkpoint.history
        return trainer

    def progress(self, seconds: float) -> Progress:
        """A summary for a display; loss and PSNR are means over the last pass through the training views."""
        window = max(1, len(self._train_views) // self.config.batch_views)
        losses, psnrs = self.history.loss[-window:], self.history.psnr[-window:]
        return Progress(
            iteration=self.iteration,
            iterations=self.config.iterations,
            loss=sum(losses) / max(1, len(losses)),
            train_psnr=sum(psnrs) / max(1, len(psnrs)),
            held_out_psnr=self.history.evaluations[-1][1] if self.history.evaluations else None,
            cells=self.mesh.num_cells,
            seconds=seconds,
        )

    def _accumulate(self, view: int, background: tuple[float, float, float], weight: float) -> tuple[float, float]:
        """Adds a view's gradient; returns its loss and mean squared error."""
        device = self.mesh.vertices.device
        truth = true_image(self.capture, view, background).to(device)
        behind = torch.tensor(background, device=device)
        image = render(
            self.mesh,
            self.parameters.field(),
            self.capture.cameras[view],
            background=behind,
            deterministic=self.config.deterministic,
        ).color
        loss = LOSSES[self.config.loss](image, truth)
        (weight * loss).backward()
        return float(loss.detach()), float((image.detach() - truth).square().mean())


def fit(
    capture: Capture,
    config: FitConfig | None = None,
    *,
    mesh: TetMesh | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
) -> FitResult:
    """Optimises colours and densities on a fixed tetrahedral mesh so that its renderings match images.

    The same capture, options and machine give the same result, also when the run was killed in between and resumed.

    Args:
        capture: Cameras and images; those of ``capture.test`` are never trained on.
        config: Options; default: those of the Tooth benchmark.
        mesh: Mesh to put the field on; default: the grid of ``config`` over ``capture.bounds``.
        checkpoint: File to save the state to before the first iteration, every ``config.checkpoint_seconds``, after the
            last one, and when interrupted by SIGINT or SIGTERM.
        resume: Go on from ``checkpoint`` if it exists; ``mesh`` is then the checkpoint's.
        on_progress: Called after every iteration.

    Returns:
        The mesh, its field and the metrics on the held-out views.

    Raises:
        CaptureError: The images do not allow what the options ask for.
        FitError: The checkpoint cannot be read, written, or is of another run, or the loss is not finite.
        KeyboardInterrupt: The run was interrupted; the checkpoint is saved.
    """
    path = Path(checkpoint) if checkpoint is not None else None
    trainer = prepare(capture, config or FitConfig(), mesh=mesh, resume_from=path if resume else None)
    return optimise(trainer, path, on_progress)


def prepare(
    capture: Capture, config: FitConfig, *, mesh: TetMesh | None = None, resume_from: Path | None = None
) -> Trainer:
    """The first half of :func:`fit`: everything that can fail before the first iteration, without writing anything.

    Args:
        capture: Cameras and images.
        config: Options.
        mesh: Mesh to put the field on; default: the grid of ``config``.
        resume_from: Checkpoint to go on from if it exists.

    Raises:
        CaptureError: The images do not allow what the options ask for.
        FitError: The checkpoint cannot be read or is of another run, or the device does not exist.
        MeshError: The grid is too large.
        BackendError: The device has no back end.
    """
    if resume_from is not None and resume_from.exists():
        return Trainer.resume(capture, config, Checkpoint.load(resume_from))
    return Trainer(capture, config, mesh)


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
    capture, config = trainer.capture, trainer.config
    held_out = capture.test_indices.tolist()
    with _one_torch_thread():
        _run(trainer, path, on_progress)
        field = trainer.parameters.detached_field()
        evaluation = evaluate(trainer.mesh, field, capture, held_out, config.evaluation_background())
    return FitResult(trainer.mesh, field, evaluation, trainer.history, config)


def require_fittable(capture: Capture, config: FitConfig) -> None:
    """Checks what can be known before the first iteration.

    Raises:
        CaptureError: The images have no alpha but the background needs it.
        FitError: The device does not exist.
        BackendError: No back end works, or the device has none.
    """
    if config.needs_alpha and capture.alphas is None:
        raise CaptureError(
            f"The images of '{capture.name}' have no alpha, which the background {config.background} needs; "
            "use background black."
        )
    resolve_device(config.device)


def build_grid(capture: Capture, config: FitConfig) -> TetMesh:
    """The Kuhn grid over the capture's bounds that the options ask for."""
    lower, upper = capture.bounds.tolist()
    extent = [b - a for a, b in zip(lower, upper, strict=True)]
    return TetMesh.grid(config.grid or grid_cubes(config.cells, extent), lower, upper)


def _run(trainer: Trainer, path: Path | None, on_progress: Callable[[Progress], None] | None) -> None:
    """Iterates to the end, with glances and checkpoints on the way."""
    config, history = trainer.config, trainer.history
    if path is not None and trainer.iteration < config.iterations:
        # A full disk or a forbidden folder is found before the work, not with its result.
        require_no_folder(path)
        trainer.checkpoint().save(path)
    start = time.perf_counter() - history.seconds
    saved = time.perf_counter()
    with InterruptFlag(active=path is not None) as interrupt:
        while trainer.iteration < config.iterations and not interrupt.raised:
            trainer.step()
            last = trainer.iteration == config.iterations
            if config.evaluate_every and (trainer.iteration % config.evaluate_every == 0 or last):
                trainer.glance()
            history.seconds = time.perf_counter() - start
            if on_progress is not None:
                on_progress(trainer.progress(history.seconds))
            due = time.perf_counter() - saved >= config.checkpoint_seconds
            if path is not None and (due or last):
                trainer.checkpoint().save(path)
                saved = time.perf_counter()
        if interrupt.raised and path is not None:
            trainer.checkpoint().save(path)
            raise KeyboardInterrupt


@contextmanager
def _one_torch_thread() -> Iterator[None]:
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


def resolve_device(name: str | None) -> torch.device:
    """The device of that name, the best that works for None.

    Raises:
        FitError: There is no such device here.
        BackendError: It has no back end, or its back end does not work.
    """
    if name is None:
        return default_device()
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise FitError(f"The device '{name}' cannot be used ({reason}); use cpu, cuda or mps.") from error
    get_backend(name)
    return device
