"""What a reconstruction reports, during and after."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from difftetvr.fitting.cameras.refined import RefinedCameras
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.records.evaluation import Evaluation
from difftetvr.fitting.records.history import History, MoveTotals, RefinementRecord
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class Progress:
    """Where a running reconstruction stands.

    Attributes:
        iteration: Iterations done.
        iterations: Iterations in all.
        loss: Mean loss over the last pass through the training views.
        train_psnr: Mean PSNR in dB over the same.
        held_out_psnr: PSNR in dB at the last glance at a few held-out views; None before the first.
        cells: Tetrahedra.
        moves: What became of the moves of vertices so far.
        refinements: Refinements so far.
        last_refinement: The last one; None before the first.
        seconds: Time spent so far, over all sessions.
    """

    iteration: int
    iterations: int
    loss: float
    train_psnr: float
    held_out_psnr: float | None
    cells: int
    moves: MoveTotals
    refinements: int
    last_refinement: RefinementRecord | None
    seconds: float


@dataclass(frozen=True)
class FitResult:
    """A finished reconstruction.

    Attributes:
        mesh: The tetrahedral mesh.
        field: Its colours and densities, detached.
        evaluation: Image quality on each held-out view.
        history: Loss and PSNR per iteration.
        config: Options that it was made with.
        refined: Cameras as they were found, ``refined.cameras()``, where they were unknown; else None.
    """

    mesh: TetMesh
    field: Field
    evaluation: Evaluation
    history: History
    config: FitConfig
    refined: RefinedCameras | None = None

    @property
    def metrics(self) -> dict[str, Any]:
        """The numbers of the run, as JSON values.

        ``psnr`` and ``ssim`` are means over the held-out views (None if there are none), ``psnr_per_view`` and
        ``ssim_per_view`` belong to ``views``, ``train_psnr`` is the mean over the views of the last 64
        iterations, ``seconds`` the time of the optimisation. ``moves`` and ``refinements`` are those of the history.
        """
        return {
            **self.evaluation.to_json(),
            **self.history.metrics(self.mesh),
            **({} if self.refined is None else {"cameras": self.refined.summary()}),
        }
