"""``reconstruct``: from projections to the densities of a mesh that moves and refines itself."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any

from difftetvr.capture.projections.projection_capture import ProjectionCapture
from difftetvr.errors import FitError
from difftetvr.fitting.loop import iterate, optimising
from difftetvr.fitting.records.checkpoint import Checkpoint, alone_with
from difftetvr.fitting.records.history import History
from difftetvr.fitting.records.result import Progress
from difftetvr.inputs import require_type
from difftetvr.inverse.tomography.alignment import Alignment
from difftetvr.inverse.tomography.config import TomographyConfig
from difftetvr.inverse.tomography.reconstruction import Reconstruction
from difftetvr.inverse.tomography.scoring import ProjectionScore
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class TomographyResult:
    """A finished reconstruction from projections.

    Attributes:
        mesh: The tetrahedral mesh.
        field: Its densities, attenuations per unit of the scan's geometry, and no channels.
        score: How well held-out views are predicted.
        history: Loss and PSNR of line integrals per iteration.
        config: Options that it was made with.
        alignment: Corrections of the geometry.
    """

    mesh: TetMesh
    field: Field
    score: ProjectionScore
    history: History
    config: TomographyConfig
    alignment: Alignment

    @property
    def metrics(self) -> dict[str, Any]:
        """The numbers of the run, as JSON values."""
        return {
            **self.score.to_json(),
            **self.alignment.to_json(),
            **self.history.metrics(self.mesh),
        }


def reconstruct(
    capture: ProjectionCapture,
    config: TomographyConfig | None = None,
    *,
    mesh: TetMesh | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
    on_solve: Callable[[int], None] | None = None,
) -> TomographyResult:
    """Finds the densities of a tetrahedral mesh whose line integrals match projections.

    Densities and vertices follow the loss of some pixels at a time while cells go to where they explain most; in the
    end the vertices stay, and the densities are solved for with all pixels.

    Args:
        capture: The projections; views of ``capture.test`` are never learned from.
        config: Options; what they leave open is chosen for the scan.
        mesh: Mesh to begin with; default: a grid over the box to reconstruct.
        checkpoint: File to save the state to, as for :func:`difftetvr.fit`.
        resume: Go on from ``checkpoint`` if it exists.
        on_progress: Called after every iteration.
        on_solve: Called after every step of the solver in the end, with the number of steps done.

    Returns:
        The mesh, its densities, and how well held-out views are predicted.

    Raises:
        FitError: An option does not suit the scan, the checkpoint cannot be read, written, or is of another run, or
            the loss is not finite.
        MeshError: The mesh would be too large.
        KeyboardInterrupt: The run was interrupted; the checkpoint is saved.
    """
    require_type(capture, ProjectionCapture, "capture", "pass a ProjectionCapture, such as load gives", FitError)
    require_type(config, (TomographyConfig, NoneType), "config", "pass a TomographyConfig", FitError)
    require_type(mesh, (TetMesh, NoneType), "mesh", "pass a difftetvr.TetMesh", FitError)
    require_type(checkpoint, (str, os.PathLike, NoneType), "checkpoint", "pass the name of a file", FitError)
    path = Path(checkpoint) if checkpoint is not None else None
    with alone_with(path) if path is not None else contextlib.nullcontext():
        run = prepare(capture, config or TomographyConfig(), mesh, path if resume else None)
        return optimise(run, path, on_progress, on_solve)


def prepare(
    capture: ProjectionCapture, config: TomographyConfig, mesh: TetMesh | None = None, resume_from: Path | None = None
) -> Reconstruction:
    """The first half of :func:`reconstruct`: everything that can fail before the first iteration.

    Args:
        capture: The projections.
        config: Options.
        mesh: Mesh to begin with.
        resume_from: Checkpoint to go on from if it exists.
    """
    config = config.for_scan(capture)
    if resume_from is not None and resume_from.exists():
        return Reconstruction.resume(capture, config, Checkpoint.load(resume_from, TomographyConfig))
    return Reconstruction(capture, config, mesh)


def optimise(
    run: Reconstruction,
    path: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    on_solve: Callable[[int], None] | None = None,
) -> TomographyResult:
    """The second half of :func:`reconstruct`: iterates to the end, solves and evaluates.

    Args:
        run: Where to begin.
        path: Checkpoint to write.
        on_progress: Called after every iteration.
        on_solve: Called after every step of the solver.
    """
    with optimising():
        iterate(run, path, on_progress)
        if run.config.solve_steps:
            run.solve(on_solve)
        score = run.score(run.measurements.test)
    return TomographyResult(run.mesh, run.field(), score, run.history, run.config, run.alignment)
