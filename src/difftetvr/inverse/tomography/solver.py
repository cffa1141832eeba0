"""Densities of a fixed mesh from all measurements at once: conjugate gradients, since line integrals are linear.

With fixed vertices the loss is a quadratic form of the densities, or close to one: the total variation is replaced by
the quadratic form that touches it at the present density, and so is a likelihood that is not Gaussian. A step of the
method costs one forward and one adjoint pass over the rays. Densities that are 0 and want to be less stay there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from difftetvr.inverse.tomography.likelihoods import LIKELIHOODS
from difftetvr.inverse.tomography.measurements import PixelSet
from difftetvr.inverse.tomography.objective import Objective
from difftetvr.inverse.tomography.variation import cell_weights, weighted_square
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
    start: torch.Tensor,
    unit: float,
    pixels: Callable[[], Iterator[PixelSet]],
    objective: Objective,
    steps: int,
    on_step: Callable[[int], None] | None = None,
) -> Solution:
    """Densities that minimise the objective, as far as some steps of conjugate gradients get.

    Args:
        mesh: The mesh, which stays as it is.
        start: (V,) densities to begin with, in units.
        unit: Density per unit of length that 1 stands for.
        pixels: Gives all measurements that count, set by set, as often as it is asked.
        objective: What is minimised.
        steps: Steps in all.
        on_step: Called with the number of steps done.
    """
    values, losses, done = start.detach().clone(), [], 0
    while done < steps:
        system = _System(mesh, values, unit, pixels, objective)
        losses.append(system.loss)
        block = min(_RELINEARISED, steps - done)
        values = (values + system.descend(block, on_step, done)).clamp(min=0.0)
        done += block
    return Solution(values, losses)


class _System:
    """The quadratic form around some densities.

    Attributes:
        loss: The objective there.
    """

    def __init__(
        self,
        mesh: TetMesh,
        values: torch.Tensor,
        unit: float,
        pixels: Callable[[], Iterator[PixelSet]],
        objective: Objective,
    ) -> None:
        """Looks along all rays once: loss, gradient, curvature and preconditioner."""
        self._mesh, self._unit, self._pixels = mesh, unit, pixels
        self._curvatures: list[torch.Tensor] = []
        self._ways: list[torch.Tensor] = []
        gradient, diagonal, loss, count = torch.zeros_like(values), torch.zeros_like(values), 0.0, 0
        ones, likelihood = torch.ones_like(values), LIKELIHOODS[objective.likelihood]
        for part in pixels():
            residuals = likelihood(self._integrals(values, part), part.measured, part.weight)
            counts = part.weight > 0
            loss += float(torch.where(counts, residuals.loss, 0.0).sum(dtype=torch.float64))
            count += int(counts.sum())
            curvature, way = torch.where(counts, residuals.curvature, 0.0), self._integrals(ones, part)
            gradient += self._spread(torch.where(counts, residuals.slope, 0.0), part)
            # Row sums bound the matrix (De Pierro 1995), and are positive wherever a ray comes by.
            diagonal += self._spread(curvature * way, part)
            self._curvatures.append(curvature)
            self._ways.append(way)
        self._count = max(count, 1)
        gradient, diagonal = gradient / self._count, diagonal / self._count
        self._weights: torch.Tensor | None = None
        if objective.penalises:
            self._weights = cell_weights(mesh, unit * values, *objective.factors(mesh, unit))
            gradient += unit * weighted_square(mesh, unit * values, self._weights).by_density.to(gradient)
        self.loss = loss / self._count + objective.penalty(mesh, unit * values, unit).value
        self._is_held = (values <= 0) & (gradient > 0)
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
        for part, curvature, way in zip(self._pixels(), self._curvatures, self._ways, strict=True):
            along = self._integrals(raised, part) - shift * way
            total += self._spread(curvature * along, part)
        total /= self._count
        if self._weights is not None:
            penalty = weighted_square(self._mesh, self._unit * direction, self._weights)
            total += self._unit * penalty.by_density.to(total)
        return torch.where(self._is_held, 0.0, total)

    @torch.no_grad()
    def _integrals(self, values: torch.Tensor, part: PixelSet) -> torch.Tensor:
        """Line integrals along the rays of some pixels."""
        field = Field(values.new_zeros(len(values), 0), self._unit * values, "vertex")
        return render(self._mesh, field, part.camera).optical_depth

    def _spread(self, worth: torch.Tensor, part: PixelSet) -> torch.Tensor:
        """(V,) derivatives of a sum of line integrals, each with its factor: the adjoint of :meth:`_integrals`."""
        leaf = torch.ones(self._mesh.num_vertices, device=worth.device, dtype=worth.dtype).requires_grad_()
        field = Field(leaf.new_zeros(len(leaf), 0), self._unit * leaf, "vertex")
        depth = render(self._mesh, field, part.camera, deterministic=True).optical_depth
        (spread,) = torch.autograd.grad(depth, leaf, worth)
        return spread


def _dot(first: torch.Tensor, second: torch.Tensor) -> float:
    return float((first.double() * second.double()).sum())
