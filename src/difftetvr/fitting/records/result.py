"""What a reconstruction reports, during and after."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from difftetvr.fitting.cameras.refined import RefinedCameras
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.records.evaluation import Evaluation
from difftetvr.fitting.records.history import History, MoveTotals, RefinementRecord
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import ScalarField


@dataclass(frozen=True)
class Picture:
    """A view as it is predicted and as it should be, to be looked at.

    Attributes:
        view: Its index in the capture.
        rendered: (H, W, 3) what the reconstruction looks like, on the CPU; of projections the line integrals in grey,
            1 where they are as great as the greatest of the scan.
        truth: (H, W, 3) what was seen. Pixels that do not count are the same in both.
    """

    view: int
    rendered: torch.Tensor
    truth: torch.Tensor


class Reconstruction(Protocol):
    """What is reconstructed, between two iterations.

    Attributes:
        budget: Cells that the mesh may have.
        strategy: How it is refined; None: not at all.
    """

    budget: int
    strategy: Any

    @property
    def mesh(self) -> TetMesh:
        """The mesh as it is now, detached."""
        ...

    def field(self) -> Field | ScalarField:
        """What is on it now, detached."""
        ...

    def picture(self, view: int | None = None) -> Picture:
        """A view as it looks now; default: the last one that was learned from."""
        ...

    def steer(self, budget: int) -> None:
        """Sets how many cells the mesh may have from the next refinement on."""
        ...


def _never() -> bool:
    return False


@dataclass(frozen=True)
class Progress:
    """Where a running reconstruction stands.

    Mesh, field and pictures are made when they are asked for, and are what they are then: ask while ``on_progress`` is
    called, and keep the answers, not this.

    Whoever is called may hold the run up, as long as ``is_interrupted`` says no, and may :meth:`steer` it. A run that
    nobody steers is the same whoever watches it.

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
        glanced_views: Held-out views that are looked at from time to time.
        glanced_at: Iterations done when they were looked at last; None before the first time.
        reconstruction: What mesh, field and pictures are asked of.
        is_interrupted: Tells whether the run has been asked to stop, by a signal; who holds it up, lets it go then.
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
    glanced_views: list[int]
    glanced_at: int | None
    reconstruction: Reconstruction = dataclasses.field(repr=False, compare=False)
    is_interrupted: Callable[[], bool] = dataclasses.field(default=_never, repr=False, compare=False)

    @property
    def mesh(self) -> TetMesh:
        """The mesh as it is now, detached."""
        return self.reconstruction.mesh

    @property
    def budget(self) -> int | None:
        """Cells that the mesh may have; None where it is not refined."""
        return self.reconstruction.budget if self.reconstruction.strategy is not None else None

    @property
    def field(self) -> Field | ScalarField:
        """Its colours and densities, or its scalars, as they are now, detached."""
        return self.reconstruction.field()

    def picture(self, view: int | None = None) -> Picture:
        """Renders a view of the capture as it looks now.

        Args:
            view: Its index; default: the last one that was learned from.
        """
        return self.reconstruction.picture(view)

    def steer(self, budget: int) -> None:
        """Sets how many cells the mesh may have from the next refinement on; the history and checkpoints keep it.

        Args:
            budget: Cells, at least 1.

        Raises:
            FitError: It is no such number, the mesh is not refined, or several processes share the run.
        """
        self.reconstruction.steer(budget)


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
