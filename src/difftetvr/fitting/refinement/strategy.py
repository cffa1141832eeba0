"""What a refinement strategy is, and what the loop and a strategy tell each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import torch

    from difftetvr.mesh.changes.change import MeshChange
    from difftetvr.mesh.tetmesh import TetMesh
    from difftetvr.rendering.gauss_newton import HatChoice, ImageModel

USUAL_VIEWS = 36
"""Views that a refinement is judged on where a strategy does not say how many."""


@dataclass(frozen=True)
class Moment:
    """Where a run stands.

    Attributes:
        iteration: Iterations done.
        iterations: Iterations in all.
        epoch: Iterations of one pass over the training views.
        cells: Cells of the mesh.
        budget: Cells that it may have.
    """

    iteration: int
    iterations: int
    epoch: int
    cells: int
    budget: int

    @property
    def progress(self) -> float:
        """Share of the run that is done, in [0, 1]."""
        return self.iteration / self.iterations


class Model(Protocol):
    """The quadratic models of an error, made when they are asked for; see `Situation`."""

    def __call__(self, hats: HatChoice | None = None) -> ImageModel:
        """The models of some hats; None: of all, but for faces in scans."""
        ...


class EmptySpace(Protocol):
    """Space that is known to be empty."""

    def contains(self, places: torch.Tensor) -> torch.Tensor:
        """(N,) bool, which of (N, 3) places are in it."""
        ...


@dataclass(frozen=True)
class Situation:
    """What a strategy decides upon.

    Attributes:
        mesh: The mesh, detached.
        values: (V, 4) parameters of its vertices: linear RGB in [0, 1], and density in units of the capture's.
        moment: Where the run stands.
        model: The mean over some random training views of the squared error and its quadratic models, in the units of
            ``values``. It takes which hats are of interest, with steps in these units; None: all.
        color_gradients: The sum over all training views of the absolute derivatives of the loss with respect to
            each vertex's colour, (V,).
        free_space: Where densities stay 0.
        reach: Greatest change of a value for which the models are believed.
    """

    mesh: TetMesh
    values: torch.Tensor
    moment: Moment
    model: Model
    color_gradients: Callable[[], torch.Tensor]
    free_space: EmptySpace
    reach: float = math.inf


@dataclass(frozen=True)
class Refinement:
    """What a strategy decided.

    Attributes:
        changes: Changes of the mesh, one after the other.
        surplus: (V', 4) what to add to the values of the vertices after the last change; None: nothing.
        flipped: Flips among the changes.
        predicted: Predicted decrease of the mean squared error of the images; None where nothing is predicted.
    """

    changes: list[MeshChange]
    surplus: torch.Tensor | None = None
    flipped: int = 0
    predicted: float | None = None

    @property
    def added(self) -> int:
        """Vertices that the changes make."""
        return sum(int(change.is_new.sum()) for change in self.changes)

    @property
    def removed(self) -> int:
        """Vertices that the changes take away."""
        growth = sum(change.mesh.num_vertices - change.num_old_vertices for change in self.changes)
        return self.added - growth


class Strategy(Protocol):
    """Decides when and how the mesh changes. A strategy has options but no state: a run can be resumed anywhere."""

    @property
    def views(self) -> int | None:
        """Training views on which a refinement is judged; None: 36."""
        ...

    def initial_cells(self, budget: int) -> int:
        """Cells of the grid to begin with.

        Args:
            budget: Cells that the mesh may have in the end.
        """
        ...

    def is_due(self, moment: Moment) -> bool:
        """Whether to refine before the next iteration."""
        ...

    def lets_move(self, moment: Moment) -> bool:
        """Whether vertices may move in the next iteration."""
        ...

    def refine(self, situation: Situation) -> Refinement | None:
        """Changes of the mesh, None if there is nothing to gain."""
        ...
