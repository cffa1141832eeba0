"""Steps of vertex positions that never leave a valid mesh, as an object for anyone's own loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend, get_backend
from difftetvr.errors import FitError
from difftetvr.fitting.motion import VertexOptimizerConfig
from difftetvr.mesh.arrays import all_of_three
from difftetvr.mesh.boundary import BoundaryConstraint
from difftetvr.mesh.changes.change import MeshChange
from difftetvr.mesh.motion import GuardedMove, cap_move, guard_move
from difftetvr.mesh.shapes import CellShapes, VertexShapes, dot, measure_vertices
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.recording import replayed

_WALL_START = 2.5
"""Where the wall begins, in units of the guard's floor of Q."""
_WALL_STEEPNESS = 100.0
"""Bounds the wall: its weight is this where a cell lies at the floor or under it; the cap takes care of the rest."""

_CONSTRAINT = ("vertices", "tangents", "anchors")


@dataclass(frozen=True)
class StepReport:
    """What became of the steps of one call.

    Attributes:
        moved: Vertices that are elsewhere now.
        capped: Vertices whose step was longer than the cap.
        halved: Vertices whose move the guard shortened.
        refused: Vertices whose move the guard refused.
    """

    moved: int
    capped: int
    halved: int
    refused: int


class VertexOptimizer:
    """Adam for vertex positions that knows the mesh.

    A step goes against the mean gradient, in units of the altitude h of each vertex, plus a shape barrier::

        move = -rate * h * m / sqrt(v) - rate * h^2 * gradient of the sum of -w log Q,   w fixed
        w = barrier + wall * max(2.5 floor - Q, 0) / (Q - floor),   floor = the least Q that the guard allows

    with m and v the first and second moments of h * gradient, v one number for each vertex: that of the vector's
    squared length. So the step does not depend on the unit of length, of the loss or on the axes. It is then
    confined to the boundary, capped and guarded: no cell ever inverts or falls under the floors of the options.
    ::

        positions = VertexOptimizer(mesh)
        for iteration in range(n):
            loss(render(positions.mesh, field, camera)).backward()     # as many views as you like
            report = positions.step(positions.config.rate_at(iteration / n))

    Attributes:
        mesh: The mesh as it is now; its vertices require grad. Every step and every change of the mesh makes a new one,
            so ask for it anew after each.
        config: Options.
        steps: Steps taken so far.
    """

    def __init__(self, mesh: TetMesh, config: VertexOptimizerConfig | None = None) -> None:
        """Starts with a copy of the vertices of a mesh.

        Args:
            mesh: Valid mesh, float32 or float64.
            config: Options; default: those of the Tooth benchmark.
        """
        self.config = config or VertexOptimizerConfig()
        self.steps = 0
        self._first = mesh.vertices.new_zeros((mesh.num_vertices, 3), dtype=torch.float64).detach()
        self._second = self._first[:, 0].clone()
        self.mesh = _adopted(mesh)
        self._constraint: BoundaryConstraint | None = None

    def zero_grad(self) -> None:
        """Forgets the gradients accumulated since the last step."""
        self.mesh.vertices.grad = None

    def step(self, rate: float | None = None) -> StepReport:
        """Moves the vertices by the gradients accumulated since the last step, and forgets those.

        Args:
            rate: Length of the step in altitudes; default: the options' first.

        Returns:
            How many vertices moved, and how many as they wanted.

        Raises:
            FitError: There is no gradient, or it is not finite; nothing has changed then.
        """
        return StepReport(*self.advance(rate).tolist())

    def advance(self, rate: float | None = None) -> torch.Tensor:
        """What :meth:`step` does; its report stays on the device, so that a loop need not wait for it.

        Args:
            rate: As for :meth:`step`.

        Returns:
            (4,) int64, what a :class:`StepReport` holds, in its order.

        Raises:
            FitError: There is no gradient, or it is not finite; nothing has changed then.
        """
        rate = self.config.rate if rate is None else rate
        gradient = self._finite_gradient()
        old = self.mesh.vertices.detach()
        shapes = measure_vertices(self.mesh, self._barrier)
        move, altitudes = self._proposal(gradient, shapes, rate)
        move, capped = cap_move(self._boundary.apply(old, move), altitudes, self.config.cap)
        guarded = self._guarded(move, shapes.cells)
        moved = (~all_of_three(guarded.vertices == old)).sum()
        return torch.stack((moved, capped, guarded.halved, guarded.refused))

    def move_to(self, places: torch.Tensor) -> None:
        """Moves the vertices to other places, each as far as the boundary and the guard let it.

        Moments stay as they are; gradients accumulated since the last step are forgotten.

        Args:
            places: (V, 3) where they shall be, such as the means of where they have been.

        Raises:
            FitError: There is not one place for each vertex; nothing has changed then.
        """
        old = self.mesh.vertices.detach()
        if places.shape != old.shape:
            shapes = tuple(places.shape), tuple(old.shape)
            raise FitError(f"The places have shape {shapes[0]}; pass one for each vertex, {shapes[1]}.")
        self._guarded(self._boundary.apply(old, places.detach().double() - old.double()))

    def carry(self, change: MeshChange) -> None:
        """Follows a change of the mesh's cells; gradients accumulated since the last step are forgotten.

        New vertices start at rest: first moment 0, second moment the mean of the ends of the edge they lie on.

        Args:
            change: What was done to `mesh`.
        """
        first = change.carry(self._first)
        self._first = torch.where(change.is_new[:, None], 0.0, first)
        self._second = change.carry(self._second)
        self.mesh = _adopted(change.mesh)
        self._constraint = None

    def state(self) -> dict[str, torch.Tensor]:
        """All that the next step depends on besides the cells, by name; gradients gathered for it included."""
        gradient = self.mesh.vertices.grad
        return {
            "vertices": self.mesh.vertices.detach(),
            "gradient": torch.zeros_like(self.mesh.vertices.detach()) if gradient is None else gradient,
            "first_moment": self._first,
            "second_moment": self._second,
            "steps": torch.tensor(self.steps),
            **{f"boundary.{name}": getattr(self._boundary, name) for name in _CONSTRAINT},
        }

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """The inverse of :meth:`state`, to the bit, for an optimiser of a mesh with the same cells.

        Args:
            tensors: What :meth:`state` returned; copied.

        Raises:
            FitError: The tensors are missing or are those of another mesh.
        """
        try:
            copies = {name: tensors[name].detach().to(self.mesh.vertices.device, copy=True) for name in self.state()}
        except KeyError as error:
            raise FitError(f"The state of the vertices lacks {error}; pass what state() returned.") from error
        count = self.mesh.num_vertices
        if not copies["vertices"].shape == copies["gradient"].shape == (count, 3) or copies["second_moment"].shape != (
            count,
        ):
            raise FitError(
                f"The saved state has {len(copies['vertices'])} vertices, this mesh has {count}; "
                "restore it on the mesh that it was saved with."
            )
        self.mesh = self.mesh.with_vertices(copies["vertices"].requires_grad_())
        if copies["gradient"].any():
            self.mesh.vertices.grad = copies["gradient"]
        self._first, self._second = copies["first_moment"], copies["second_moment"]
        self.steps = int(copies["steps"])
        self._constraint = BoundaryConstraint(*(copies[f"boundary.{name}"] for name in _CONSTRAINT))

    @property
    def _boundary(self) -> BoundaryConstraint:
        """Where the boundary may go: found before the next step, as several changes may follow each other."""
        if self._constraint is None:
            slides = self.config.boundary == "slide"
            self._constraint = (
                BoundaryConstraint.sliding(self.mesh, self.config.coplanarity)
                if slides
                else BoundaryConstraint.fixed(self.mesh)
            )
        return self._constraint

    def _guarded(self, move: torch.Tensor, before: CellShapes | None = None) -> GuardedMove:
        """Moves the vertices by what the guard allows of a (V, 3) move."""
        guarded = guard_move(self.mesh, move, self.config.limits, before)
        self.mesh = self.mesh.with_vertices(guarded.vertices.requires_grad_())
        return guarded

    def _finite_gradient(self) -> torch.Tensor:
        """(V, 3)."""
        gradient = self.mesh.vertices.grad
        if gradient is None:
            raise FitError("No gradient has reached the vertices; call backward() on a rendering of optimizer.mesh.")
        finite = torch.isfinite(gradient)
        if not finite.all():
            vertex = int(torch.nonzero(~finite)[0, 0])
            raise FitError(f"The gradient of vertex {vertex} is {gradient[vertex].tolist()}; make the loss finite.")
        return gradient

    def _proposal(self, gradient: torch.Tensor, shapes: VertexShapes, rate: float) -> tuple[torch.Tensor, torch.Tensor]:
        """(V, 3) float64 moves that loss and barrier ask for, and (V,) altitudes; advances the moments."""
        self.steps += 1
        if not len(gradient):
            return self._first, self._second
        backend = get_backend(str(gradient.device), torch.float64)
        with backend.exclusive():
            moments = _Moments(
                backend,
                backend.floats(gradient),  # which PyTorch widens: kernels take the shortest numbers of float32 for 0
                backend.floats(self._first),
                backend.floats(self._second),
                backend.floats(shapes.sums),
                backend.floats(shapes.cells.scale),
                [backend.constant(beta) for beta in self.config.betas],
            )
            corrections = [1.0 / (1.0 - beta**self.steps) for beta in self.config.betas]
            found = replayed(_propose, moments, *(backend.opaque(number) for number in (rate, *corrections)))
            backend.run(found)
            columns = [backend.tensor(column) for column in found]
        self._first, self._second = torch.stack(columns[3:6], 1), columns[6]
        return torch.stack(columns[:3], 1), columns[7]

    @property
    def _barrier(self) -> _Barrier:
        return _Barrier(self.config.barrier, self.config.wall, self.config.limits.quality)


def _adopted(mesh: TetMesh) -> TetMesh:
    """A copy of a mesh for gradients to gather in."""
    return mesh.with_vertices(mesh.vertices.detach().clone().requires_grad_())


@dataclass(frozen=True)
class _Barrier:
    """Weight of -log Q of cells by their quality Q, in kernels; the attributes are options."""

    everywhere: float
    wall: float
    floor: float

    def __call__(self, quality: Any) -> Any:
        start = _WALL_START * self.floor
        least = max((start - self.floor) / _WALL_STEEPNESS, torch.finfo(torch.float64).tiny)
        nearness = dr.fmax(start - quality, 0.0) / dr.fmax(quality - self.floor, least)
        return dr.fma(nearness, self.wall, self.everywhere)


# ---- Kernels


@dataclass
class _Moments:
    """What moves are made from, flat.

    Attributes:
        backend: Array types, float64.
        gradient: (V, 3) of the loss.
        first: (V, 3) means of gradients in units of the loss.
        second: (V,) means of their squared lengths.
        sums: (V, 4) see `VertexShapes`.
        scale: (1,) unit of these.
        decays: Of both moments, as device values.
    """

    backend: Backend
    gradient: Any
    first: Any
    second: Any
    sums: Any
    scale: Any
    decays: list[Any]


def _propose(moments: _Moments, rate: Any, correction: Any, correction_of_squares: Any) -> list[Any]:
    """Of each vertex three numbers for the move that loss and barrier ask for, three for the first moment, the second
    moment, and the altitude.
    """
    real, axes = moments.backend.Float, range(3)
    vertex = dr.arange(moments.backend.UInt, dr.width(moments.second))
    *pull, altitude = dr.gather(moments.backend.Float4, moments.sums, vertex)
    altitude = altitude / moments.scale
    gradient = [dr.gather(real, moments.gradient, dr.fma(vertex, 3, k)) for k in axes]
    scaled = [altitude * g for g in gradient]
    first = [dr.lerp(scaled[k], dr.gather(real, moments.first, dr.fma(vertex, 3, k)), moments.decays[0]) for k in axes]
    second = dr.lerp(dot(scaled, scaled), moments.second, moments.decays[1])
    # Where no gradient has ever been, moments are exactly zero: no epsilon, which would have the loss's unit.
    length = dr.sqrt(second * correction_of_squares)
    step = dr.select(length > 0.0, -rate * altitude * correction / length, 0.0)
    push = rate * altitude * altitude * moments.scale
    pull = [push * p for p in pull]
    move = [dr.fma(step, first[k], dr.select(dr.isfinite(pull[k]), -pull[k], 0.0)) for k in axes]
    dr.eval(move, first, second, altitude)
    return [*move, *first, second, altitude]
