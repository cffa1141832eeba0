"""Star subdivision (article section 7): every edge at chosen vertices is split, for any number of vertices at once."""

from __future__ import annotations

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import chunks, constant, true_indices
from difftetvr.mesh.changes.change import MeshChange, check_indices, with_midpoints
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.incidence import cell_edges
from difftetvr.mesh.topology.topology import LOCAL_EDGE_OF, LOCAL_EDGES
from difftetvr.mesh.validation import orientations

# Points of a cell: its corners 0 to 3 in the order of `_canonical`, then the midpoints of `LOCAL_EDGES`, 4 to 9. All
# cells below are positive where 0, 1, 2, 3 is.

_ONE_CHOSEN = ((0, 4, 5, 6), (4, 1, 5, 6), (5, 1, 2, 6), (6, 1, 2, 3))
"""Corner 0 is chosen, 1 < 2 < 3: a tetrahedron at 0 and a prism whose diagonals go to 1, 1 and 2."""

_CORNERS_OF_TWO = ((0, 4, 5, 6), (4, 1, 7, 8), (2, 3, 6, 8))
_TWO_CHOSEN = (
    (*_CORNERS_OF_TWO, (4, 5, 6, 8), (4, 5, 8, 7), (2, 5, 7, 8), (2, 5, 8, 6)),
    (*_CORNERS_OF_TWO, (4, 5, 6, 7), (4, 6, 8, 7), (2, 5, 7, 6), (2, 6, 7, 8)),
)
"""Corners 0 and 1 are chosen, 2 < 3: diagonals to 2; the parallelogram 5, 6, 8, 7 inside has one of two."""

_CORNERS_OF_MORE = ((0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3))
_MORE_CHOSEN = (
    (*_CORNERS_OF_MORE, (4, 9, 5, 6), (4, 9, 6, 8), (4, 9, 8, 7), (4, 9, 7, 5)),
    (*_CORNERS_OF_MORE, (5, 8, 6, 4), (5, 8, 9, 6), (5, 8, 7, 9), (5, 8, 4, 7)),
    (*_CORNERS_OF_MORE, (6, 7, 4, 5), (6, 7, 5, 9), (6, 7, 9, 8), (6, 7, 8, 4)),
)
"""All six edges are split: four corners and an octahedron, cut around its diagonal 4 9, 5 8 or 6 7."""

_TWO_DIAGONALS = ((5, 8), (6, 7))
_MORE_DIAGONALS = ((4, 9), (5, 8), (6, 7))

_CELLS_AFTER = (1, 4, 7, 8, 8)
"""Number of cells that a cell with so many chosen corners becomes."""


def star_subdivision(mesh: TetMesh, vertices: torch.Tensor) -> MeshChange:
    """Split every edge at the chosen vertices in its middle.

    A cell with one chosen corner becomes a tetrahedron at that corner and a prism of three (the article's Fig. 3), one
    with two becomes seven cells, one with three or four becomes eight (its six edges are split).

    The diagonal of a quadrilateral on a face goes to the one of its corners that has the smallest index in the mesh.
    Both cells at the face know it, so they agree. And every prism can be cut so: two of its diagonals meet in its
    corner of smallest index, so the three never follow one another around it; in the article's words, FFF and RRR never
    occur. So its constraint problem needs no solver. Inside a cell, the shortest diagonal is taken.

    Args:
        mesh: The mesh.
        vertices: (N,) integers, the chosen vertices; repetitions do no harm.

    Returns:
        The change, cell_parents ascending. The new vertices are in the order of their edges in `mesh.topology.edges`.
        Around a vertex where rounding of the midpoints to the mesh's precision would flatten a cell, nothing is split.

    Raises:
        MeshError: An index is out of range, or the mesh would have too many cells.
    """
    if vertices.ndim != 1:
        raise MeshError(f"The vertices have shape {tuple(vertices.shape)}; pass (N,) vertex indices.")
    is_chosen = torch.zeros(mesh.num_vertices, dtype=torch.bool, device=mesh.tets.device)
    is_chosen[check_indices(vertices, mesh.num_vertices, "vertex")] = True
    while True:
        change = _subdivide(mesh, is_chosen)
        parents = change.cell_parents
        cut = true_indices(is_chosen.index_select(0, mesh.tets.view(-1)).view(-1, 4).any(1).index_select(0, parents))
        flat = cut[orientations(change.mesh.vertices, change.mesh.tets[cut]) <= 0]
        if not flat.numel():
            return change
        is_chosen[mesh.tets[parents[flat].long()].view(-1).long()] = False


def _subdivide(mesh: TetMesh, is_chosen: torch.Tensor) -> MeshChange:
    tets, edges = mesh.tets, mesh.topology.edges
    is_split = is_chosen.index_select(0, edges.view(-1)).view(-1, 2).any(1)
    midpoint = is_split.cumsum(0, dtype=torch.int32) + (mesh.num_vertices - 1)
    ends = edges[true_indices(is_split)]

    chosen_corners = is_chosen.index_select(0, tets.view(-1)).view(-1, 4).sum(1)
    counts = constant(_CELLS_AFTER, tets.device)[chosen_corners]
    first_child = counts.cumsum(0) - counts
    cell_parents = torch.repeat_interleave(counts)
    new_tets = tets.index_select(0, cell_parents)
    kinds = ((1, 1, (_ONE_CHOSEN,), ()), (2, 2, _TWO_CHOSEN, _TWO_DIAGONALS), (3, 4, _MORE_CHOSEN, _MORE_DIAGONALS))
    positions = mesh.vertices.detach().double()
    for fewest, most, patterns, diagonals in kinds:
        rows = true_indices((chosen_corners >= fewest) & (chosen_corners <= most))
        for part in chunks(rows.shape[0], rows.device, width=10):
            cells = rows[part]
            points, odd = _canonical(mesh, is_chosen, midpoint, cells)
            pattern = _shortest(positions, points, diagonals)
            table = constant(patterns, rows.device)[pattern].view(cells.shape[0], -1)
            children = points.gather(1, table).view(cells.shape[0], -1, 4)
            children[odd] = children[odd][:, :, [0, 1, 3, 2]]
            places = first_child[cells, None] + torch.arange(children.shape[1], device=rows.device)
            new_tets[places.view(-1)] = children.view(-1, 4)
    return with_midpoints(mesh, ends, new_tets, cell_parents.int())


def _canonical(
    mesh: TetMesh, is_chosen: torch.Tensor, midpoint: torch.Tensor, cells: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The ten points of cells, and whether their corners are an odd permutation of the cell's.

    Args:
        mesh: The mesh.
        is_chosen: (V,) bool.
        midpoint: (E,) int32 vertex in the middle of each edge; of edges that are split only.
        cells: (N,) int64.

    Returns:
        (N, 10) int32, chosen corners first, then by index; and (N,) bool.
    """
    corners = mesh.tets[cells].long()
    keys = (~is_chosen[corners]).long() * mesh.num_vertices + corners
    order = keys.sort(1).indices
    inversions = sum((order[:, i] > order[:, j]).int() for i, j in LOCAL_EDGES)
    local_edges = constant(LOCAL_EDGE_OF, cells.device)
    columns = torch.stack([local_edges[order[:, i], order[:, j]] for i, j in LOCAL_EDGES], 1)
    middles = midpoint[cell_edges(mesh.topology)[cells].gather(1, columns).long()]
    return torch.cat((corners.gather(1, order).int(), middles), 1), torch.as_tensor(inversions) % 2 == 1


def _shortest(positions: torch.Tensor, points: torch.Tensor, diagonals: tuple[tuple[int, int], ...]) -> torch.Tensor:
    """(N,) int64, which of the diagonals between midpoints is shortest; the first of equal ones, 0 without any."""
    if not diagonals:
        return torch.zeros(points.shape[0], dtype=torch.int64, device=points.device)
    corners = positions[points[:, :4].long()]
    # Twice the midpoints, relative to the first corner.
    sums = [corners[:, i] + corners[:, j] - 2.0 * corners[:, 0] for i, j in LOCAL_EDGES]
    lengths = [(sums[q - 4] - sums[p - 4]).square().sum(1) for p, q in diagonals]
    return torch.stack(lengths, 1).argmin(1)
