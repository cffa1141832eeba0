"""What views teach: derivatives of the loss of their images, gathered from all processes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import add

import torch

from difftetvr.capture.truth import Color, Truth
from difftetvr.fitting.cameras.refined import RefinedCameras
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.losses import LOSSES, WEIGHTS, sparsity
from difftetvr.fitting.parameters import FieldParameters
from difftetvr.fitting.processes import Processes
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import render


@dataclass(frozen=True)
class ViewGradients:
    """How gradients come from views.

    Attributes:
        truth: What the views show.
        config: Options, chosen for the capture.
        parameters: Colours and densities; their gradients are gathered in them.
        processes: Those that take the views.
        cameras: Where the cameras are refined: their gradients are gathered in them.
    """

    truth: Truth
    config: FitConfig
    parameters: FieldParameters
    processes: Processes
    cameras: RefinedCameras | None = None

    def gather(self, mesh: TetMesh, views: list[int], iteration: int) -> list[torch.Tensor]:
        """Gradients of the mean loss over views: new ones of the field, and added to those of the vertices.

        Args:
            mesh: The mesh; its vertices have a gradient where they require one.
            views: Indices of the views of this iteration, over all processes.
            iteration: Iterations done.

        Returns:
            Means of the loss and of the squared error, float64 scalars where the truth is.
        """
        leaves = self.parameters.trained(self.config.bands_at(iteration))
        leaves += [mesh.vertices] if mesh.vertices.requires_grad else []
        leaves += [] if self.cameras is None else self.cameras.leaves()
        before = mesh.vertices.grad  # of earlier iterations, in which all processes have a part already
        for leaf in leaves:
            leaf.grad = None
        weight = 1.0 / len(views)
        moving = self.cameras if self.cameras is not None and self.cameras.motion.requires_grad else None
        if moving is not None:
            moving.curvature.zero_()
        own = [self._accumulate(mesh, view, iteration, weight, moving) for view in self.processes.share(views)]
        gradients = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]
        for leaf, gradient in zip(leaves, self.processes.sum(gradients), strict=True):
            leaf.grad = gradient
        if moving is not None:
            moving.curvature = self.processes.sum(moving.curvature)
        if before is not None and mesh.vertices.grad is not None:
            mesh.vertices.grad = before + mesh.vertices.grad
        return [reduce(add, values) / len(views) for values in zip(*self._of_all(own, len(views)), strict=True)]

    def by_colors(self, mesh: TetMesh, views: list[int], iteration: int) -> torch.Tensor:
        """(V,) sums over views of the absolute derivatives of the loss by the vertices' colours."""
        total = torch.zeros_like(self.parameters.density, requires_grad=False)
        for share in self.processes.shares(views, self.config.batch):
            total += self._by_colors_of(mesh, share, iteration)
        return self.processes.sum(total)

    def _by_colors_of(self, mesh: TetMesh, views: list[int], iteration: int) -> torch.Tensor:
        total = torch.zeros_like(self.parameters.density, requires_grad=False)
        for view in views:
            self.parameters.zero_grad()
            self._accumulate(mesh, view, iteration, 1.0)
            gradient = self.parameters.color.grad
            if gradient is not None:
                total += gradient.abs().sum(1)
        return total

    def _accumulate(
        self, mesh: TetMesh, view: int, iteration: int, weight: float, moving: RefinedCameras | None = None
    ) -> list[torch.Tensor]:
        """Adds a view's gradient, and its curvature to cameras that move by it; returns loss and mean squared error."""
        background: Color = self.config.background_at(iteration)
        truth = self.truth.image(view, background).to(mesh.vertices.device)
        seen = render(
            mesh,
            self.parameters.field(self.config.bands_at(iteration)),
            self.truth.camera(view) if self.cameras is None else self.cameras.camera(view),
            background=torch.tensor(background),
            deterministic=self.config.deterministic,
        )
        image, share = self.truth.where_valid(view, seen.color, truth), self.truth.counted_share(view)
        if moving is not None:
            weights = WEIGHTS[self.config.loss](image.detach() - truth) * (weight / (truth.numel() * share))
            weights = self.truth.where_valid(view, weights, torch.zeros_like(weights))
            moving.note_curvature(view, seen, weights)
        loss = LOSSES[self.config.loss](image, truth) / share
        if self.config.sparsity:
            loss = loss + self.config.sparsity * sparsity(self.parameters.density)
        (weight * loss).backward()
        error = (image.detach() - truth).square().mean()
        loss, error = (value.detach().to(self.truth.device, torch.float64) for value in (loss, error))
        return [loss, error / share]

    def _of_all(self, own: list[list[torch.Tensor]], count: int) -> list[list[torch.Tensor]]:
        """Loss and error of each of ``count`` views, of which this process has its own; alone it waits for nothing."""
        if self.processes.count == 1:
            return own
        rows = self.processes.gathered([[float(value) for value in row] for row in own], count, 2)
        return [list(row) for row in torch.tensor(rows, dtype=torch.float64)]
