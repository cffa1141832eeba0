"""Pixels of several views on which a refinement is judged."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from difftetvr.inverse.tomography.config import Likelihood
from difftetvr.inverse.tomography.likelihoods import LIKELIHOODS, Residuals
from difftetvr.inverse.tomography.measurements import PixelSet
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import render
from difftetvr.rendering.gauss_newton import HatChoice, ImageModel, model_line_integrals

_CROSSINGS = 400.0
"""How often a cell is crossed, on average, by the rays of all pixels, as for photographs."""


@dataclass(frozen=True)
class Judgement:
    """What refinements are judged on.

    Attributes:
        parts: Pixels of some training views.
        likelihood: How residuals count.
        deterministic: Whether sums have a fixed order.
    """

    parts: list[PixelSet]
    likelihood: Likelihood
    deterministic: bool

    @staticmethod
    def wanted(mesh: TetMesh) -> int:
        """How many pixels predictions about the cells of a mesh need."""
        return max(1, round(_CROSSINGS * mesh.num_cells ** (2 / 3)))

    def some(self) -> Judgement:
        """A few of the views: enough to see what became of the error."""
        return Judgement(self.parts[: max(1, len(self.parts) // 4)], self.likelihood, self.deterministic)

    def model(self, mesh: TetMesh, density: torch.Tensor, unit: float, hats: HatChoice | None = None) -> ImageModel:
        """Quadratic models of the mean loss.

        Args:
            mesh: The mesh.
            density: (V,) densities per unit of length.
            unit: What densities are counted in, in the models and steps.
            hats: Edges and steps of faces that are looked at; None: all edges. Without steps nothing is known of faces.
        """
        hats = hats or HatChoice()
        if hats.face_steps is None:
            hats = replace(hats, face_steps=density.new_zeros(mesh.topology.faces.shape[0], 4))
        hats = hats.from_density_unit(unit)
        total: ImageModel | None = None
        share = 1.0 / self._count
        for part in self.parts:
            residuals = self._residuals(mesh, density, part)
            errors = share * residuals.slope, share * residuals.curvature
            model = model_line_integrals(mesh, density, part.camera, errors, hats, self.deterministic)
            total = model if total is None else total + model
        assert total is not None
        return total.with_density_unit(unit)

    @torch.no_grad()
    def error(self, mesh: TetMesh, density: torch.Tensor) -> float:
        """Mean loss."""
        losses = (self._residuals(mesh, density, part).loss.sum(dtype=torch.float64) for part in self.parts)
        return sum(float(loss) for loss in losses) / self._count

    @property
    def _count(self) -> int:
        return max(1, sum(int((part.weight > 0).sum()) for part in self.parts))

    @torch.no_grad()
    def _residuals(self, mesh: TetMesh, density: torch.Tensor, part: PixelSet) -> Residuals:
        field = Field(density.new_zeros(len(density), 0), density, "vertex")
        found = render(mesh, field, part.camera).optical_depth
        residuals, counts = LIKELIHOODS[self.likelihood](found, part.measured, part.weight), part.weight > 0
        masked = (torch.where(counts, v, 0.0) for v in (residuals.loss, residuals.slope, residuals.curvature))
        return Residuals(*masked)
