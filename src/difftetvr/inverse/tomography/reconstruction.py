"""One tomographic reconstruction between two iterations, and what an iteration does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from difftetvr.capture.projections.projection_capture import ProjectionCapture
from difftetvr.capture.projections.support import OutsideSupport
from difftetvr.errors import FitError
from difftetvr.fitting.beginning.requirements import resolve_device
from difftetvr.fitting.positions import VertexOptimizer
from difftetvr.fitting.processes import ALONE
from difftetvr.fitting.records.checkpoint import Checkpoint
from difftetvr.fitting.records.history import History
from difftetvr.fitting.records.unread import Unread
from difftetvr.fitting.refinement import Refinement, Strategy
from difftetvr.fitting.refinement.adaptive_run import AdaptiveRun
from difftetvr.inverse.tomography.alignment import Alignment
from difftetvr.inverse.tomography.config import TomographyConfig
from difftetvr.inverse.tomography.densities import Densities
from difftetvr.inverse.tomography.judgement import Judgement
from difftetvr.inverse.tomography.likelihoods import LIKELIHOODS
from difftetvr.inverse.tomography.measurements import Measurements, PixelSet
from difftetvr.inverse.tomography.objective import Objective
from difftetvr.inverse.tomography.scoring import ProjectionScore, score_views
from difftetvr.inverse.tomography.solver import solve
from difftetvr.mesh.field import Field
from difftetvr.mesh.making.generators import grid_cubes
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import render
from difftetvr.rendering.gauss_newton import HatChoice, ImageModel

_GLANCED_RAYS = 16_384
_PENALTY_EVERY = 4
"""Iterations that share one evaluation of the penalty, which costs as much as some ten thousand rays."""


class Reconstruction(AdaptiveRun):
    """A reconstruction between two iterations; its state alone decides how it goes on.

    Attributes:
        measurements: The scan.
        config: Options.
        densities: Densities under optimisation.
        alignment: Corrections of the geometry under optimisation.
        positions: Vertex positions under optimisation; None where they are fixed.
        iteration: Iterations done.
        history: What happened so far; PSNR is that of line integrals, with the greatest of the scan as peak.
        processes: This one alone.
    """

    def __init__(self, capture: ProjectionCapture, config: TomographyConfig, mesh: TetMesh | None = None) -> None:
        """Prepares the first iteration.

        Args:
            capture: The scan.
            config: Options.
            mesh: Mesh to begin with; default: a grid over the box to reconstruct.

        Raises:
            FitError: The device does not exist.
            MeshError: The mesh would be too large.
        """
        device = resolve_device(config.device)
        self.config, self.strategy, self.processes = config, config.strategy(), ALONE
        self.measurements = Measurements(capture, device)
        self._train_views, self._test_views = self.measurements.train, self.measurements.test
        self._mesh = (mesh or _grid(capture, config, self.strategy)).to(device=device)
        self.positions = VertexOptimizer(self._mesh, config.motion) if config.move else None
        self.densities = Densities(self._mesh, self.measurements.density_unit, config.betas)
        self._outside = OutsideSupport.of(config.support, capture.geometry, device) if config.support else None
        self._keep_free()
        shift = 0.0 if config.align == "none" else self.measurements.axis_shift()
        self.alignment = Alignment(config.align, capture.geometry.shape, device, shift)
        self.objective = Objective.of(config, float((capture.geometry.bounds[1] - capture.geometry.bounds[0]).prod()))
        self.budget = max(config.budget, self._mesh.num_cells if mesh is not None else 0)
        self.iteration, self.history = 0, History()
        self._unread = Unread()
        self._description = _describe(capture)

    def step(self) -> None:
        """One iteration: refines the mesh where that is due, looks along rays, moves densities and vertices.

        Raises:
            FitError: The loss is not finite.
        """
        self._refine_if_due()
        config = self.config
        rate = self._motion_rate()
        self._unread.add(self.iteration, *self._gather(self._moving_mesh(rate)))
        self._unread.read_errors(self.history)
        self.densities.step(config.rate_at(self.iteration))
        self.alignment.step(config.align_rate * config.rate_at(self.iteration) / config.rate)
        self._move(rate)
        self._keep_free()  # also what has moved there
        self._unread.read_moves(self.history)
        self.iteration += 1

    def solve(self, on_step: Callable[[int], None] | None = None) -> None:
        """Solves for the densities with pixels of all training views, while the vertices stay.

        Args:
            on_step: Called with the number of steps done.
        """
        scan = self.measurements
        each = max(1, self.config.solve_rays // max(1, len(scan.train)))
        found = solve(
            self.mesh,
            self.densities,
            lambda: (self._fixed(view, each) for view in scan.train),
            self.objective,
            self.config.solve_steps,
            on_step,
        )
        self.densities.set(found.values)

    def _pixels_to_judge(self, views: int, count: int) -> list[PixelSet]:
        """Pixels of random training views, for what a refinement is judged on.

        Args:
            views: How many views; all where there are fewer.
            count: Pixels in all.
        """
        random = self.config.refinement_random(self.iteration)
        chosen = [self._train_views[int(k)] for k in random.permutation(len(self._train_views))[:views]]
        each = max(1, count // len(chosen))
        return [self._fixed(view, each, (float(random.random()), float(random.random()))) for view in chosen]

    def score(self, views: list[int], pixels: int | None = None) -> ProjectionScore:
        """How well views are predicted.

        Args:
            views: Their numbers.
            pixels: Pixels of each to look at, at most; default: all.
        """
        parts = [(view, self._fixed(view, pixels or self.measurements.all_pixels)) for view in views]
        return score_views(self.mesh, self.densities.detached(), self.measurements.peak, parts)

    def _mean_psnr(self, views: list[int]) -> float | None:
        return self.score(views, _GLANCED_RAYS).mean_psnr

    def field(self) -> Field:
        """The densities as they are now, detached."""
        density = self.densities.detached()
        return Field(density.new_zeros(len(density), 0), density, "vertex")

    @torch.no_grad()
    def _seen_and_true(self, view: int) -> tuple[torch.Tensor, torch.Tensor]:
        scan = self.measurements
        part = self._fixed(view, scan.all_pixels)
        found = render(self.mesh, self.field(), part.camera).optical_depth
        found = torch.where(part.weight > 0, found, part.measured)
        rendered, truth = ((each / scan.peak)[..., None].expand(-1, -1, 3) for each in (found, part.measured))
        return rendered, truth

    def checkpoint(self) -> Checkpoint:
        """The state, to be saved."""
        tensors = self._mesh_state() | self.densities.state() | self.alignment.state()
        strategy = type(self.strategy).__name__
        return Checkpoint(self.iteration, self.config, self._description, tensors, self.budget, strategy, self.history)

    @staticmethod
    def resume(capture: ProjectionCapture, config: TomographyConfig, checkpoint: Checkpoint) -> Reconstruction:
        """Goes on from a checkpoint.

        Raises:
            FitError: The checkpoint is of a run with other options or another scan, lacks something, or has come
                further than the options ask for.
        """
        checkpoint.config.require_same_run(config)
        run = Reconstruction(capture, config, checkpoint.mesh())
        for name, value in run._description.items():
            if checkpoint.capture.get(name) != value:
                raise FitError(
                    f"The saved run used a scan with {name} = {checkpoint.capture.get(name)}, this one has {value}; "
                    "resume with the same scan or start anew."
                )
        run._go_on_from(checkpoint)
        run.densities.restore(checkpoint.tensors)
        run.alignment.restore(checkpoint.tensors)
        return run

    def _gather(self, mesh: TetMesh) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradients of the objective over some pixels; means of the loss and of the squared error."""
        config, scan = self.config, self.measurements
        self.densities.zero_grad()
        random = config.step_random(self.iteration)
        views = [scan.train[k] for k in config.views_at(self.iteration, len(scan.train))]
        each = max(1, config.rays // len(views))
        self.alignment.zero_grad()
        phases = [(float(random.random()), float(random.random())) for _ in views]
        parts = [scan.pixels(view, each, phase, self.alignment) for view, phase in zip(views, phases, strict=True)]
        count = max(1, sum(int((part.weight > 0).sum()) for part in parts))
        loss = error = torch.zeros((), dtype=torch.float64, device=scan.device)
        for part in parts:
            found = self._integrals(mesh, part)
            residuals = LIKELIHOODS[config.likelihood](found.detach(), part.measured, part.weight)
            counts = part.weight > 0
            found.backward(torch.where(counts, residuals.slope, 0.0) / count)
            loss = loss + torch.where(counts, residuals.loss, 0.0).sum(dtype=torch.float64) / count
            squares = torch.where(counts, (found.detach() - part.measured).square(), 0.0)
            error = error + squares.sum(dtype=torch.float64) / count
        if self.iteration % _PENALTY_EVERY == 0:
            self._penalise(mesh)
        return loss, error / scan.peak**2

    @torch.no_grad()
    def _fixed(self, view: int, count: int, phase: tuple[float, float] = (0.5, 0.5)) -> PixelSet:
        """Pixels of a view where the geometry is as it is now."""
        return self.measurements.pixels(view, count, phase, self.alignment)

    def _penalise(self, mesh: TetMesh) -> None:
        """Adds the penalty's derivatives, those of as many iterations as share them."""
        densities = self.densities
        penalty = self.objective.penalty(mesh, densities.detached(), densities.unit)
        if penalty.by_density is not None and densities.values.grad is not None:
            densities.values.grad += (_PENALTY_EVERY * densities.unit * penalty.by_density).to(densities.values)
        if penalty.by_vertex is not None and mesh.vertices.grad is not None:
            mesh.vertices.grad += (_PENALTY_EVERY * penalty.by_vertex).to(mesh.vertices)

    def _integrals(self, mesh: TetMesh, part: PixelSet) -> torch.Tensor:
        image = render(mesh, self.densities.field(), part.camera, deterministic=self.config.deterministic)
        return image.optical_depth

    def _refine_if_due(self) -> None:
        if self.strategy is None or not self.strategy.is_due(self._moment()):
            return
        mesh, densities = self.mesh, self.densities
        most = self._judged_pixels * self.measurements.all_pixels
        parts = self._pixels_to_judge(self._judged_views, round(min(Judgement.wanted(mesh), most)))
        judgement = Judgement(parts, self.config.likelihood, self.config.deterministic)

        def model(hats: HatChoice | None = None) -> ImageModel:
            return judgement.model(mesh, densities.detached(), densities.unit, hats)

        situation, judges = self._situation(densities.values, model, self._outside), judgement.some()
        self._refine_by(self.strategy, situation, lambda: judges.error(self.mesh, densities.detached()))

    def _keep_free(self) -> None:
        if self._outside is not None:
            self.densities.keep_free(self._outside.contains(self.mesh.vertices))

    def _apply(self, refinement: Refinement) -> None:
        for change in refinement.changes:
            self.densities.carry(change)
            self._adopt(change)
        self._keep_free()
        if refinement.surplus is not None:
            self.densities.set(self.densities.values.detach() + refinement.surplus[:, 3].to(self.densities.values))


def _grid(capture: ProjectionCapture, config: TomographyConfig, strategy: Strategy | None) -> TetMesh:
    """The grid of near-cubic cubes over the box to reconstruct."""
    low, high = capture.geometry.bounds.tolist()
    cells = strategy.initial_cells(config.budget) if strategy else config.budget
    sides = [b - a for a, b in zip(low, high, strict=True)]
    return TetMesh.grid(grid_cubes(cells, sides), low, high)


def _describe(capture: ProjectionCapture) -> dict[str, Any]:
    """What tells one scan from another: values that are compared when a run is resumed."""
    views, height, width = capture.geometry.shape
    known = capture.line_integrals if capture.valid is None else capture.line_integrals[capture.valid]
    return {
        "views": views,
        "height": height,
        "width": width,
        "test_views": capture.test_indices.tolist(),
        "mean": float(known.mean(dtype=torch.float64)),
    }
