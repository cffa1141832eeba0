"""One reconstruction between two iterations, and what an iteration does."""

from __future__ import annotations

import math
from dataclasses import astuple, replace

import torch

from difftetvr.capture.capture import Capture
from difftetvr.errors import FitError
from difftetvr.fitting.beginning.initial_mesh import Start, load_start
from difftetvr.fitting.beginning.requirements import device_for, require_fittable
from difftetvr.fitting.beginning.starting_mesh import starting_mesh
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.losses import LOSSES, sparsity
from difftetvr.fitting.metrics import psnr_of_mse
from difftetvr.fitting.parameters import FieldParameters
from difftetvr.fitting.positions import StepReport, VertexOptimizer
from difftetvr.fitting.processes import ALONE, Processes
from difftetvr.fitting.records.checkpoint import Checkpoint, describe_capture, require_same_capture
from difftetvr.fitting.records.evaluation import Evaluation, counted_share, evaluate, true_image, where_valid
from difftetvr.fitting.records.history import History, MoveTotals, RefinementRecord
from difftetvr.fitting.records.result import Progress
from difftetvr.fitting.refinement import Moment, Refinement, Situation, Strategy
from difftetvr.fitting.refinement.pixels import Judgement
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import render
from difftetvr.rendering.gauss_newton import ImageModel

_GLANCE_VIEWS = 4
_POSITIONS = "positions."  # prefix of the positions' state in a checkpoint


class Trainer:
    """A reconstruction between two iterations; its state alone decides how it goes on.

    Attributes:
        capture: Images and cameras.
        config: Options, those that were left open chosen for the capture.
        strategy: How the mesh is refined; None: not at all.
        budget: Cells that the mesh may have.
        parameters: Colours and densities under optimisation.
        positions: Vertex positions under optimisation; None where they are fixed.
        iteration: Iterations done.
        history: What happened so far.
        repair: What mending the initial mesh changed, in words; None where it was not mended.
        starts_from_field: Whether the initial mesh brought colours and densities along.
        processes: Those that fit together; all of them hold the same state.
    """

    def __init__(
        self,
        capture: Capture,
        config: FitConfig,
        mesh: TetMesh | None = None,
        strategy: Strategy | None = None,
        processes: Processes = ALONE,
    ) -> None:
        """Prepares the first iteration.

        Args:
            capture: Images and cameras.
            config: Options.
            mesh: Mesh to begin with; default: the file or the starting mesh that the options ask for.
            strategy: How to refine it; default: as the options say.
            processes: Those that fit together; default: this one alone.

        Raises:
            CaptureError: The background needs alpha that the capture lacks.
            FitError: The device does not exist or cannot move vertices, a strategy would refine a field on cells, or
                the initial mesh does not suit the options or the images.
            MeshError: The file of the initial mesh cannot be read or holds an invalid mesh, or the grid is too large.
        """
        config = config.for_capture(capture).for_processes(processes.count)
        strategy = strategy or config.strategy()
        require_fittable(capture, config, strategy)
        self.capture = capture
        self.config = config
        self.strategy = strategy
        self.processes = processes
        start = _start(capture, config, strategy, mesh)
        self.repair = start.repair
        self.starts_from_field = start.field is not None
        self._mesh = start.mesh.to(device=device_for(config, strategy))
        self.positions = VertexOptimizer(self._mesh, config.motion) if config.move else None
        self.budget = self._budget(mesh is not None or config.grid is not None or config.initial_mesh is not None)
        units = capture.density_units_at(self._sites())
        self.parameters = FieldParameters(self._mesh, config, units, start.field)
        self._free_space = capture.free_space(config.free_space or 0.0)
        self.parameters.keep_free(self._free_space.contains(self._sites()))
        self.iteration = 0
        self.history = History()
        self._train_views: list[int] = capture.train_indices.tolist()
        self._capture_description = describe_capture(capture)

    @property
    def mesh(self) -> TetMesh:
        """The mesh as it is now, detached."""
        mesh = self.positions.mesh if self.positions else self._mesh
        return mesh.with_vertices(mesh.vertices.detach())

    def step(self) -> None:
        """One iteration: refines the mesh where that is due, renders views, moves parameters and vertices.

        Raises:
            FitError: The loss is not finite.
        """
        self._refine_if_due()
        rate = self._motion_rate()
        mesh = self.positions.mesh if self.positions and rate is not None else self.mesh
        losses, errors = self._gather_gradients(mesh)
        if not all(math.isfinite(loss) for loss in losses):
            raise FitError(
                f"The loss of iteration {self.iteration} is not finite; check the images or lower the learning rate."
            )
        self.parameters.step(self.config.rate_at(self.iteration), self.config.haze_penalty)
        self._move(rate)
        self.history.loss.append(sum(losses) / len(losses))
        self.history.psnr.append(psnr_of_mse(sum(errors) / len(errors)))
        self.iteration += 1

    def glance(self) -> None:
        """Notes the mean PSNR over a few held-out views, for the curves; decides nothing."""
        tested = self.capture.test_indices.tolist()
        views = tested[:: max(1, math.ceil(len(tested) / _GLANCE_VIEWS))]
        seen = self.evaluate(views).mean_psnr
        if seen is not None:
            self.history.evaluations.append((self.iteration, seen))

    def evaluate(self, views: list[int]) -> Evaluation:
        """Image quality of the reconstruction as it is now; each view is rendered by one of the processes.

        Args:
            views: Indices of the views to compare.
        """
        mesh, field, background = self.mesh, self.parameters.detached_field(), self.config.evaluation_background()
        own = [evaluate(mesh, field, self.capture, [view], background).row for view in self.processes.share(views)]
        return Evaluation.of_rows(self.processes.gathered(own, len(views), 3))

    def require_agreement(self) -> None:
        """Checks that all processes have come to the same state.

        Raises:
            FitError: They have not.
        """
        if self.processes.count > 1:
            self.processes.require_same(
                self.checkpoint().digest(),
                f"The processes have come to different meshes after {self.iteration} iterations; start all of them "
                "with the same command, files and versions, on machines of one kind.",
            )

    def checkpoint(self) -> Checkpoint:
        """The state, to be saved."""
        tensors = {"vertices": self.mesh.vertices, "tets": self.mesh.tets, **self.parameters.state()}
        if self.positions:
            state = self.positions.state()
            tensors |= {_POSITIONS + name: tensor for name, tensor in state.items() if name not in tensors}
        strategy = type(self.strategy).__name__
        return Checkpoint(
            self.iteration,
            self.config,
            self._capture_description,
            tensors,
            self.budget,
            strategy,
            self.history,
            self.repair,
        )

    @staticmethod
    def resume(
        capture: Capture,
        config: FitConfig,
        checkpoint: Checkpoint,
        strategy: Strategy | None = None,
        processes: Processes = ALONE,
    ) -> Trainer:
        """Goes on from a checkpoint.

        With more or fewer iterations than its run was to have, rates go on as they would at this point of such a run.

        Raises:
            FitError: The checkpoint is of a run with other options or images, lacks something, or has come further than
                the options ask for.
        """
        # However many processes go on: the run stays what it is.
        config = replace(config, batch_views=config.batch_views or checkpoint.config.batch)
        asked = config.for_capture(capture)
        checkpoint.config.require_same_run(asked)
        checkpoint.require_not_beyond(asked.steps)
        trainer = Trainer(capture, config, checkpoint.mesh(), strategy, processes)
        require_same_capture(checkpoint.capture, trainer._capture_description)
        checkpoint.require_strategy(type(trainer.strategy).__name__)
        checkpoint.require_tensors_like(trainer.checkpoint().tensors)
        trainer.parameters.restore(checkpoint.tensors)
        if trainer.positions:
            trainer.positions.restore({k.removeprefix(_POSITIONS): v for k, v in checkpoint.tensors.items()})
        trainer.budget = checkpoint.budget
        trainer.iteration = checkpoint.iteration
        trainer.history = checkpoint.history
        trainer.repair = checkpoint.repair
        return trainer

    def progress(self, seconds: float) -> Progress:
        """A summary for a display; loss and PSNR are means over the last pass through the training views."""
        window = self._epoch
        losses, psnrs = self.history.loss[-window:], self.history.psnr[-window:]
        return Progress(
            iteration=self.iteration,
            iterations=self.config.steps,
            loss=sum(losses) / max(1, len(losses)),
            train_psnr=sum(psnrs) / max(1, len(psnrs)),
            held_out_psnr=self.history.evaluations[-1][1] if self.history.evaluations else None,
            cells=self.mesh.num_cells,
            moves=self.history.moves,
            refinements=len(self.history.refinements),
            last_refinement=self.history.refinements[-1] if self.history.refinements else None,
            seconds=seconds,
        )

    @property
    def _epoch(self) -> int:
        """Iterations of one pass over the training views."""
        return max(1, len(self._train_views) // self.config.batch)

    def _budget(self, mesh_is_given: bool) -> int:
        """The options' cells; a given mesh is its own budget, unless the strategy is to make it grow."""
        budget = self.config.budget
        if not mesh_is_given:
            return budget
        grows = self.strategy is not None and self.strategy.initial_cells(budget) < budget
        return max(budget if grows else 0, self._mesh.num_cells)

    def _sites(self) -> torch.Tensor:
        """(N, 3) positions of the vertices, or centres of the cells, that the parameters belong to."""
        mesh = self.mesh
        return mesh.vertices if self.config.location == "vertex" else mesh.vertices[mesh.tets.long()].mean(1)

    def _moment(self) -> Moment:
        return Moment(self.iteration, self.config.steps, self._epoch, self.mesh.num_cells, self.budget)

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
            self.history.moves = _added(self.history.moves, self.positions.step(rate))

    def _refine_if_due(self) -> None:
        if self.strategy is None or not self.strategy.is_due(self._moment()):
            return
        with self.processes.in_order():
            self._refine(self.strategy)
        self.require_agreement()

    def _refine(self, strategy: Strategy) -> None:
        judgement, mesh = self._judgement(strategy.views), self.mesh
        unit = self.capture.density_unit

        def model(face_steps: torch.Tensor | None) -> ImageModel:
            steps = None if face_steps is None else face_steps * face_steps.new_tensor([1.0, 1.0, 1.0, unit])
            field, deterministic = self.parameters.detached_field(), self.config.deterministic
            return judgement.model(mesh, field, deterministic, steps).with_density_unit(unit)

        values = self.parameters.values(unit)
        refinement = strategy.refine(
            Situation(mesh, values, self._moment(), model, self._color_gradients, self._free_space)
        )
        if refinement is None:
            return
        judges = judgement.some()
        before = judges.error(mesh, self.parameters.detached_field())
        self._apply(refinement)
        self.history.refinements.append(
            RefinementRecord(
                iteration=self.iteration,
                cells_before=mesh.num_cells,
                cells=self.mesh.num_cells,
                vertices=self.mesh.num_vertices,
                removed=refinement.removed,
                added=refinement.added,
                flipped=refinement.flipped,
                predicted=refinement.predicted,
                error_before=before,
                error_after=judges.error(self.mesh, self.parameters.detached_field()),
            )
        )

    def _judgement(self, views: int) -> Judgement:
        """What a refinement is judged on."""
        positions = self.config.refinement_views_at(self.iteration, views, len(self._train_views))
        judgement = Judgement.of(
            self.capture,
            [self._train_views[position] for position in positions],
            self.mesh,
            self.config.background_at(self.iteration),
            self.config.refinement_random(self.iteration),
            self.config.batch,
            self.processes,
        )
        # Colours by direction are known for rays that start at one point.
        return judgement if self.parameters.harmonics is not None else judgement.together()

    def _apply(self, refinement: Refinement) -> None:
        for change in refinement.changes:
            self.parameters.carry(change)
            if self.positions:
                self.positions.carry(change)
            self._mesh = change.mesh
        # Also those that have moved there since.
        self.parameters.keep_free(self._free_space.contains(self._sites()))
        if refinement.surplus is not None:
            self.parameters.add(refinement.surplus, self.capture.density_unit)

    def _color_gradients(self) -> torch.Tensor:
        """(V,) sums over all training views of the absolute derivatives of the loss by the vertices' colours."""
        background = self.config.background_at(self.iteration)
        total = torch.zeros_like(self.parameters.density, requires_grad=False)
        for share in self.processes.shares(self._train_views, self.config.batch):
            total += self._color_gradients_of(share, background)
        return self.processes.sum(total)

    def _color_gradients_of(self, views: list[int], background: tuple[float, float, float]) -> torch.Tensor:
        total = torch.zeros_like(self.parameters.density, requires_grad=False)
        for view in views:
            self.parameters.zero_grad()
            self._accumulate(self.mesh, view, background, 1.0)
            gradient = self.parameters.color.grad
            if gradient is not None:
                total += gradient.abs().sum(1)
        return total

    def _gather_gradients(self, mesh: TetMesh) -> tuple[list[float], list[float]]:
        """Adds the mean gradient over the views of this iteration; returns their losses and mean squared errors."""
        leaves = self.parameters.leaves(self.config.bands_at(self.iteration))
        leaves += [mesh.vertices] if mesh.vertices.requires_grad else []
        before = mesh.vertices.grad  # of earlier iterations, in which all processes have a part already
        for leaf in leaves:
            leaf.grad = None
        batch = self.config.views_at(self.iteration, len(self._train_views))
        background = self.config.background_at(self.iteration)
        own = [
            self._accumulate(mesh, self._train_views[position], background, 1.0 / len(batch))
            for position in self.processes.share(batch)
        ]
        rows = self.processes.gathered(own, len(batch), 2)
        gradients = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]
        for leaf, gradient in zip(leaves, self.processes.sum(gradients), strict=True):
            leaf.grad = gradient
        if before is not None and mesh.vertices.grad is not None:
            mesh.vertices.grad = before + mesh.vertices.grad
        return [loss for loss, _ in rows], [error for _, error in rows]

    def _accumulate(
        self, mesh: TetMesh, view: int, background: tuple[float, float, float], weight: float
    ) -> tuple[float, float]:
        """Adds a view's gradient; returns its loss and mean squared error."""
        device = mesh.vertices.device
        truth = true_image(self.capture, view, background).to(device)
        image = render(
            mesh,
            self.parameters.field(self.config.bands_at(self.iteration)),
            self.capture.cameras[view],
            background=torch.tensor(background, device=device),
            deterministic=self.config.deterministic,
        ).color
        image = where_valid(self.capture, view, image, truth)
        share = counted_share(None if self.capture.valid is None else self.capture.valid[view])
        loss = LOSSES[self.config.loss](image, truth) / share
        if self.config.sparsity:
            loss = loss + self.config.sparsity * sparsity(self.parameters.density)
        (weight * loss).backward()
        return float(loss.detach()), float((image.detach() - truth).square().mean()) / share


def _added(totals: MoveTotals, report: StepReport) -> MoveTotals:
    return MoveTotals(*(a + b for a, b in zip(astuple(totals), (1, *astuple(report)), strict=True)))


def _start(capture: Capture, config: FitConfig, strategy: Strategy | None, mesh: TetMesh | None) -> Start:
    if mesh is not None:
        return Start(mesh)
    if config.initial_mesh is not None:
        return load_start(capture, config, strategy)
    return Start(starting_mesh(capture, config, strategy))
