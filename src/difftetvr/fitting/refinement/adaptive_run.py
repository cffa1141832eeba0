"""What runs of any kind share whose mesh moves and refines itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

from difftetvr.capture.free_space import FreeSpace
from difftetvr.errors import FitError
from difftetvr.fitting.positions import VertexOptimizer
from difftetvr.fitting.processes import Processes
from difftetvr.fitting.records.checkpoint import Checkpoint
from difftetvr.fitting.records.history import History, RefinementRecord
from difftetvr.fitting.records.result import Picture, Progress
from difftetvr.fitting.records.unread import Unread
from difftetvr.fitting.refinement.exchange import Exchange
from difftetvr.fitting.refinement.strategy import (
    USUAL_VIEWS,
    EmptySpace,
    Model,
    Moment,
    Refinement,
    Situation,
    Strategy,
)
from difftetvr.inputs import as_whole
from difftetvr.mesh.changes.change import MeshChange
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import ScalarField

_GLANCE_VIEWS = 4
_USUAL_PIXELS = 12.0  # a third of those views: what a view sees beside the others is worth more than all that it sees
_POSITIONS = "positions."  # prefix of the positions' state in a checkpoint


class AdaptiveRun:
    """A run between two iterations, as far as it is about the mesh; subclasses make it and say what is learned.

    Attributes:
        config: Options, a `difftetvr.fitting.options.Schedule`.
        strategy: How the mesh is refined; None: not at all.
        budget: Cells that the mesh may have.
        positions: Vertex positions under optimisation; None where they are fixed.
        iteration: Iterations done.
        history: What happened so far.
        processes: Those that share the run.
    """

    config: Any
    strategy: Strategy | None
    budget: int
    positions: VertexOptimizer | None
    iteration: int
    history: History
    processes: Processes
    _mesh: TetMesh
    _unread: Unread
    _train_views: list[int]
    _test_views: list[int]

    @property
    def mesh(self) -> TetMesh:
        """The mesh as it is now, detached."""
        mesh = self.positions.mesh if self.positions else self._mesh
        return mesh.with_vertices(mesh.vertices.detach())

    def progress(self, seconds: float, is_interrupted: Callable[[], bool]) -> Progress:
        """A summary for a display; loss and PSNR are means over the last pass through the training views."""
        window, history = self._epoch, self.history
        losses, psnrs = history.loss[-window:], history.psnr[-window:]
        return Progress(
            iteration=self.iteration,
            iterations=self.config.steps,
            loss=sum(losses) / max(1, len(losses)),
            train_psnr=sum(psnrs) / max(1, len(psnrs)),
            held_out_psnr=history.evaluations[-1][1] if history.evaluations else None,
            cells=self.mesh.num_cells,
            moves=history.moves,
            refinements=len(history.refinements),
            last_refinement=history.refinements[-1] if history.refinements else None,
            seconds=seconds,
            glanced_views=self._glanced_views(),
            glanced_at=history.evaluations[-1][0] if history.evaluations else None,
            reconstruction=self,
            is_interrupted=is_interrupted,
        )

    def steer(self, budget: int) -> None:
        """Sets how many cells the mesh may have from the next refinement on, see `difftetvr.fitting.Progress.steer`.

        Raises:
            FitError: It is no number of cells, the mesh is not refined, or several processes share the run.
        """
        cells = as_whole(budget, "The number of cells", FitError)
        if cells < 1:
            raise FitError(f"The number of cells is {cells}; it must be at least 1.")
        if self.strategy is None:
            raise FitError("This run refines no mesh, so it keeps its number of cells; run it with --refine exchange.")
        if self.processes.count > 1:
            raise FitError("Several processes share this run, so it keeps its number of cells; run it in one.")
        if cells != self.budget:
            self.budget = cells
            self.history.budgets.append((self.iteration, cells))

    def field(self) -> Field | ScalarField:
        """What is on the mesh as it is now, detached."""
        raise NotImplementedError

    def picture(self, view: int | None = None) -> Picture:
        """A view as it looks now, see `difftetvr.fitting.Progress.picture`.

        Raises:
            FitError: There is no such view.
        """
        count = len(self._train_views) + len(self._test_views)
        if view is None:
            last = self.config.views_at(max(0, self.iteration - 1), len(self._train_views))
            view = self._train_views[last[-1]]
        elif not 0 <= view < count:
            raise FitError(f"There is no view {view}; name one of 0 to {count - 1}.")
        rendered, truth = self._seen_and_true(view)
        return Picture(view, rendered.cpu(), truth.cpu())

    def _seen_and_true(self, view: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Both (H, W, 3), see `Picture`."""
        raise NotImplementedError

    @property
    def _epoch(self) -> int:
        """Iterations of one pass over the training views."""
        return max(1, len(self._train_views) // self.config.batch)

    def _glanced_views(self) -> list[int]:
        """A few held-out views, evenly spread."""
        return self._test_views[:: max(1, math.ceil(len(self._test_views) / _GLANCE_VIEWS))]

    @property
    def _judged_views(self) -> int:
        """Training views that a refinement is judged on."""
        return (None if self.strategy is None else self.strategy.views) or USUAL_VIEWS

    @property
    def _judged_pixels(self) -> float:
        """As many of their pixels, at most, as so many views have; other strategies than these get all."""
        return self.strategy.pixels or _USUAL_PIXELS if isinstance(self.strategy, Exchange) else math.inf

    def _moment(self) -> Moment:
        return Moment(self.iteration, self.config.steps, self._epoch, self.mesh.num_cells, self.budget)

    def _moving_mesh(self, rate: float | None) -> TetMesh:
        """The mesh of an iteration, whose vertices gather gradients where they move at all."""
        return self.positions.mesh if self.positions and rate is not None else self.mesh

    def _motion_rate(self) -> float | None:
        """Rate of the vertices' steps, None where they stay."""
        held = self.strategy is not None and not self.strategy.lets_move(self._moment())
        return None if held else self.config.motion_rate_at(self.iteration)

    def _move(self, rate: float | None) -> None:
        if self.positions is None:
            return
        if rate is None:
            self.positions.zero_grad()
        elif (self.iteration + 1) % self.config.motion.every == 0:
            self._unread.add_moves(self.positions.advance(rate))

    def _adopt(self, change: MeshChange) -> None:
        """Follows a change of the mesh's cells."""
        if self.positions:
            self.positions.carry(change)
        self._mesh = change.mesh

    def glance(self) -> None:
        """Notes how a few held-out views look, for the curves; decides nothing."""
        views = self._glanced_views()
        seen = self._mean_psnr(views) if views else None
        if seen is not None:
            self.history.evaluations.append((self.iteration, seen))

    def _mean_psnr(self, views: list[int]) -> float | None:
        """Mean PSNR in dB of some views as they are now; None where none of them tells it."""
        raise NotImplementedError

    def _situation(
        self, values: torch.Tensor, model: Model, empty: EmptySpace | None = None, reach: float = math.inf
    ) -> Situation:
        """What a strategy decides upon where vertices have one value and no colours.

        Args:
            values: (V,) in units; in models it has the place of density.
            model: See `Situation`.
            empty: Where it stays 0; None: nowhere.
            reach: Greatest change of it for which the models are believed.
        """
        padded = torch.nn.functional.pad(values.detach()[:, None], (3, 0))
        known = FreeSpace([], []) if empty is None else empty
        return Situation(self.mesh, padded, self._moment(), model, _no_colors, known, reach)

    def _refine_by(self, strategy: Strategy, situation: Situation, error: Callable[[], float]) -> None:
        """Lets a strategy decide, does what it says, and takes note of it.

        Args:
            strategy: The strategy.
            situation: What it decides upon.
            error: Tells the error as it is.
        """
        refinement = strategy.refine(situation)
        if refinement is None:
            return
        before = error()
        self._apply(refinement)
        self._record(refinement, situation.mesh, (before, error()))

    def _apply(self, refinement: Refinement) -> None:
        """Does what a refinement says to the mesh and all that is on it."""
        raise NotImplementedError

    def _record(self, refinement: Refinement, before: TetMesh, errors: tuple[float, float]) -> None:
        self.history.refinements.append(
            RefinementRecord(
                iteration=self.iteration,
                cells_before=before.num_cells,
                cells=self.mesh.num_cells,
                vertices=self.mesh.num_vertices,
                removed=refinement.removed,
                added=refinement.added,
                flipped=refinement.flipped,
                predicted=refinement.predicted,
                error_before=errors[0],
                error_after=errors[1],
            )
        )

    def _mesh_state(self) -> dict[str, torch.Tensor]:
        """What a checkpoint holds of the mesh and of how its vertices move, by name."""
        tensors = {"vertices": self.mesh.vertices, "tets": self.mesh.tets}
        if self.positions:
            state = self.positions.state()
            tensors |= {_POSITIONS + name: tensor for name, tensor in state.items() if name not in tensors}
        return tensors

    def checkpoint(self) -> Checkpoint:
        """The state, to be saved."""
        raise NotImplementedError

    def _go_on_from(self, saved: Checkpoint) -> None:
        """Takes over what is known of any mesh, for a run that has been made with that of a checkpoint.

        Raises:
            FitError: The checkpoint lacks something, or has come further than the options ask for.
        """
        saved.require_not_beyond(self.config.steps)
        saved.require_tensors_like(self.checkpoint().tensors)
        if self.positions:
            self.positions.restore({name.removeprefix(_POSITIONS): tensor for name, tensor in saved.tensors.items()})
        self.budget, self.iteration, self.history = saved.budget, saved.iteration, saved.history


def _no_colors() -> torch.Tensor:
    raise FitError("There are no colours here to refine by; refine by exchange or grow.")
