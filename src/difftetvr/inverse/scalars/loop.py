"""``fit_scalar``: from images to the scalars behind a transfer function, on a mesh that moves and refines itself."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any

from difftetvr.capture.capture import Capture
from difftetvr.errors import FitError
from difftetvr.fitting.beginning.starting_mesh import starting_mesh
from difftetvr.fitting.loop import iterate, optimising
from difftetvr.fitting.records.checkpoint import Checkpoint, alone_with
from difftetvr.fitting.records.evaluation import Evaluation
from difftetvr.fitting.records.history import History
from difftetvr.fitting.records.result import Progress
from difftetvr.inputs import require_type
from difftetvr.inverse.scalars.beginning import beginning_by_colors
from difftetvr.inverse.scalars.config import ScalarConfig
from difftetvr.inverse.scalars.reconstruction import ScalarReconstruction
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.rendering import ScalarField


@dataclass(frozen=True)
class ScalarResult:
    """A finished reconstruction of scalars.

    Attributes:
        mesh: The tetrahedral mesh.
        field: Its scalars, in [0, 1], through the function; :func:`difftetvr.render` takes it.
        evaluation: Image quality on each held-out view.
        history: Loss and PSNR per iteration.
        config: Options that it was made with.
    """

    mesh: TetMesh
    field: ScalarField
    evaluation: Evaluation
    history: History
    config: ScalarConfig

    @property
    def transfer_function(self) -> TransferFunction:
        """The function, known or found."""
        return self.field.transfer_function

    @property
    def metrics(self) -> dict[str, Any]:
        """The numbers of the run as JSON values, as those of `FitResult`."""
        return {**self.evaluation.to_json(), **self.history.metrics(self.mesh)}


def fit_scalar(
    capture: Capture,
    transfer_function: TransferFunction | None = None,
    config: ScalarConfig | None = None,
    *,
    attenuation: float | None = None,
    mesh: TetMesh | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
) -> ScalarResult:
    """Finds the scalars on a tetrahedral mesh that look as in images through a transfer function.

    Scalars and vertices follow the squared error of some views at a time while cells go to where they explain most.
    With ``unknown="both"`` the function is found along with them. Then what looks right is determined but for one
    thing: scalars that a rising or falling function bends, behind the function that undoes it, make the same images.

    Args:
        capture: Cameras and images; those of ``capture.test`` are never learned from. Compared over black.
        transfer_function: The known function; with ``unknown="both"`` one that the search begins with, default: what
            the colours look like in the order of their densities.
        config: Options.
        attenuation: Density of opacity 1, per unit of length; default: the capture's.
        mesh: Mesh to begin with; default: a grid over the capture's bounds.
        checkpoint: File to save the state to, as for :func:`difftetvr.fit`.
        resume: Go on from ``checkpoint`` if it exists.
        on_progress: Called after every iteration.

    Returns:
        The mesh, its scalars, and how well held-out views are predicted.

    Raises:
        FitError: There is no function, it looks the same for all scalars, the checkpoint cannot be read, written, or is
            of another run, or the loss is not finite.
        MeshError: The mesh would be too large.
        KeyboardInterrupt: The run was interrupted; the checkpoint is saved.
    """
    require_type(capture, Capture, "capture", "pass a difftetvr.Capture, such as of load_capture", FitError)
    known = (TransferFunction, NoneType)
    require_type(transfer_function, known, "transfer_function", "pass a difftetvr.TransferFunction", FitError)
    require_type(config, (ScalarConfig, NoneType), "config", "pass a ScalarConfig", FitError)
    require_type(mesh, (TetMesh, NoneType), "mesh", "pass a difftetvr.TetMesh", FitError)
    require_type(checkpoint, (str, os.PathLike, NoneType), "checkpoint", "pass the name of a file", FitError)
    path = Path(checkpoint) if checkpoint is not None else None
    with alone_with(path) if path is not None else contextlib.nullcontext():
        images = ScalarImages(capture, transfer_function, attenuation)
        run = prepare(images, config or ScalarConfig(), mesh, path if resume else None, on_progress)
        return optimise(run, path, on_progress)


@dataclass(frozen=True)
class ScalarImages:
    """What scalars are looked for in.

    Attributes:
        capture: Cameras and images.
        function: The known transfer function, or where the search for it begins; None: nothing is known of it.
        attenuation: Density of opacity 1; None: the capture's.
    """

    capture: Capture
    function: TransferFunction | None
    attenuation: float | None = None


def prepare(
    images: ScalarImages,
    config: ScalarConfig,
    mesh: TetMesh | None = None,
    resume_from: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> ScalarReconstruction:
    """The first half of :func:`fit_scalar`: where it begins, for which colours and densities may be fitted.

    Args:
        images: What scalars are looked for in.
        config: Options.
        mesh: Mesh to begin with.
        resume_from: Checkpoint to go on from if it exists.
        on_progress: Called after every iteration of colours and densities.
    """
    capture, function = images.capture, images.function
    if function is None and config.unknown == "scalar":
        raise FitError("Scalars are looked for behind a known transfer function; give it, or look for both.")
    attenuation = capture.density_unit if images.attenuation is None else images.attenuation
    if resume_from is not None and resume_from.exists():
        saved = Checkpoint.load(resume_from, ScalarConfig)
        known = function or TransferFunction.default()
        return ScalarReconstruction.resume(capture, known, config, attenuation, saved)
    if config.color_steps:
        begin = beginning_by_colors(capture, function, attenuation, config, mesh, on_progress)
        return ScalarReconstruction(capture, begin.function, config, attenuation, begin.mesh, begin.scalars)
    options = config.of_field().for_capture(capture)
    start = mesh or starting_mesh(capture, options, config.strategy())
    return ScalarReconstruction(capture, function or TransferFunction.default(), config, attenuation, start)


def optimise(
    run: ScalarReconstruction, path: Path | None = None, on_progress: Callable[[Progress], None] | None = None
) -> ScalarResult:
    """The second half of :func:`fit_scalar`: iterates to the end and evaluates.

    Args:
        run: Where to begin.
        path: Checkpoint to write.
        on_progress: Called after every iteration.
    """
    with optimising():
        iterate(run, path, on_progress)
        evaluation = run.evaluate(run.capture.test_indices.tolist())
    return ScalarResult(run.mesh, run.field(), evaluation, run.history, run.config)
