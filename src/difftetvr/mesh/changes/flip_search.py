"""Which bistellar flips a mesh admits."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.changes.flip_shapes import FlipCandidates, FlipJudge
from difftetvr.mesh.changes.flips import FOUR_TO_FOUR, THREE_TO_TWO, TWO_TO_THREE, Flips
from difftetvr.mesh.shapes import measure_cells
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import find_edges
from difftetvr.mesh.topology.lookup import are_faces
from difftetvr.mesh.topology.rings import Rings, closed_rings
from difftetvr.recording import eager

_EDGES_AT_ONCE = 2**20


@eager
def find_flips(mesh: TetMesh, *, min_quality: float = 0.1) -> Flips:
    """All flips of a mesh that are possible.

    A flip is possible if all its new cells have positive volume, and quality of at least `min_quality`; where the worst
    cell that vanishes is worse than that, none may be worse than it. The boundary never changes.

    Args:
        mesh: The mesh.
        min_quality: Smallest quality of a new cell (see `difftetvr.mesh.quality`).

    Returns:
        The flips: 2-3 in the order of their faces in `mesh.topology.faces`, then 3-2 and 4-4 in the order of the edges
        that vanish in `mesh.topology.edges`. An edge with four cells around it may have two 4-4 flips.
    """
    judge = FlipJudge(mesh, min_quality)
    candidates = [
        _across_faces(mesh, judge.good_faces()),
        judge.good(_around_edges_of_three(mesh)),
        *(judge.good(part) for part in _around_edges_of_four(judge)),
    ]
    return Flips.joined([judge.flips(of_a_kind.select(_is_new(mesh, of_a_kind))) for of_a_kind in candidates])


def _across_faces(mesh: TetMesh, rows: torch.Tensor) -> FlipCandidates:
    """2-3 flips of some inner faces."""
    ring, cells = (table.index_select(0, rows) for table in (mesh.topology.faces, mesh.topology.face_cells))
    corners = mesh.tets.index_select(0, cells.view(-1)).view(-1, 2, 4)
    # The corner that the face leaves over. A face is counter-clockwise seen from outside its first cell.
    apexes = corners.sum(2) - ring.sum(1, keepdim=True)
    return FlipCandidates(TWO_TO_THREE, rows.int(), cells, apexes.int(), ring)


def _around_edges_of_three(mesh: TetMesh) -> FlipCandidates:
    """3-2 flips of edges with three cells."""
    rings = closed_rings(mesh.topology, 3)
    return FlipCandidates(THREE_TO_TWO, rings.rows, rings.cells, rings.edge, rings.vertices)


def _around_edges_of_four(judge: FlipJudge) -> Iterator[FlipCandidates]:
    """4-4 flips of edges with four cells, to either diagonal of the ring; a part at a time, as there are many."""
    rings = closed_rings(judge.mesh.topology, 4)
    for first in range(0, len(rings.rows), _EDGES_AT_ONCE):
        yield _around_some_of_four(judge, rings.part(slice(first, first + _EDGES_AT_ONCE)))


def _around_some_of_four(judge: FlipJudge, rings: Rings) -> FlipCandidates:
    (u, v), (a, b, c, d) = rings.edge.unbind(1), rings.vertices.unbind(1)
    edge = torch.stack((a, c, b, d), 1).view(-1, 2)
    ring = torch.stack((v, b, u, d, v, c, u, a), 1).view(-1, 4)
    cells = rings.cells[:, [0, 1, 2, 3, 1, 2, 3, 0]].view(-1, 4)
    # The new edge pierces a face at the old one on the side where it passes it. That shall be the first three of the
    # ring, and the first cells those at that face: one with the first end of the edge, one with the second.
    between = torch.cat((ring[:, [2, 0]], edge), 1)
    side, _ = measure_cells(between.t().contiguous(), judge.points)
    other = (side < 0.0)[:, None]
    cells, ring = torch.where(other, cells.flip(1), cells), torch.where(other, ring.roll(2, 1), ring)
    return FlipCandidates(FOUR_TO_FOUR, rings.rows.repeat_interleave(2), cells, edge, ring)


def _is_new(mesh: TetMesh, candidates: FlipCandidates) -> torch.Tensor:
    """(M,) int64, those flips whose edge or face the mesh does not have already."""
    if candidates.kind == THREE_TO_TWO:
        return true_indices(~are_faces(mesh.topology, candidates.ring))
    return true_indices(find_edges(mesh.topology, candidates.edge) < 0)
