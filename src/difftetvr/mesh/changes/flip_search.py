"""Which bistellar flips a mesh admits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch

from difftetvr.mesh import quality
from difftetvr.mesh.arrays import chunks, true_indices
from difftetvr.mesh.changes.flips import FOUR_TO_FOUR, THREE_TO_TWO, TWO_TO_THREE, Flips, cells_after
from difftetvr.mesh.shapes import corner_columns, length_scale, measure_cells, scaled_points
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import find_edges, stars
from difftetvr.mesh.topology.rings import closed_rings

_WIDTH = 1
"""Numbers for each flip in the temporaries of a chunk."""


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
    points = scaled_points(mesh.vertices, length_scale(mesh.vertices))
    shapes = _Shapes(mesh, points, *measure_cells(corner_columns(mesh.topology), points), min_quality)
    sources = _across_faces(mesh), _around_edges_of_three(mesh), _around_edges_of_four(mesh, points)
    flips = Flips.joined([_possible(shapes, candidates) for source in sources for candidates in source])
    return flips.select(~_is_there(flips))


@dataclass(frozen=True)
class _Shapes:
    """What candidates are judged by: positions, volumes and qualities as `measure_cells` has them, and the floor."""

    mesh: TetMesh
    points: torch.Tensor
    determinants: torch.Tensor
    qualities: torch.Tensor
    min_quality: float


@dataclass(frozen=True)
class _Candidates:
    """Flips of one kind that the topology admits; for `cells`, `edge` and `ring` see `Flips`, here without filling."""

    kind: int
    cells: torch.Tensor
    edge: torch.Tensor
    ring: torch.Tensor


def _across_faces(mesh: TetMesh) -> Iterator[_Candidates]:
    """2-3 flips of inner faces."""
    faces, face_cells = mesh.topology.faces, mesh.topology.face_cells
    for part in chunks(faces.shape[0], faces.device, width=_WIDTH):
        rows = true_indices(face_cells[part, 1] >= 0)
        ring, cells = faces[part][rows], face_cells[part][rows]
        corners = mesh.tets.index_select(0, cells.view(-1)).view(-1, 2, 4)
        # The corner that the face leaves over. A face is counter-clockwise seen from outside its first cell.
        apexes = corners.sum(2) - ring.sum(1, keepdim=True)
        yield _Candidates(TWO_TO_THREE, cells, apexes.int(), ring)


def _around_edges_of_three(mesh: TetMesh) -> Iterator[_Candidates]:
    """3-2 flips of edges with three cells."""
    edge, ring, cells = closed_rings(mesh.topology, 3)
    for part in chunks(edge.shape[0], edge.device, width=_WIDTH):
        yield _Candidates(THREE_TO_TWO, cells[part], edge[part], ring[part])


def _around_edges_of_four(mesh: TetMesh, points: torch.Tensor) -> Iterator[_Candidates]:
    """4-4 flips of edges with four cells, to either diagonal of the ring."""
    old_edge, old_ring, old_cells = closed_rings(mesh.topology, 4)
    (u, v), (a, b, c, d) = old_edge.unbind(1), old_ring.unbind(1)
    edges = torch.stack((a, c, b, d), 1).view(-1, 2)
    rings = torch.stack((v, b, u, d, v, c, u, a), 1).view(-1, 4)
    all_cells = old_cells[:, [0, 1, 2, 3, 1, 2, 3, 0]].view(-1, 4)
    for part in chunks(edges.shape[0], edges.device, width=_WIDTH):
        edge, ring, cells = edges[part], rings[part], all_cells[part]
        # The new edge pierces a face at the old one on the side where it passes it. That shall be the first three of
        # the ring, and the first cells those at that face: one with the first end of the edge, one with the second.
        side, _ = _measure(points, torch.cat((ring[:, [2, 0]], edge), 1))
        other = (side < 0.0)[:, None]
        cells, ring = torch.where(other, cells.flip(1), cells), torch.where(other, ring.roll(2, 1), ring)
        yield _Candidates(FOUR_TO_FOUR, cells, edge, ring)


def _possible(shapes: _Shapes, candidates: _Candidates) -> Flips:
    """Those candidates whose new cells are good enough."""
    new = cells_after(candidates.kind, candidates.edge, candidates.ring)
    determinants, after = _measure(shapes.points, new)
    after = after.amin(0)
    before = _of_cells(shapes.qualities, candidates.cells).amin(0)
    rows = true_indices((after > quality.FLAT) & (after >= before.clamp_max(shapes.min_quality)))
    cells, edge, ring = (
        indices.index_select(0, rows) for indices in (candidates.cells, candidates.edge, candidates.ring)
    )
    old_determinants = _of_cells(shapes.determinants, cells)
    weight, face_weights = _crossing(candidates.kind, old_determinants, determinants.index_select(1, rows))
    return Flips(
        mesh=shapes.mesh,
        kind=torch.full_like(edge[:, 0], candidates.kind, dtype=torch.int8),
        cells=_filled(cells),
        edge=edge,
        ring=_filled(ring),
        weight=weight,
        face_weights=face_weights,
        quality_before=before[rows],
        quality_after=after[rows],
    )


def _of_cells(values: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    """(K, N) values of the cells (N, K)."""
    return values.index_select(0, cells.t().reshape(-1)).view(cells.shape[1], -1)


def _measure(points: torch.Tensor, cells: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Determinants and qualities, of the leading shape of `cells` (..., 4), which need not be those of a mesh."""
    determinants, qualities = measure_cells(cells.view(-1, 4).t().contiguous(), points)
    return determinants.view(cells.shape[:-1]), qualities.view(cells.shape[:-1])


def _crossing(kind: int, before: torch.Tensor, after: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the edge of flips pierces their face: `weight` and `face_weights` of `Flips`.

    The edge is divided as the volumes of the cells that join the face to its ends, and the face as those of the cells
    that join the edge to its sides.

    Args:
        kind: Kind of the flips.
        before: (K, N) determinants of the cells that vanish.
        after: (M, N) determinants of the cells that appear.
    """
    # An old cell may be so thin that rounding takes its volume for negative.
    before = before.clamp_min(0.0)
    at_ends, at_sides = (after, before) if kind == THREE_TO_TWO else (before[:2], after)
    length = at_ends.sum(0)
    ab, bc, ca = at_sides[:3]
    if kind == FOUR_TO_FOUR:
        # The cell between the two edges is none of the mesh's, and has no volume where they cross.
        ca = (length - ab - bc).clamp_min(0.0)
    # A corner weighs as much as the side opposite it.
    return at_ends[0] / length, torch.stack((bc, ca, ab), 1) / (ab + bc + ca)[:, None]


def _filled(indices: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.pad(indices, (0, 4 - indices.shape[1]), value=-1)


def _is_there(flips: Flips) -> torch.Tensor:
    """(N,) bool: the mesh has the edge or face already that a flip would make."""
    topology = flips.mesh.topology
    makes_face = flips.kind == THREE_TO_TWO
    is_there = (find_edges(topology, flips.edge.long()) >= 0) & ~makes_face
    rows = true_indices(makes_face)
    for part in chunks(rows.shape[0], rows.device, width=_WIDTH):
        first, *others = flips.ring.index_select(0, rows[part]).unbind(1)[:3]
        owner, cells = stars(topology, first.long())
        corners = topology.tets.index_select(0, cells).unbind(1)
        has_face = torch.ones_like(owner, dtype=torch.bool)
        for vertex in others:
            wanted = vertex.index_select(0, owner)
            has_face &= (
                (corners[0] == wanted) | (corners[1] == wanted) | (corners[2] == wanted) | (corners[3] == wanted)
            )
        is_there[rows[part]] = torch.bincount(owner[has_face], minlength=first.shape[0]) > 0
    return is_there
