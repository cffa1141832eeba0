"""Densities of a fixed mesh from all measurements at once: conjugate gradients, since line integrals are linear.

With fixed vertices the loss is a quadratic form of the densities, or close to one: the total variation is replaced by
the quadratic form that touches it at the present density, and so is a likelihood that is not Gaussian. A step of the
method costs one forward and one adjoint pass over the rays. Densities that are 0 and want to be less stay there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.inverse.tomography.densities import Densities
from difftetvr.inverse.tomography.likelihoods import LIKELIHOODS
from difftetvr.inverse.tomography.measurements import PixelSet
from difftetvr.inverse.tomography.objective import Objective
from difftetvr.inverse.variation import cell_weights, weighted_square
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import render

_RELINEARISED = 5
"""Steps after which the quadratic form is made anew around the density found so far."""

_FLAT, _TINY = 1e-6, 1e-30  # of the greatest diagonal element, and of any


@dataclass(frozen=True)
class Solution:
    """What the solver has found.

    Attributes:
        values: (V,) densities in units of the mean one, none negative.
        losses: Loss before the first step and after each block of steps.
    """

    values: torch.Tensor
    losses: list[float]


def solve(
    mesh: TetMesh,
    densities: Densities,
    pixels: Callable[[], Iterator[PixelSet]],
    objective: Objective,
    steps: int,
    on_step: Callable[[int], None] | None = None,
) -> Solution:
    """Densities that minimise the objective, as far as some steps of conjugate gradients get.

    Args:
        mesh: The mesh, which stays as it is.
        densities: Those to begin with; where they are free they stay 0.
        pixels: Gives all measurements that count, set by set, as often as it is asked.
        objective: What is minimised.
        steps: Steps in all.
        on_step: Called with the number of steps done.
    """
    values, losses, done = densities.values.detach().clone(), [], 0
    rays = _Rays(mesh, densities.unit, pixels)
    while done < steps:
        system = _System(rays, values, densities.is_free, objective)
        losses.append(system.loss)
        block = min(_RELINEARISED, steps - done)
        values = (values + system.descend(block, on_step, done)).clamp(min=0.0)
        done += block
    return Solution(values, losses)


class _Rays:
    """The linear map from densities, in units, to all line integrals, one set of pixels after the other.

    Attributes:
        mesh: The mesh.
        unit: Density per unit of length that 1 stands for.
    """

    def __init__(self, mesh: TetMesh, unit: float, pixels: Callable[[], Iterator[PixelSet]]) -> None:
        """Finds how far each ray goes in the mesh."""
        self.mesh, self.unit, self._pixels = mesh, unit, pixels
        ones = torch.ones(mesh.num_vertices, dtype=mesh.vertices.dtype, device=mesh.vertices.device)
        with torch.no_grad():
            self._ways = [self._integrals(ones, part) for part in pixels()]

    def sets(self) -> Iterator[tuple[PixelSet, torch.Tensor]]:
        """All sets of pixels, each with the integrals of densities of 1."""
        return zip(self._pixels(), self._ways, strict=True)

    def integrals(self, values: torch.Tensor, part: PixelSet) -> tuple[torch.Tensor, Callable[[torch.Tensor], Any]]:
        """Line integrals of densities that are not negative, and the adjoint of the map that they come from.

        Args:
            values: (V,) densities.
            part: The pixels.

        Returns:
            (h, w) integrals, and a function from as many factors to (V,) derivatives of the integrals' weighted sum.
        """
        leaf = values.detach().requires_grad_()
        found = self._integrals(leaf, part)
        return found.detach(), lambda worth: torch.autograd.grad(found, leaf, worth, retain_graph=True)[0]

    def _integrals(self, values: torch.Tensor, part: PixelSet) -> torch.Tensor:
        field = Field(values.new_zeros(len(values), 0), self.unit * values, "vertex")
        return render(self.mesh, field, part.camera, deterministic=True).optical_depth


class _System:
    """The quadratic form around some densities.

    Attributes:
        loss: The objective there.
    """

    def __init__(self, rays: _Rays, values: torch.Tensor, is_free: torch.Tensor, objective: Objective) -> None:
        """Looks along all rays once: loss, gradient, curvature and preconditioner."""
        mesh, unit, self._rays = rays.mesh, rays.unit, rays
        self._curvatures: list[torch.Tensor] = []
        gradient, diagonal, loss, count = torch.zeros_like(values), torch.zeros_like(values), 0.0, 0
        likelihood = LIKELIHOODS[objective.likelihood]
        for part, way in rays.sets():
            found, spread = rays.integrals(values, part)
            residuals = likelihood(found, part.measured, part.weight)
            counts = part.weight > 0
            loss += float(torch.where(counts, residuals.loss, 0.0).sum(dtype=torch.float64))
            count += int(counts.sum())
            curvature = torch.where(counts, residuals.curvature, 0.0)
            gradient += spread(torch.where(counts, residuals.slope, 0.0))
            # Row sums bound the matrix (De Pierro 1995), and are positive wherever a ray comes by.
            diagonal += spread(curvature * way)
            self._curvatures.append(curvature)
        self._count = max(count, 1)
        gradient, diagonal = gradient / self._count, diagonal / self._count
        self._weights: torch.Tensor | None = None
        if objective.penalises:
            self._weights = cell_weights(mesh, unit * values, *objective.factors(mesh, unit))
            gradient += unit * weighted_square(mesh, unit * values, self._weights).by_density.to(gradient)
        self.loss = loss / self._count + objective.penalty(mesh, unit * values, unit).value
        self._is_held = is_free | ((values <= 0) & (gradient > 0))
        self._gradient = torch.where(self._is_held, 0.0, gradient)
        self._inverse = 1.0 / (diagonal + _FLAT * float(diagonal.max()) + _TINY)

    def descend(self, steps: int, on_step: Callable[[int], None] | None, done: int) -> torch.Tensor:
        """(V,) change of the densities after some steps of preconditioned conjugate gradients."""
        change = torch.zeros_like(self._gradient)
        residual = -self._gradient
        ahead = self._inverse * residual
        direction, size = ahead.clone(), _dot(residual, ahead)
        for step in range(steps):
            if not size > 0:
                break
            image = self._times(direction)
            length = size / max(_dot(direction, image), _TINY)
            change += length * direction
            residual -= length * image
            ahead = self._inverse * residual
            size, before = _dot(residual, ahead), size
            direction = ahead + (size / before) * direction
            if on_step is not None:
                on_step(done + step + 1)
        return change

    def _times(self, direction: torch.Tensor) -> torch.Tensor:
        """The quadratic form's matrix times a vector."""
        # Densities are not negative: what is added so that none is, rays weigh by their ways through the mesh.
        shift = float((-direction).clamp(min=0.0).max())
        raised = direction + shift
        total = torch.zeros_like(direction)
        for (part, way), curvature in zip(self._rays.sets(), self._curvatures, strict=True):
            along, spread = self._rays.integrals(raised, part)
            total += spread(curvature * (along - shift * way))
        total /= self._count
        if self._weights is not None:
            penalty = weighted_square(self._rays.mesh, self._rays.unit * direction, self._weights)
            total += self._rays.unit * penalty.by_density.to(total)
        return torch.where(self._is_held, 0.0, total)


def _dot(first: torch.Tensor, second: torch.Tensor) -> float:
    return float((first.double() * second.double()).sum())
