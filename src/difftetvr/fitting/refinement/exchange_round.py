"""One round of `Exchange`: flips, collapses and bisections, chosen by what they are predicted to win."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from difftetvr.fitting.refinement.gains import (
    Candidates,
    CollapseCosts,
    bisection_gains,
    collapse_costs,
    edges_before,
    face_steps,
    flip_gains,
    takes_edge,
)
from difftetvr.fitting.refinement.strategy import Refinement, Situation
from difftetvr.mesh.arrays import chunks, sort_keys, true_indices
from difftetvr.mesh.boundary import removable_vertices
from difftetvr.mesh.changes.bisection import bisect_edges, independent_edges, long_edges
from difftetvr.mesh.changes.change import MeshChange
from difftetvr.mesh.changes.collapse import collapse_edges
from difftetvr.mesh.changes.flip_search import find_flips
from difftetvr.mesh.changes.flips import THREE_TO_TWO, TWO_TO_THREE, Flips, apply_flips, independent_flips
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import cell_edges, cells_per_edge, find_edges
from difftetvr.rendering.gauss_newton import HatChoice, ImageModel

if TYPE_CHECKING:
    from difftetvr.fitting.refinement.exchange import Exchange

_LOOKED_AT = 5.0
"""Vertices whose collapse is priced, in units of those that may vanish."""

_ROW_BITS = 32


def exchange_cells(situation: Situation, target: int, options: Exchange) -> Refinement | None:
    """Changes of the mesh that together leave at most ``target`` cells, None if there is nothing to gain.

    Args:
        situation: What to decide upon.
        target: Cells afterwards.
        options: How much of what.
    """
    mesh = situation.mesh
    flips = _PossibleFlips.of(mesh, situation.values, options.min_quality) if options.flips else None
    may_bisect = long_edges(mesh, options.long)
    model = situation.model(_hats_of(mesh, situation.values, may_bisect, flips))
    exchange = _Round(situation, model, may_bisect, options)
    if flips is not None:
        exchange.flip(flips, model, target, options)
    if options.share:
        exchange.collapse(model, options)
    exchange.bisect(target)
    return exchange.refinement()


def _hats_of(mesh: TetMesh, values: torch.Tensor, may_bisect: torch.Tensor, flips: _PossibleFlips | None) -> HatChoice:
    """What has to be known: of edges that may be bisected, and of what flips would take away."""
    if flips is None:
        return HatChoice(may_bisect, values.new_zeros((mesh.topology.faces.shape[0], 4)))
    edges = flips.possible.vanishes[true_indices(takes_edge(flips.possible))].long()
    return HatChoice(may_bisect.index_fill(0, edges, True), face_steps(flips.possible, flips.surplus))


@dataclass(frozen=True)
class _PossibleFlips:
    """All possible flips of a mesh, and (N, 4) what they add to the parameters, see `Flips.surplus`."""

    possible: Flips
    surplus: torch.Tensor

    @staticmethod
    def of(mesh: TetMesh, values: torch.Tensor, min_quality: float) -> _PossibleFlips:
        """Looks for them."""
        flips = find_flips(mesh, min_quality=min_quality)
        return _PossibleFlips(flips, flips.surplus(values.to(mesh.vertices.dtype)))  # the precision of models

    def worthwhile(self, gain: torch.Tensor, reach: float) -> tuple[Flips, torch.Tensor]:
        """Those that win something, with what they win; of changes that are too great nothing is known."""
        rows = true_indices((gain > 0) & (self.surplus.abs().amax(1) <= reach))
        return self.possible.select(rows), gain[rows]


class _Round:
    """The mesh so far, and what is known about its edges."""

    def __init__(self, situation: Situation, model: ImageModel, may_bisect: torch.Tensor, options: Exchange) -> None:
        self.mesh = situation.mesh
        self.values = situation.values.to(model.edges.gradient.dtype)
        edges = true_indices(may_bisect)
        middles = self.mesh.vertices[self.mesh.topology.edges[edges].long()].mean(1)
        candidates = Candidates(edges, situation.free_space.contains(middles))
        self.gains = bisection_gains(self.mesh, self.values, model.edges, candidates, options.start, situation.reach)
        self.reach = situation.reach
        self.surplus: torch.Tensor | None = None
        self.changes: list[MeshChange] = []
        self.predicted = 0.0
        self.flipped = 0

    def flip(self, flips: _PossibleFlips, model: ImageModel, target: int, options: Exchange) -> None:
        """Cut the same space otherwise where that fits the images better."""
        # A 2-3 flip makes a cell more, a 3-2 flip one less: one that a bisection could use.
        kind = flips.possible.kind
        cells = torch.where(kind == TWO_TO_THREE, 1, torch.where(kind == THREE_TO_TWO, -1, 0))
        gain = flip_gains(flips.possible, flips.surplus, model) - self._price_of_a_cell(options) * cells
        chosen = independent_flips(*flips.worthwhile(gain, self.reach))
        # What collapses cannot take away again must not be added.
        room = max(0, target - self.mesh.num_cells) + int(options.share * self.mesh.num_cells)
        adds = (chosen.kind == TWO_TO_THREE).int()
        chosen = chosen.select(adds.cumsum(0) * adds <= room)
        self.flipped = len(chosen)
        self.predicted += float(flip_gains(chosen, chosen.surplus(self.values), model).sum())
        change = apply_flips(chosen)
        self._carry_edges(change, _changed_cells(self.mesh, change))
        self._apply(change)

    def collapse(self, model: ImageModel, options: Exchange) -> None:
        """Take the cheapest cells away."""
        share = min(1.0, _LOOKED_AT * options.share)
        removable = removable_vertices(self.mesh, slide=options.boundary == "slide")
        costs = collapse_costs(self.mesh, self.values, model.vertices, removable, share)
        change = collapse_edges(
            self.mesh,
            costs.edges,
            costs.target,
            costs.cost / costs.cells,
            limit=int(options.share * self.mesh.num_cells),
            min_quality=options.min_quality,
            boundary=options.boundary,
        )
        changed = _changed_cells(self.mesh, change)
        self.predicted -= _cost_of(costs, self.mesh, change, changed)
        self._carry_edges(change, changed)
        self._apply(change)

    def bisect(self, target: int) -> None:
        """Bisect the most promising edges until there are as many cells as wanted."""
        topology = self.mesh.topology
        ends = topology.edges.long()
        positions = self.mesh.vertices
        length = torch.linalg.vector_norm(positions[ends[:, 1]] - positions[ends[:, 0]], dim=1)
        gain = self.gains.gain
        budget = max(0, target - self.mesh.num_cells)
        # Gain per new cell; long edges come first, which keeps shapes good. What wins anything may be bisected: gains
        # are those of edges that are long among their cells, and known only while these are the same.
        chosen = independent_edges(self.mesh, gain / cells_per_edge(topology) * length, gain > 0, budget)
        change = bisect_edges(self.mesh, chosen)
        done = find_edges(topology, change.parents[change.is_new].long())
        self.surplus = torch.zeros_like(change.carry(self.values))
        self.surplus[change.is_new] = self.gains.start[done]
        self.predicted += float(self.gains.start_gain[done].sum())
        self._apply(change)

    def refinement(self) -> Refinement | None:
        """What came of it."""
        refinement = Refinement(self.changes, self.surplus, self.flipped, self.predicted)
        return refinement if self.flipped + refinement.removed + refinement.added else None

    def _price_of_a_cell(self, options: Exchange) -> float:
        """Gain per new cell of the last bisection among the best that one round can pay for."""
        cells = cells_per_edge(self.mesh.topology)
        gain, order = (self.gains.gain / cells).sort(descending=True)
        affordable = cells[order].cumsum(0) <= max(1.0, options.share * self.mesh.num_cells)
        return float(gain[max(0, int(affordable.sum()) - 1)])

    def _apply(self, change: MeshChange) -> None:
        self.changes.append(change)
        self.values = change.carry(self.values)
        self.mesh = change.mesh

    def _carry_edges(self, change: MeshChange, changed: torch.Tensor) -> None:
        """What was predicted for an edge holds while its cells are the same; those that are not are given."""
        before = edges_before(self.mesh.topology, change)
        before[cell_edges(change.mesh.topology)[changed].view(-1).long()] = -1
        self.gains = self.gains.at(before)


def _changed_cells(mesh: TetMesh, change: MeshChange) -> torch.Tensor:
    """Cells after a change that adds no vertices which have other corners than before."""
    new, parents, olds = change.mesh.tets, change.cell_parents, change.parents[:, 0]
    has_changed = torch.empty(len(new), dtype=torch.bool, device=new.device)
    for part in chunks(len(new), new.device, width=4):
        before = mesh.tets.index_select(0, parents[part])
        after = olds.index_select(0, new[part].view(-1)).view_as(before)
        has_changed[part] = (before != after).any(1)
    return true_indices(has_changed)


def _cost_of(costs: CollapseCosts, mesh: TetMesh, change: MeshChange, changed: torch.Tensor) -> float:
    """Sum of the predicted costs of the collapses that a change has made, by the (N,) cells that it has changed."""
    before = mesh.tets[change.cell_parents[changed].long()].long()
    after = change.parents[:, 0][change.mesh.tets[changed].long()].long()
    moved = before != after
    collapses = torch.unique_consecutive(sort_keys((before[moved] << _ROW_BITS) | after[moved]))
    pairs = torch.stack((collapses >> _ROW_BITS, collapses & ((1 << _ROW_BITS) - 1)), 1)
    kept = pairs[:, 1]
    edges = find_edges(mesh.topology, pairs)
    by_half_edge = torch.full(
        (2 * mesh.topology.edges.shape[0],), torch.nan, dtype=costs.cost.dtype, device=kept.device
    )
    by_half_edge[2 * costs.edges + costs.target] = costs.cost
    return float(by_half_edge[2 * edges + (mesh.topology.edges[edges, 1] == kept)].sum())
