"""One reconstruction of scalars between two iterations, and what an iteration does."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import torch

from difftetvr.capture.capture import Capture
from difftetvr.capture.truth import BLACK, Truth
from difftetvr.errors import FitError
from difftetvr.fitting.beginning.requirements import resolve_device
from difftetvr.fitting.positions import VertexOptimizer
from difftetvr.fitting.processes import ALONE
from difftetvr.fitting.records.checkpoint import Checkpoint, describe_capture, require_same_capture
from difftetvr.fitting.records.evaluation import Evaluation, compared, seen_and_true
from difftetvr.fitting.records.history import History
from difftetvr.fitting.records.unread import Unread
from difftetvr.fitting.refinement import Refinement
from difftetvr.fitting.refinement.adaptive_run import AdaptiveRun
from difftetvr.fitting.refinement.pixels import Judgement
from difftetvr.inverse.scalars.config import ScalarConfig
from difftetvr.inverse.scalars.scalars import Scalars
from difftetvr.inverse.transfer.config import TransferConfig
from difftetvr.inverse.transfer.knots import Knots
from difftetvr.inverse.variation import total_variation
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.rendering import ScalarField, render
from difftetvr.rendering.gauss_newton import HatChoice, ImageModel

_FUNCTION = "function."  # prefix of the knots' state in a checkpoint
_REACH = 0.1
"""Change of a scalar for which an image is taken to be linear in it; transfer functions bend."""
_CANDIDATES, _CANDIDATE_VIEWS = 65, 4
_ROUNDING = 0.1
"""Gradient up to which the total variation is rounded off, in ranges per side of a cube of the box's volume."""


class ScalarReconstruction(AdaptiveRun):
    """A reconstruction between two iterations; its state alone decides how it goes on.

    Attributes:
        capture: Images and cameras.
        config: Options.
        attenuation: Density of opacity 1.
        scalars: Scalars under optimisation.
        knots: The transfer function under optimisation; None where it is known.
        positions: Vertex positions under optimisation; None where they are fixed.
        iteration: Iterations done.
        history: What happened so far.
        processes: This one alone.
    """

    def __init__(
        self,
        capture: Capture,
        function: TransferFunction,
        config: ScalarConfig,
        attenuation: float,
        mesh: TetMesh,
        scalars: torch.Tensor | None = None,
    ) -> None:
        """Prepares the first iteration.

        Args:
            capture: Images and cameras.
            function: The transfer function, or the one that the search for it begins with.
            config: Options.
            attenuation: Density of opacity 1.
            mesh: Mesh to begin with.
            scalars: (V,) scalars to begin with; default: the same everywhere, the one that explains the images best.

        Raises:
            FitError: The device does not exist, or the function looks the same for all scalars.
        """
        device = resolve_device(config.device)
        self.capture, self.config, self.strategy, self.processes = capture, config, config.strategy(), ALONE
        self.attenuation = attenuation
        self._mesh = mesh.to(device=device)
        self.positions = VertexOptimizer(self._mesh, config.motion) if config.move else None
        self.budget = max(config.cells, mesh.num_cells)
        self._function, self.knots = function, None
        if config.unknown == "both":
            options = TransferConfig(knots=config.knots, rate=config.rate, seed=config.seed)
            self.knots = Knots(options, function)
        self._train_views, self._test_views = capture.train_indices.tolist(), capture.test_indices.tolist()
        self._truth = Truth(capture, device).keep(self._train_views + self._glanced_views())
        if scalars is None:
            scalars = torch.full((mesh.num_vertices,), self._best_constant())
        self.scalars = Scalars(scalars.to(device), config.betas)
        self.iteration, self.history = 0, History()
        self._unread = Unread()

    @property
    def function(self) -> TransferFunction:
        """The transfer function as it is now, detached."""
        with torch.no_grad():
            return self._function if self.knots is None else self.knots.function()

    def field(self) -> ScalarField:
        """The scalars as they are now, detached, behind the function."""
        return self._seen(self.scalars.values.detach().clone(), self.function)

    def step(self) -> None:
        """One iteration: refines the mesh where that is due, renders views, moves scalars, function and vertices.

        Raises:
            FitError: The loss is not finite.
        """
        self._refine_if_due()
        config = self.config
        motion = self._motion_rate()
        self._unread.add(self.iteration, *self._gather(self._moving_mesh(motion)))
        self._unread.read_errors(self.history)
        self.scalars.step(config.rate_at(self.iteration))
        if self.knots is not None:
            self.knots.step(config.function_rate * config.rate_at(self.iteration))
        self._move(motion)
        self._unread.read_moves(self.history)
        self.iteration += 1

    def evaluate(self, views: list[int], similarity: bool = True) -> Evaluation:
        """Image quality of the reconstruction as it is now, over black.

        Args:
            views: Indices of the views to compare.
            similarity: Whether SSIM is wanted, too.
        """
        return compared(self.mesh, self.field(), self._truth, views, BLACK, similarity)

    def _mean_psnr(self, views: list[int]) -> float | None:
        return self.evaluate(views, similarity=False).mean_psnr

    def _seen_and_true(self, view: int) -> tuple[torch.Tensor, torch.Tensor]:
        return seen_and_true(self.mesh, self.field(), self._truth, view)

    def checkpoint(self) -> Checkpoint:
        """The state, to be saved."""
        tensors = self._mesh_state() | self.scalars.state()
        if self.knots is not None:
            tensors |= {_FUNCTION + name: tensor for name, tensor in self.knots.state().items()}
        strategy = type(self.strategy).__name__
        return Checkpoint(
            self.iteration, self.config, self._description(), tensors, self.budget, strategy, self.history
        )

    @staticmethod
    def resume(
        capture: Capture,
        function: TransferFunction,
        config: ScalarConfig,
        attenuation: float,
        checkpoint: Checkpoint,
    ) -> ScalarReconstruction:
        """Goes on from a checkpoint.

        Raises:
            FitError: The checkpoint is of a run with other options, images or another function, lacks something, or has
                come further than the options ask for.
        """
        checkpoint.config.require_same_run(config)
        mesh = checkpoint.mesh()
        run = ScalarReconstruction(capture, function, config, attenuation, mesh, torch.zeros(mesh.num_vertices))
        require_same_capture(checkpoint.capture, run._description())
        run._go_on_from(checkpoint)
        run.scalars.restore(checkpoint.tensors)
        if run.knots is not None:
            run.knots.restore({name.removeprefix(_FUNCTION): tensor for name, tensor in checkpoint.tensors.items()})
        return run

    def _description(self) -> dict[str, Any]:
        if self.knots is not None:
            return describe_capture(self.capture) | {"function": "unknown"}
        parts = (self._function.scalar, self._function.opacity, self._function.color)
        numbers = json.dumps([part.tolist() for part in parts] + [self.attenuation])
        return describe_capture(self.capture) | {"function": hashlib.sha256(numbers.encode()).hexdigest()[:16]}

    def _seen(self, values: torch.Tensor, function: TransferFunction) -> ScalarField:
        return ScalarField(values, function, self.attenuation, (0.0, 1.0), "vertex")

    def _gather(self, mesh: TetMesh) -> list[torch.Tensor]:
        """Gradients of the mean squared error of some views; means of the loss and of the error."""
        views = [self._train_views[k] for k in self.config.views_at(self.iteration, len(self._train_views))]
        self.scalars.zero_grad()
        function, hand_on = (self._function, None) if self.knots is None else self.knots.opened()
        seen = self._seen(self.scalars.values, function)
        total = torch.zeros((), dtype=torch.float64, device=self._truth.device)
        for view in views:
            error = self._error(mesh, seen, view) / len(views)
            error.backward()
            total += error.detach()
        if self.knots is not None and hand_on is not None:
            self.knots.zero_grad()
            hand_on(None)
        return [total + self._penalise(mesh).to(total), total]

    def _penalise(self, mesh: TetMesh) -> torch.Tensor:
        """Adds the derivatives of the scalars' total variation; returns what it costs."""
        weight, scalars = self.config.total_variation, self.scalars.values
        if not weight or scalars.grad is None:
            return torch.zeros(())
        side = float((self.capture.bounds[1] - self.capture.bounds[0]).double().prod() ** (1.0 / 3.0))
        found = total_variation(mesh, scalars.detach(), _ROUNDING / side)
        weight /= side * side
        scalars.grad += (weight * found.by_density).to(scalars)
        if mesh.vertices.grad is not None:
            mesh.vertices.grad += (weight * found.by_vertex).to(mesh.vertices)
        return weight * found.value

    def _error(self, mesh: TetMesh, field: ScalarField, view: int) -> torch.Tensor:
        """Mean squared error of a view."""
        truth = self._truth.image(view, BLACK).to(mesh.vertices.device)
        image = render(mesh, field, self._truth.camera(view), deterministic=self.config.deterministic).color
        image = self._truth.where_valid(view, image, truth)
        return (image - truth).square().mean() / self._truth.counted_share(view)

    def _best_constant(self) -> float:
        """The scalar that explains some views best if it is everywhere, of those from which the function changes."""
        places = torch.linspace(0.0, 1.0, _CANDIDATES)
        colors, opacities = self.function(places)
        values = torch.cat((colors, opacities[:, None]), 1)
        # Where a scalar looks as its neighbours do, nothing pulls at it.
        changes = (values[1:] - values[:-1]).abs().amax(1) > 0
        free = torch.zeros(_CANDIDATES, dtype=torch.bool)
        free[1:] |= changes
        free[:-1] |= changes
        if not bool(free.any()):
            raise FitError("The transfer function looks the same for all scalars, so none can be told; give another.")
        views = self._train_views[:: max(1, len(self._train_views) // _CANDIDATE_VIEWS)][:_CANDIDATE_VIEWS]
        low, high = self.mesh.bounds().tolist()
        box = TetMesh.grid((1, 1, 1), low, high).to(device=self.mesh.vertices.device)
        found = []
        with torch.no_grad():
            for place in places[free].tolist():
                everywhere = torch.full((box.num_vertices,), place, device=box.vertices.device)
                field = self._seen(everywhere, self.function)
                found.append((sum(float(self._error(box, field, view)) for view in views), place))
        return min(found)[1]

    def _refine_if_due(self) -> None:
        if self.strategy is None or not self.strategy.is_due(self._moment()):
            return
        mesh, views = self.mesh, self._judged_views
        chosen = self.config.refinement_views_at(self.iteration, views, len(self._train_views))
        judgement = Judgement.of(
            self._truth,
            [self._train_views[k] for k in chosen],
            mesh,
            BLACK,
            self.config.refinement_random(self.iteration),
            self._judged_pixels,
        ).together()

        def model(hats: HatChoice | None = None) -> ImageModel:
            return judgement.model(mesh, self.field(), self.config.deterministic, hats)

        situation, judges = self._situation(self.scalars.values, model, reach=_REACH), judgement.some()
        self._refine_by(self.strategy, situation, lambda: judges.error(self.mesh, self.field()))

    def _apply(self, refinement: Refinement) -> None:
        for change in refinement.changes:
            self.scalars.carry(change)
            self._adopt(change)
        if refinement.surplus is not None:
            self.scalars.add(refinement.surplus[:, 3])
