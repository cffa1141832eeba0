"""Making a valid, conforming mesh of one that is almost valid: repeated positions, repeated cells, flat cells.

Simulation meshes come with such cells: where the axis of a curvilinear grid is a line, cells have lost an edge; where
a mesher left a sliver, four vertices lie in one plane. `TetMesh` refuses them; this is the way to mend them, asked for
by name, with a report of everything that changed. Everything here is exact: what counts as coincident is equal to the
bit, what counts as flat has a volume of exactly zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from difftetvr.errors import MeshError, counted
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.making.lifting import lift_flat_cells
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.faces import LOCAL_FACES, face_vertices, match_faces
from difftetvr.mesh.validation import as_tets, as_vertices, check_finite, orientations


@dataclass(frozen=True)
class RepairReport:
    """What a repair changed; its text is one or two sentences.

    Attributes:
        merged_vertices: Vertices that were merged into another one at the same position.
        collapsed_cells: Cells that were dropped as they used a vertex twice, after merging.
        repeated_cells: Cells that were dropped as another one has the same vertices.
        dropped_cells: Flat cells that were dropped from the boundary, which leaves its shape as it is.
        dropped_vertices: Vertices that were dropped as only dropped cells used them.
        lifted_cells: Flat cells inside that got a volume by moving a vertex.
        moved_vertices: Vertices that were moved for it.
        largest_move: Length of the longest of these moves, in units of length.
        relative_move: The same in diagonals of the mesh's bounding box.
        touching_edges: Edges where the boundary of the repaired mesh touches itself. Nothing is wrong with them, but
            where the sides of a cut through a grid have other diagonals, cells meet there without sharing a face.
    """

    merged_vertices: int = 0
    collapsed_cells: int = 0
    repeated_cells: int = 0
    dropped_cells: int = 0
    dropped_vertices: int = 0
    lifted_cells: int = 0
    moved_vertices: int = 0
    largest_move: float = 0.0
    relative_move: float = 0.0
    touching_edges: int = 0

    @property
    def changed(self) -> bool:
        """Whether the repaired mesh is another one than that which was given."""
        return any(
            (
                self.merged_vertices,
                self.collapsed_cells,
                self.repeated_cells,
                self.dropped_cells,
                self.moved_vertices,
                self.dropped_vertices,
            )
        )

    def __str__(self) -> str:
        """What changed, in words."""
        flat = f"{counted(self.lifted_cells, 'flat cell', 'flat cells')} got a volume by moving "
        way = f"by at most {self.largest_move:.3g} ({self.relative_move:.1e} of the mesh's diagonal)"
        parts = [
            (
                self.merged_vertices,
                "vertex was merged with another|vertices were merged with others",
                "at the same place",
            ),
            (self.collapsed_cells, "cell that used a vertex twice was|cells that used a vertex twice were", "dropped"),
            (self.repeated_cells, "cell that repeated another was|cells that repeated another were", "dropped"),
            (self.dropped_cells, "flat cell on the boundary was|flat cells on the boundary were", "dropped"),
            (self.dropped_vertices, "vertex that is unused now was|vertices that are unused now were", "dropped"),
        ]
        said = [f"{counted(count, *words.split('|'))} {what}" for count, words, what in parts if count]
        if self.lifted_cells:
            said.append(f"{flat}{counted(self.moved_vertices, 'vertex', 'vertices')} {way}")
        text = " and ".join(filter(None, (", ".join(said[:-1]), *said[-1:]))) or "nothing had to be changed"
        text = f"{text[:1].upper()}{text[1:]}."
        if self.touching_edges:
            edges = counted(self.touching_edges, "edge", "edges")
            text += f" The boundary touches itself along {edges}, where cells may share no face."
        return text


@dataclass(frozen=True)
class Repaired:
    """A valid mesh, and how to carry data over to it.

    Attributes:
        mesh: The mesh; vertices and cells are in their old order.
        vertex_map: (V,) int64, the new index of each old vertex, -1 where it was dropped.
        vertex_origins: (V',) int64, the old vertex that each new one is; the first of those that were merged.
        cell_origins: (T',) int64, the old cell that each new one is.
        report: What changed.
    """

    mesh: TetMesh
    vertex_map: torch.Tensor
    vertex_origins: torch.Tensor
    cell_origins: torch.Tensor
    report: RepairReport


def repair(vertices: Any, tets: Any) -> Repaired:
    """Mend repeated vertices, repeated cells and flat cells.

    In this order: vertices at exactly the same position become the first of them; cells that use a vertex twice then
    are dropped, as are copies of a cell; flat cells are dropped from the boundary inwards, wherever one whole side of
    theirs belongs to it; of the flat cells that are left inside one vertex each is moved, rather one that is not on the
    boundary, and no farther than it takes to give them an altitude of a thousandth of their longest edge. No cell
    loses more than half of its volume by that, so that all stay positive. Unused vertices are dropped.

    Merging closes slits whose sides have the same vertices; values on both sides that differed become the first one's.

    Args:
        vertices: (V, 3) positions, array-like, as for `TetMesh`; detached.
        tets: (T, 4) integer vertex indices, array-like.

    Returns:
        The mesh on the CPU in the precision of the vertices, the maps and the report.

    Raises:
        MeshError: Shapes, indices or positions that `TetMesh` refuses, too; flat cells that no move of a vertex can
            mend; or neighbours that overlap, which is not repaired.
    """
    points = as_vertices(vertices).detach().cpu().clone()
    given = as_tets(tets, points.shape[0], torch.device("cpu"))
    check_finite(points, given)
    representative = _merge(points, given)
    merged = int((representative != torch.arange(points.shape[0])).sum())
    cells = representative[given.long()].int()

    kept = true_indices(~_repeats_a_vertex(cells))
    collapsed = given.shape[0] - kept.numel()
    kept = kept[_first_of_copies(cells[kept])]
    repeated = given.shape[0] - collapsed - kept.numel()
    kept, oriented, flat = _without_flat_hull(points, cells, kept)
    dropped = given.shape[0] - collapsed - repeated - kept.numel()
    if not kept.numel():
        raise MeshError(
            "Every cell of the mesh is flat or repeats a vertex, so nothing is left; give a mesh with volume."
        )

    lifted = int(flat.sum())
    moved = lift_flat_cells(points, oriented, flat) if lifted else points
    moves = torch.linalg.vector_norm((moved - points).double(), dim=1)
    used = torch.unique(oriented).long()
    new_index = torch.full((points.shape[0],), -1)
    new_index[used] = torch.arange(used.numel())
    try:
        mesh = TetMesh(moved[used], new_index[oriented.long()])
    except MeshError as error:
        raise MeshError(f"The mesh cannot be repaired, as after mending its flat cells: {error}") from error
    before = torch.unique(representative[given.long()]).numel()
    diagonal = float(torch.linalg.vector_norm((points.amax(0) - points.amin(0)).double()))
    report = RepairReport(
        merged_vertices=merged,
        collapsed_cells=collapsed,
        repeated_cells=repeated,
        dropped_cells=dropped,
        dropped_vertices=before - used.numel(),
        lifted_cells=lifted,
        moved_vertices=int((moves > 0).sum()),
        largest_move=float(moves.max()),
        relative_move=float(moves.max()) / diagonal,
        touching_edges=_touching_edges(mesh),
    )
    return Repaired(mesh, new_index[representative], used, kept, report)


def _merge(points: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    """(V,) int64: the first used vertex at the position of each used one; unused ones stand for themselves."""
    representative = torch.arange(points.shape[0])
    used = torch.unique(tets).long().numpy()
    positions = points.numpy()[used] + 0.0  # which makes -0 a 0
    order = np.lexsort((used, *positions.T))
    runs = positions[order]
    starts = np.r_[True, (runs[1:] != runs[:-1]).any(1)]
    first = used[order[starts]][np.cumsum(starts) - 1]
    representative[torch.from_numpy(used[order])] = torch.from_numpy(first)
    return representative


def _repeats_a_vertex(cells: torch.Tensor) -> torch.Tensor:
    ordered = cells.sort(1).values
    return (ordered[:, 1:] == ordered[:, :-1]).any(1)


def _first_of_copies(cells: torch.Tensor) -> torch.Tensor:
    """Ascending rows of the first cell of each set of four vertices."""
    ordered = np.sort(cells.numpy(), axis=1)
    order = np.lexsort((np.arange(len(ordered)), *ordered.T))
    runs = ordered[order]
    is_first = np.ones(len(runs), dtype=bool)
    is_first[1:] = (runs[1:] != runs[:-1]).any(1)
    return torch.from_numpy(np.sort(order[is_first]))


def _without_flat_hull(
    points: torch.Tensor, cells: torch.Tensor, kept: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Drops flat cells from the boundary inwards.

    Returns:
        Rows of the cells that are left, (T', 4) int32 these cells with positive orientation, flat ones as their
        neighbours say, and (T',) bool which of them are flat.
    """
    signs = orientations(points, cells[kept])
    oriented = cells[kept]
    oriented[signs < 0] = oriented[signs < 0][:, [0, 1, 3, 2]]
    flat = signs == 0
    sides = torch.zeros((kept.numel(), 4), dtype=torch.int8)
    if flat.any():
        sides[flat] = _sides(points, oriented[flat])
    while flat.any():
        matching = match_faces(oriented, points.shape[0])
        outer = matching.cell_adjacency < 0
        # A flat cell has two sides. Where all faces of one are on the boundary, the other takes over its place exactly.
        bare = (outer | (sides <= 0)).all(1) | (outer | (sides >= 0)).all(1)
        stays = ~(flat & bare)
        if stays.all():
            return kept, _orient_like_neighbours(oriented, flat, points.shape[0]), flat
        kept, oriented, flat, sides = kept[stays], oriented[stays], flat[stays], sides[stays]
    return kept, oriented, flat


def _sides(points: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    """(N, 4) int8: which side of a flat cell's plane the face opposite vertex k looks to; 0 where it has no area.

    These are exact signs of areas, of the projection along a coordinate axis that leaves some.
    """
    corners = points.double()[cells.long()]
    height = corners.abs().max().clamp_min(torch.finfo(torch.float64).tiny)
    sides = torch.zeros((cells.shape[0], 4), dtype=torch.int8)
    numbers = torch.arange(4 * cells.shape[0], dtype=torch.int32).view(-1, 4)
    for axes in ((0, 1), (1, 2), (2, 0)):
        base = torch.cat((corners[..., list(axes)], torch.zeros_like(corners[..., :1])), 2).view(-1, 3)
        # Over each face a tetrahedron up to its lifted first corner: its volume has the sign of the face's area.
        lifted = base + torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) * height
        faces = torch.stack([numbers[:, list(face)] for face in LOCAL_FACES], 1).view(-1, 3)
        wedges = torch.cat((faces, faces[:, :1] + numbers.numel()), 1)
        signs = orientations(torch.cat((base, lifted)), wedges).view(-1, 4)
        sides = torch.where((sides == 0).all(1, keepdim=True), signs, sides)
    return sides


def _orient_like_neighbours(cells: torch.Tensor, flat: torch.Tensor, num_vertices: int) -> torch.Tensor:
    """Gives flat cells, whose volume has no sign, the orientation that fits the cells around them."""
    cells, known = cells.clone(), ~flat
    while not known.all():
        matching = match_faces(cells, num_vertices)
        folded = torch.zeros(4 * cells.shape[0], dtype=torch.bool)
        folded[matching.folded.flatten()] = True
        neighbours = matching.cell_adjacency.long()
        says = (neighbours >= 0) & known[neighbours.clamp_min(0)] & ~known[:, None]
        heard = says.any(1)
        if not heard.any():
            break
        turned = (folded.view(-1, 4) & says).any(1)
        cells[turned] = cells[turned][:, [0, 1, 3, 2]]
        known |= heard
    return cells


def _touching_edges(mesh: TetMesh) -> int:
    """Edges with more than two boundary faces."""
    half_faces = true_indices((mesh.topology.cell_adjacency < 0).view(-1))
    faces = face_vertices(mesh.tets, half_faces).long()
    ends = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).sort(1).values
    keys = np.sort(((ends[:, 0] << 32) | ends[:, 1]).numpy())
    return int((np.diff(np.flatnonzero(np.r_[True, keys[1:] != keys[:-1], True])) > 2).sum())
