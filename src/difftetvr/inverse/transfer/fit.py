"""From images of a known scalar to the transfer function that made them."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any

import torch

from difftetvr.capture.capture import Capture
from difftetvr.capture.truth import BLACK, WHITE, Truth
from difftetvr.errors import CaptureError, FitError, MeshError, shown
from difftetvr.fitting.loop import iterate, optimising
from difftetvr.fitting.metrics import psnr_of_mse
from difftetvr.fitting.processes import ALONE
from difftetvr.fitting.records.checkpoint import Checkpoint, alone_with, describe_capture
from difftetvr.fitting.records.evaluation import Evaluation, compared
from difftetvr.fitting.records.history import History
from difftetvr.inputs import as_reals, require_type
from difftetvr.inverse.transfer.config import TransferConfig
from difftetvr.inverse.transfer.knots import Knots
from difftetvr.mesh.field import Location
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.rendering import ScalarField, render

_BEGUN = "begun."  # prefix of what a run began with, in a checkpoint


@dataclass(frozen=True)
class TransferProgress:
    """Where a fit stands.

    Attributes:
        iteration: Iterations done.
        iterations: Of all.
        loss: Loss of the last one.
        psnr: PSNR of its views in dB, over black.
        seconds: Since the beginning.
    """

    iteration: int
    iterations: int
    loss: float
    psnr: float
    seconds: float


@dataclass(frozen=True)
class TransferResult:
    """What was found.

    Attributes:
        field: The scalars through the function that was found; :func:`difftetvr.render` takes it.
        transfer_function: That function.
        start: The function that the search began with.
        training: PSNR and SSIM of the training views, over white where alpha is known, else over black.
        held_out: Those of the held-out views; without views where there are none.
        start_quality: Those of the training views at the beginning.
        losses: Loss of each iteration.
        seconds: How long they took.
    """

    field: ScalarField
    transfer_function: TransferFunction
    start: TransferFunction
    training: Evaluation
    held_out: Evaluation
    start_quality: Evaluation
    losses: list[float]
    seconds: float

    @property
    def metrics(self) -> dict[str, Any]:
        """Numbers as JSON values."""
        return {
            "training": self.training.to_json(),
            "held_out": self.held_out.to_json(),
            "start": self.start_quality.to_json(),
            "knots": len(self.transfer_function.scalar),
            "iterations": len(self.losses),
            "seconds": self.seconds,
            "loss": self.losses[-1] if self.losses else None,
        }


def fit_transfer(
    mesh: TetMesh,
    scalar: Any,
    capture: Capture,
    config: TransferConfig | None = None,
    *,
    location: Location | None = None,
    start: TransferFunction | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    on_progress: Callable[[TransferProgress], None] | None = None,
) -> TransferResult:
    """Finds the transfer function through which a known scalar looks as in images.

    Minimises the mean absolute difference of colours over black, and of opacities where they are known, by Adam over
    the values and the places of knots. The same arguments give the same function, also when the run was interrupted in
    between and resumed.

    Args:
        mesh: The mesh.
        scalar: (V,) or (T,) scalars.
        capture: Images with their cameras; those of ``capture.test`` are never fitted to.
        config: Options.
        location: Whether scalars are those of vertices or of cells; default: by their number.
        start: Function to begin with; default: random values.
        checkpoint: File to save the state to, every ``config.checkpoint_seconds``, at the end, and when interrupted.
        resume: Go on from ``checkpoint`` if it exists.
        on_progress: Called after every iteration.

    Returns:
        The function and how well it explains the images.

    Raises:
        MeshError: The scalars do not fit the mesh.
        CaptureError: The images show nothing of the mesh.
        FitError: The checkpoint cannot be used, or an argument is of the wrong kind.
        KeyboardInterrupt: The run was interrupted; the checkpoint is saved.
    """
    require_type(capture, Capture, "capture", "pass a difftetvr.Capture, such as of load_capture", FitError)
    require_type(config, (TransferConfig, NoneType), "config", "pass a TransferConfig", FitError)
    require_type(start, (TransferFunction, NoneType), "start", "pass a difftetvr.TransferFunction", FitError)
    require_type(checkpoint, (str, os.PathLike, NoneType), "checkpoint", "pass the name of a file", FitError)
    path = None if checkpoint is None else Path(checkpoint)
    with alone_with(path) if path is not None else contextlib.nullcontext():
        run = _Run(mesh, scalar, capture, config or TransferConfig(), location, start)
        if path is not None and resume and path.exists():
            run.resume(path)
        run.require_something_seen()
        with optimising():
            iterate(run, path, on_progress)
        return run.result()


class _Run:
    """A fit between two iterations."""

    processes = ALONE

    def __init__(
        self,
        mesh: Any,
        scalar: Any,
        capture: Capture,
        config: TransferConfig,
        location: Location | None,
        start: TransferFunction | None,
    ) -> None:
        require_type(mesh, TetMesh, "mesh", "pass a difftetvr.TetMesh", MeshError)
        self.mesh = mesh.with_vertices(mesh.vertices.detach())
        self.config = config
        values = as_reals(scalar, "The scalars", MeshError).detach().to(self.mesh.vertices)
        lower, upper = self.mesh.bounds()
        density = config.attenuation / float((upper - lower).max())
        known = ScalarField(values, TransferFunction.default(), density, config.value_range, location)
        known.location_on(self.mesh)
        low, high = known.value_range or (float(v) for v in torch.aminmax(values))
        if not low < high:
            raise MeshError(f"The scalar is {low:g} everywhere, so no transfer function can be told from it.")
        self.known = ScalarField(values, known.transfer_function, density, (low, high), location)
        self.capture = capture
        self.truth = Truth(capture, self.mesh.vertices.device)
        self.views: list[int] = capture.train_indices.tolist()
        self.truth.keep(self.views)
        self.knots = Knots(config, start)
        self.begun = {name: tensor.clone() for name, tensor in self.knots.state().items()}
        self.iteration, self.history = 0, History()

    def field(self, function: TransferFunction) -> ScalarField:
        known = self.known
        return ScalarField(known.scalar, function, known.attenuation, known.value_range, known.location)

    def require_something_seen(self) -> None:
        """Refuses images in which the mesh is not: nothing could be learned, and nobody would be told."""
        shown_everywhere = self.field(TransferFunction(torch.zeros(1), torch.ones(1), torch.ones(1, 3)))
        with torch.no_grad():
            for view in self.views:
                if float(render(self.mesh, shown_everywhere, self.truth.camera(view)).alpha.max()) > 0.0:
                    return
        raise CaptureError(
            f"No view of '{self.capture.name}' sees the mesh; its cameras must be in the coordinates of the scalars."
        )

    def step(self) -> None:
        """One iteration."""
        views = self.views_now()
        self.knots.zero_grad()
        total, squares = 0.0, 0.0
        function, hand_on = self.knots.opened()
        seen = self.field(function)
        for view in views:
            loss, error = self.view_loss(seen, view)
            (loss / len(views)).backward()
            total += float(loss.detach()) / len(views)
            squares += error / len(views)
        rest = self.config.smoothness * self.knots.roughness()
        hand_on(rest)
        total += float(rest.detach())
        if not total < float("inf"):
            raise FitError(f"The loss is {shown(total)} after {self.iteration} iterations; take a smaller rate.")
        self.knots.step(self.config.rate_at(self.iteration))
        self.iteration += 1
        self.history.loss.append(total)
        self.history.psnr.append(psnr_of_mse(squares))

    def glance(self) -> None:
        """Nothing: some dozen knots learn no single view by heart."""

    def progress(self, seconds: float, is_interrupted: Callable[[], bool]) -> TransferProgress:
        loss, psnr = self.history.loss[-1], self.history.psnr[-1]
        return TransferProgress(self.iteration, self.config.iterations, loss, psnr, seconds)

    def views_now(self) -> list[int]:
        count = self.config.batch_views
        if count == 0 or count >= len(self.views):
            return self.views
        random = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.iteration)
        return [self.views[k] for k in torch.randperm(len(self.views), generator=random)[:count].tolist()]

    def view_loss(self, field: ScalarField, view: int) -> tuple[torch.Tensor, float]:
        expected = self.truth.image(view, BLACK)
        image = render(self.mesh, field, self.truth.camera(view))
        color = self.truth.where_valid(view, image.color.to(expected.device), expected)
        share = self.truth.counted_share(view)
        loss = (color - expected).abs().mean() / share
        if self.capture.alphas is not None:
            # Over white, the difference of a colour is that over black less that of the opacity.
            behind = self.truth.image(view, WHITE)
            over_white = color + (1.0 - image.alpha.to(expected.device))[..., None]
            over_white = self.truth.where_valid(view, over_white, behind)
            loss = 0.5 * loss + 0.5 * (over_white - behind).abs().mean() / share
        error = float((color.detach() - expected).square().mean()) / float(share)
        return loss, error

    def checkpoint(self) -> Checkpoint:
        tensors = {**self.knots.state(), **{_BEGUN + name: tensor for name, tensor in self.begun.items()}}
        known = {"problem": self.problem}
        return Checkpoint(self.iteration, self.config, known, tensors, self.mesh.num_cells, "none", self.history)

    @functools.cached_property
    def problem(self) -> str:
        """What tells mesh, scalars and images from others: a SHA-256."""
        description = {k: v for k, v in describe_capture(self.capture).items() if not isinstance(v, float)}
        digest = hashlib.sha256(json.dumps(description).encode())
        for tensor in (self.mesh.vertices, self.mesh.tets, self.known.scalar):
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).numpy().data)
        return digest.hexdigest()

    def resume(self, path: Path) -> None:
        saved = Checkpoint.load(path, TransferConfig)
        saved.config.require_same_run(self.config)
        if saved.capture != {"problem": self.problem}:
            raise FitError(f"The run of {path} is of other scalars or images; resume with the same or start anew.")
        saved.require_tensors_like(self.checkpoint().tensors)
        self.knots.restore(saved.tensors)
        self.begun = {name: saved.tensors[_BEGUN + name] for name in self.begun}
        self.iteration, self.history = saved.iteration, saved.history

    def result(self) -> TransferResult:
        with torch.no_grad():
            function = self.knots.function()
            begun = Knots(self.config)
            begun.restore(self.begun)
            start = begun.function("start")
        behind = BLACK if self.capture.alphas is None else WHITE
        held_out = self.capture.test_indices.tolist()
        training, tested, before = (
            compared(self.mesh, self.field(shown), self.truth, views, behind)
            for shown, views in ((function, self.views), (function, held_out), (start, self.views))
        )
        return TransferResult(
            self.field(function), function, start, training, tested, before, self.history.loss, self.history.seconds
        )
