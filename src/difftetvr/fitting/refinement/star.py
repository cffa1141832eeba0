"""The article's refinement: stars of the vertices with the largest colour gradients (sections 7 and 8.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from difftetvr.fitting.options import LARGEST_COUNT, OptionGroup
from difftetvr.fitting.refinement.strategy import Moment, Refinement, Situation

if TYPE_CHECKING:
    import torch

    from difftetvr.mesh.changes.change import MeshChange
    from difftetvr.mesh.tetmesh import TetMesh

_EPOCHS = 2
"""Passes over the training views from one subdivision to the next: first colours alone, then with positions."""


@dataclass(frozen=True)
class Star(OptionGroup):
    """Subdivide around the vertices with the largest absolute colour gradients, accumulated over the training views.

    For one pass over the training views only colours and densities are optimised, for the next one positions too; then
    gradients are accumulated without steps and the mesh is subdivided, until the budget is used up. For comparison:
    the long, thin cells that it makes do not lower the error as `Exchange` does.
    """

    prefix = "star."

    share: float = 0.05
    """Share of the vertices whose stars are subdivided in one round."""
    initial: float = 0.1
    """Cells to begin with, as a share of the budget."""
    views: int = 12
    """Random training views on which the achieved gain is measured."""
    until: float = 0.8
    """Share of the run after which the mesh is not subdivided any more."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(1 <= self.views <= LARGEST_COUNT, "views", f"at least 1 and at most {LARGEST_COUNT}")
        self._require(0 <= self.until <= 1, "until", "between 0 and 1")
        for name in ("share", "initial"):
            self._require(0 < getattr(self, name) <= 1, name, "greater than 0 and at most 1")

    def initial_cells(self, budget: int) -> int:
        """See `Strategy.initial_cells`."""
        return max(1, round(self.initial * budget))

    def is_due(self, moment: Moment) -> bool:
        """See `Strategy.is_due`."""
        due = moment.iteration > 0 and moment.iteration % (_EPOCHS * moment.epoch) == 0
        return due and moment.progress <= self.until and moment.cells < moment.budget

    def lets_move(self, moment: Moment) -> bool:
        """See `Strategy.lets_move`: in every second pass over the views, until the last subdivision."""
        return moment.progress <= self.until and moment.iteration // moment.epoch % _EPOCHS == 1

    def refine(self, situation: Situation) -> Refinement | None:
        """See `Strategy.refine`."""
        mesh, budget = situation.mesh, situation.moment.budget
        ranked = situation.color_gradients().argsort(descending=True, stable=True)
        change = _largest_within(mesh, ranked[: max(1, round(self.share * mesh.num_vertices))], budget)
        if change is None:
            return None
        return Refinement([change])


def _largest_within(mesh: TetMesh, vertices: torch.Tensor, budget: int) -> MeshChange | None:
    """Subdivision of as many of the first vertices as the budget of cells allows, None if of not even one."""
    from difftetvr.mesh.changes.star import star_subdivision  # late: options need no PyTorch

    best, low, high = None, 0, len(vertices)
    count = high
    while low < high:
        change = star_subdivision(mesh, vertices[:count])
        if change.mesh.num_cells <= budget:
            best, low = change, count
        else:
            high = count - 1
        count = (low + high + 1) // 2
    return best
