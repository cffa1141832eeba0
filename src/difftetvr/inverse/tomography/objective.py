"""What a tomographic reconstruction minimises: a loss of line integrals, and penalties of the density's gradient."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.inverse.tomography.config import Likelihood, TomographyConfig
from difftetvr.inverse.variation import cell_weights, total_variation, weighted_square
from difftetvr.mesh.tetmesh import TetMesh

_ROUNDING = 1e-2
"""Gradient up to which the total variation is rounded off, in mean densities per side of a cube of the box's volume."""


@dataclass(frozen=True)
class Penalty:
    """What gradients of a density cost.

    Attributes:
        value: The cost.
        by_density: (V,) derivatives by the densities; None where nothing costs.
        by_vertex: (V, 3) derivatives by the positions, of the total variation alone; None likewise.
    """

    value: float
    by_density: torch.Tensor | None
    by_vertex: torch.Tensor | None


@dataclass(frozen=True)
class Objective:
    """The objective, a mean over rays and one over the volume.

    Attributes:
        likelihood: How residuals count.
        total_variation: Weight of the total variation.
        tikhonov: Weight of half the squared gradient.
        volume: Of the box to reconstruct.
    """

    likelihood: Likelihood
    total_variation: float
    tikhonov: float
    volume: float

    @staticmethod
    def of(config: TomographyConfig, volume: float) -> Objective:
        """What the options ask for, in a box of some volume."""
        return Objective(config.likelihood, config.total_variation, config.tikhonov, volume)

    @property
    def penalises(self) -> bool:
        """Whether gradients of the density cost anything."""
        return self.total_variation > 0 or self.tikhonov > 0

    def factors(self, mesh: TetMesh, unit: float) -> tuple[float, float, float]:
        """Factors of the integrals of gradients and of half their squares, and where the former are rounded off.

        The penalties have no unit: lengths count in sides of a cube of the box's volume, densities in their mean.
        """
        side = self.volume ** (1.0 / 3.0)
        steep = side / unit
        total = self.total_variation * steep / self.volume
        squared = self.tikhonov * steep * steep / self.volume
        return total, squared, _ROUNDING / steep

    def penalty(self, mesh: TetMesh, density: torch.Tensor, unit: float) -> Penalty:
        """The cost of a density.

        Args:
            mesh: The mesh.
            density: (V,) per unit of length.
            unit: Mean density.
        """
        if not self.penalises:
            return Penalty(0.0, None, None)
        total, squared, smoothing = self.factors(mesh, unit)
        value, by_density, by_vertex = 0.0, torch.zeros_like(density, dtype=torch.float64), None
        if total:
            found = total_variation(mesh, density, smoothing)
            value += total * float(found.value)
            by_density, by_vertex = total * found.by_density, total * found.by_vertex
        if squared:
            found = weighted_square(mesh, density, cell_weights(mesh, density, 0.0, squared, 1.0))
            value += float(found.value)
            by_density = by_density + found.by_density
        return Penalty(value, by_density, by_vertex)
