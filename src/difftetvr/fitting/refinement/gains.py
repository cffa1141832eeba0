"""What changes of the mesh would do to the squared error of its images, predicted one by one.

Everywhere, values are (V, 4) parameters of the vertices: linear RGB in [0, 1] and density >= 0, in the unit that the
derivatives are for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from difftetvr.fitting.refinement.collapse_kernel import costs_of_collapses
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.changes.change import MeshChange
from difftetvr.mesh.changes.flips import TWO_TO_THREE, Flips
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import cells_per_edge, find_edges
from difftetvr.mesh.topology.topology import Topology
from difftetvr.rendering.gauss_newton import HatDerivatives, ImageModel

_DAMPING = 0.01


@dataclass(frozen=True)
class BisectionGains:
    """What bisecting each edge would win.

    Attributes:
        gain: (E,) predicted decrease of the error with the best values at the new vertex.
        start_gain: (E,) the same with the values it starts with.
        start: (E, 4) these values, minus the mean of the edge's ends.
    """

    gain: torch.Tensor
    start_gain: torch.Tensor
    start: torch.Tensor

    def at(self, edges: torch.Tensor) -> BisectionGains:
        """The gains of some edges, (N,) indices; nothing is known of -1, which wins nothing."""
        known = edges >= 0
        return BisectionGains(
            torch.where(known, self.gain[edges], 0.0),
            torch.where(known, self.start_gain[edges], 0.0),
            self.start[edges],
        )


@dataclass(frozen=True)
class Candidates:
    """Edges that may be bisected.

    Attributes:
        edges: (N,) indices into ``topology.edges``.
        is_free: (N,) bool, whose new vertices have to have density 0.
    """

    edges: torch.Tensor
    is_free: torch.Tensor


def bisection_gains(
    mesh: TetMesh,
    values: torch.Tensor,
    edges: HatDerivatives,
    candidates: Candidates,
    start: float = 1.0,
    reach: float = math.inf,
) -> BisectionGains:
    """Predicts what bisecting each edge would win; those that are no candidates win nothing.

    Steps are damped by the mean of the candidates' second derivatives.

    Args:
        mesh: The mesh.
        values: (V, 4) parameters.
        edges: Derivatives by the hats of ``mesh.topology.edges``.
        candidates: Which of them may be bisected.
        start: Part of the best surplus that new vertices start with.
        reach: Greatest surplus that is looked at.
    """
    count, chosen, is_free = mesh.topology.edges.shape[0], candidates.edges, candidates.is_free
    middle = values[mesh.topology.edges[chosen].long()].mean(1)
    most = torch.where(is_free, -middle[:, 3], torch.inf)
    upper = torch.cat((1.0 - middle[:, :3], most[:, None]), 1)
    hats = edges[chosen]
    best = hats.best_step((-middle).clamp(min=-reach), upper.clamp(max=reach), _DAMPING)
    first = start * best
    first[:, 3] = torch.where(is_free, most, first[:, 3])
    found = BisectionGains(*(values.new_zeros(count, *shape) for shape in ((), (), (4,))))
    found.gain[chosen] = hats.decrease(best).clamp_min(0.0)
    found.start_gain[chosen] = hats.decrease(first)
    found.start[chosen] = first
    return found


@dataclass(frozen=True)
class CollapseCosts:
    """Candidates for half-edge collapses, and what each of them would cost.

    Attributes:
        edges: (C,) indices into ``topology.edges``.
        target: (C,) which end stays, 0 or 1.
        cost: (C,) predicted increase of the error.
        cells: (C,) cells that vanish.
    """

    edges: torch.Tensor
    target: torch.Tensor
    cost: torch.Tensor
    cells: torch.Tensor


def collapse_costs(
    mesh: TetMesh, values: torch.Tensor, vertices: HatDerivatives, removable: torch.Tensor, share: float
) -> CollapseCosts:
    """Predicts what merging vertices into their neighbours would cost.

    After a collapse the removed vertex's place has the value that the cells which fill its star interpolate there. The
    cost is that of giving the vertex this value, and of the bends between these cells. The error's slope is left out:
    what a collapse would win by it, a better value of the vertex wins as well. Only vertices that are cheap by a first
    estimate are looked at: the cost of giving them the mean of their neighbours.

    Args:
        mesh: The mesh.
        values: (V, 4) parameters.
        vertices: Derivatives by the vertices' hats.
        removable: (V,) bool, which vertices may go at all.
        share: Share of all vertices to look at, in (0, 1].
    """
    edges = mesh.topology.edges.long()
    estimate = vertices.curvature(_neighbour_mean(edges, values) - values)
    estimate = torch.where(removable, estimate, torch.inf)
    count = min(int(removable.sum()), max(1, round(share * len(values))))
    looked_at = torch.zeros(len(values), dtype=torch.bool, device=values.device)
    looked_at[torch.topk(estimate, count, largest=False).indices] = True
    candidates = [true_indices(looked_at[edges[:, 1 - target]]) for target in (0, 1)]
    rows = torch.cat(candidates)
    target = torch.repeat_interleave(torch.tensor([len(c) for c in candidates], device=rows.device))
    kept = edges[rows].gather(1, target[:, None])[:, 0]
    removed = edges[rows].sum(1) - kept
    cost = costs_of_collapses(mesh, values, vertices, removed, kept).to(values.dtype)
    found = true_indices(torch.isfinite(cost))
    cells = cells_per_edge(mesh.topology)[rows[found]]
    return CollapseCosts(rows[found], target[found], cost[found], cells)


def _neighbour_mean(edges: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    sums, counts = torch.zeros_like(values), torch.zeros_like(values[:, 0])
    for one, other in ((0, 1), (1, 0)):
        sums.index_add_(0, edges[:, one], values[edges[:, other]])
        counts += torch.bincount(edges[:, one], minlength=len(values))
    return sums / counts.clamp_min(1.0)[:, None]


def flip_gains(flips: Flips, surplus: torch.Tensor, model: ImageModel) -> torch.Tensor:
    """Predicts what flips would win.

    A flip changes the field by a surplus where what vanishes and what appears cross, falling to 0 at the outer faces of
    its cells. The gain is that of the hat of the face or edge that vanishes, whose peak is in its centre.

    Args:
        flips: Flips of the mesh that the model is of.
        surplus: (N, 4) what they add to the parameters there, see `Flips.surplus`, in the model's precision.
        model: Derivatives.

    Returns:
        (N,) predicted decrease of the error.
    """
    gain = torch.zeros_like(surplus[:, 0])
    is_by_edge = takes_edge(flips)
    by_face, by_edge = true_indices(~is_by_edge), true_indices(is_by_edge)
    faces, edges = flips.vanishes[by_face].long(), flips.vanishes[by_edge].long()
    if model.faces is None:
        assert model.face_steps is not None
        gain[by_face] = model.face_steps.decrease()[faces]
    else:
        gain[by_face] = model.faces[faces].decrease(surplus[by_face])
    gain[by_edge] = model.edges[edges].decrease(surplus[by_edge])
    return gain


def takes_edge(flips: Flips) -> torch.Tensor:
    """(N,) bool, which flips take an edge away; the others take a face."""
    return flips.kind != TWO_TO_THREE


def face_steps(flips: Flips, surplus: torch.Tensor) -> torch.Tensor:
    """(F, 4) what flips add to the hats of the faces that they take away; 0 for all other faces.

    Args:
        flips: All possible flips of a mesh.
        surplus: (N, 4) what they add to the parameters, see `Flips.surplus`.
    """
    by_face = true_indices(~takes_edge(flips))
    steps = surplus.new_zeros((flips.mesh.topology.faces.shape[0], 4))
    steps[flips.vanishes[by_face].long()] = surplus[by_face]
    return steps


def edges_before(topology: Topology, change: MeshChange) -> torch.Tensor:
    """Which edges of the mesh before a change those after it are.

    Args:
        topology: Cells before the change.
        change: The change.

    Returns:
        (E',) int64 indices into ``topology.edges`` for each of ``change.mesh.topology.edges``; -1 for new ones.
    """
    ends = change.mesh.topology.edges.long()
    old = change.parents[:, 0].long()[ends]
    return torch.where(change.is_new[ends].any(1), -1, find_edges(topology, old))
