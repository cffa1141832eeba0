"""Bistellar flips: the same vertices, other cells.

Three flips change how a few cells fill the space that they share:
- 2-3: the face abc between two cells gives way to the edge de between their apexes, with three cells around it;
- 3-2: the reverse: an inner edge de with three cells around it gives way to the face abc;
- 4-4: an inner edge with four cells around it gives way to another diagonal of the octahedron that they fill.

Why the result is valid. All new cells have positive volume. Old and new cells have the same outer faces, so they cover
every point equally often: as the old ones do not overlap, the new ones do not, and fill the same space. (Three or four
cells around an edge go round it only once, as so few angles below 180 degrees do not add up to 720.) What appears, the
edge or the face, lies inside that space, and so does every other new face, for it contains the new edge. Were the same
edge or face there already, or made by another flip at once, then cells around it would overlap those of this flip next
to a common vertex. No mesh that can be put together from solid cells does that, but a `TetMesh` may: nothing keeps its
boundary from folding over itself. Therefore both are excluded explicitly, and every valid `TetMesh` stays one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import chunks, sort_keys, true_indices
from difftetvr.mesh.changes.change import MeshChange, check_rows, with_vertices_kept
from difftetvr.mesh.changes.independent import best_first, independent_set
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology.topology import Topology

TWO_TO_THREE, THREE_TO_TWO, FOUR_TO_FOUR = 2, 3, 4
"""Kinds of flips, each the number of cells that vanish."""

X = TypeVar("X")

_ITEM_BITS = 32
_ITEM_MASK = (1 << _ITEM_BITS) - 1


@dataclass(frozen=True)
class Flips:
    """Flips of a mesh that are possible, each for itself; those that share a cell exclude one another.

    Every flip has an edge with vertices around it, its ring. In a 2-3 or 4-4 flip that edge appears, in a 3-2 flip it
    vanishes. The edge pierces the face between the first three vertices of the ring, in a point x. In a 2-3 flip that
    face vanishes, in a 3-2 flip it appears. In a 4-4 flip the edge from ring[0] to ring[2] vanishes, and the face is
    one of the four at that edge: where the two edges cross, x lies on both of them, else on the new one and that face.

    Attributes:
        mesh: The mesh that they are flips of.
        kind: (N,) int8, TWO_TO_THREE, THREE_TO_TWO or FOUR_TO_FOUR.
        vanishes: (N,) int32, the face of `mesh.topology.faces` that vanishes in a 2-3 flip, the edge of
            `mesh.topology.edges` that does in any other.
        cells: (N, 4) int32, the cells that vanish, then -1.
        edge: (N, 2) int32, the ends of the edge.
        ring: (N, 4) int32, the vertices around it, counter-clockwise seen from edge[1]; the fourth is -1 where there
            are three.
        weight: (N,) float64 in [0, 1]: x = (1 - weight) * first end + weight * second end of the edge.
        face_weights: (N, 3) float64, not negative, of sum one: x as the mean of the first three vertices of the ring.
        quality_before: (N,) float64, quality of the worst cell that vanishes.
        quality_after: (N,) float64, quality of the worst cell that appears.
    """

    mesh: TetMesh
    kind: torch.Tensor
    vanishes: torch.Tensor
    cells: torch.Tensor
    edge: torch.Tensor
    ring: torch.Tensor
    weight: torch.Tensor
    face_weights: torch.Tensor
    quality_before: torch.Tensor
    quality_after: torch.Tensor

    def __len__(self) -> int:
        """Number of flips N."""
        return self.kind.shape[0]

    @classmethod
    def joined(cls, parts: Sequence[Flips]) -> Flips:
        """Flips of one mesh in one record.

        Args:
            parts: At least one record, all of the same mesh.

        Returns:
            Their flips, one record after the other.
        """
        columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in _COLUMNS}
        return cls(parts[0].mesh, **columns)

    def select(self, which: torch.Tensor) -> Flips:
        """Some of the flips.

        Args:
            which: (N,) bool, or (M,) int64 indices.

        Returns:
            These flips, in the order of the indices.
        """
        rows = true_indices(which) if which.dtype == torch.bool else which
        return Flips(self.mesh, **{name: getattr(self, name).index_select(0, rows) for name in _COLUMNS})

    def surplus(self, values: torch.Tensor) -> torch.Tensor:
        """How much each flip raises the value that is interpolated at its point x: 0 for linear fields.

        In 2-3 and 3-2 flips, that alone tells the change everywhere: it falls linearly from x to the outer faces of the
        flip's cells, where it is 0.

        Args:
            values: (V, ...) floating point at the vertices, on the mesh's device; differentiable.

        Returns:
            (N, ...) of the same dtype: the value after the flip minus the value before. The arithmetic is
            float64, as the difference is small.

        Raises:
            MeshError: The number of rows is not the number of vertices.
        """
        check_rows(values, self.mesh.num_vertices, "vertices")
        rows = values.double().reshape(values.shape[0], -1)
        parts = [rows[:0]]
        for part in chunks(len(self), rows.device, width=3 * rows.shape[1]):
            first, second = (rows.index_select(0, column) for column in self.edge[part].unbind(1))
            corners = [rows.index_select(0, column) for column in self.ring[part, :3].unbind(1)]
            weights = self.face_weights[part].unbind(1)
            at_edge = torch.lerp(first, second, self.weight[part, None])
            at_face = sum(w[:, None] * corner for w, corner in zip(weights, corners))
            parts.append(torch.where((self.kind[part] == THREE_TO_TWO)[:, None], at_face - at_edge, at_edge - at_face))
        return torch.cat(parts).to(values.dtype).view(len(self), *values.shape[1:])


_COLUMNS = tuple(field.name for field in fields(Flips) if field.name != "mesh")


def independent_flips(flips: Flips, priority: torch.Tensor) -> Flips:
    """Choose flips, highest priority first, such that no two share a cell.

    The result is that of taking flips one by one in the order of priority, leaving out those with a cell in common with
    an earlier one; it is found in parallel. Equal priorities are taken in a fixed order that looks random. Of chosen
    flips that make the same edge or face, which only a mesh that overlaps itself allows, the first remains.

    Args:
        flips: What to choose from; select those that are worth it before.
        priority: (N,) real numbers, such as the gain in quality or a predicted gain in a loss.

    Returns:
        The flips chosen, in the order in which they stood.

    Raises:
        MeshError: priority has another length than the flips, or is NaN.
    """
    count = len(flips)
    if priority.shape != (count,):
        raise MeshError(
            f"The priority has shape {tuple(priority.shape)}; pass one value for each of the {count} flips."
        )
    if torch.isnan(priority).any():
        raise MeshError("The priority is NaN somewhere; pass real numbers, and -inf for what should come last.")
    order = best_first(priority.detach())
    # The last rank is that of the item `count`, which fills up groups.
    rank = torch.full((count + 1,), count, dtype=torch.int32, device=order.device)
    rank[order] = torch.arange(count, dtype=torch.int32, device=order.device)
    chosen = order[independent_set(_conflicts(flips), rank, count)]
    first_of_its_kind = _first_of_equal_rows(_appearing(flips.select(chosen)))
    return flips.select(chosen[first_of_its_kind].sort().values)


def apply_flips(flips: Flips, priority: torch.Tensor | None = None) -> MeshChange:
    """Do the flips that `independent_flips` chooses.

    Args:
        flips: Flips of a mesh.
        priority: (N,) real numbers, highest first; None if the flips have been chosen already.

    Returns:
        The change of `flips.mesh`, cell_parents ascending. Vertices and the cells of no flip stay as they are, in their
        order. A new cell takes the place of its parent, an old cell of the same flip with which it shares a face; of
        the three new cells of a 2-3 flip two have the same parent.

    Raises:
        MeshError: priority has another length than the flips, or is NaN.
    """
    mesh = flips.mesh
    chosen = flips if priority is None else independent_flips(flips, priority)
    is_kind = {kind: true_indices(chosen.kind == kind) for kind in (TWO_TO_THREE, THREE_TO_TWO, FOUR_TO_FOUR)}
    counts = torch.ones(mesh.num_cells, dtype=torch.int64, device=mesh.tets.device)
    counts[chosen.cells[is_kind[TWO_TO_THREE], 0].long()] = 2
    counts[chosen.cells[is_kind[THREE_TO_TWO], 2].long()] = 0
    first_place = counts.cumsum(0) - counts
    parents = torch.repeat_interleave(counts)
    tets = mesh.tets.index_select(0, parents)
    for kind, rows in is_kind.items():
        after = cells_after(kind, chosen.edge[rows].unbind(1), chosen.ring[rows].unbind(1))
        new = torch.stack([torch.stack(cell, 1) for cell in after])
        places = list(first_place[chosen.cells[rows, :kind].long()].unbind(1))
        if kind == TWO_TO_THREE:
            places.insert(1, places[0] + 1)
        tets[torch.stack(places[: new.shape[0]])] = new
    kept = torch.arange(mesh.num_vertices, device=tets.device)
    return with_vertices_kept(mesh, kept, Topology(tets, mesh.num_vertices), parents.int())


def cells_after(kind: int, edge: Sequence[X], ring: Sequence[X]) -> list[tuple[X, X, X, X]]:
    """The cells that flips of one kind make.

    Args:
        kind: TWO_TO_THREE, THREE_TO_TWO or FOUR_TO_FOUR.
        edge: The two ends, see `Flips`.
        ring: The three or four vertices around it, see `Flips`; of three what follows does not matter.

    Returns:
        Corners of the new cells, positively oriented where the flip is possible.
    """
    p, q = edge
    if kind == THREE_TO_TWO:
        a, b, c = ring[:3]
        return [(a, c, b, p), (a, b, c, q)]
    corners = ring[: 4 if kind == FOUR_TO_FOUR else 3]
    return [(corner, following, p, q) for corner, following in zip(corners, (*corners[1:], corners[0]))]


def _conflicts(flips: Flips) -> torch.Tensor:
    """The flips of each cell that has any, a row each, filled up with their count."""
    count = len(flips)
    keys = [flips.cells.new_empty(0, dtype=torch.int64)]
    for column in flips.cells.unbind(1):
        rows = true_indices(column >= 0)
        keys.append((column[rows].long() << _ITEM_BITS) | rows)
    cells_and_flips = sort_keys(torch.cat(keys))
    _, counts = torch.unique_consecutive(cells_and_flips >> _ITEM_BITS, return_counts=True)
    starts = counts.cumsum(0) - counts
    group = torch.repeat_interleave(counts)
    place = torch.arange(group.shape[0], device=group.device) - starts[group]
    table = flips.cells.new_full((counts.shape[0], int(counts.max()) if count else 1), count)
    table[group, place] = (cells_and_flips & _ITEM_MASK).int()
    return table


def _appearing(flips: Flips) -> torch.Tensor:
    """(N, 3) int32, the vertices of what appears, ascending; an edge has its second one twice."""
    edges = flips.edge[:, [0, 1, 1]]
    edges = torch.where((edges[:, 0] > edges[:, 1])[:, None], edges[:, [1, 0, 0]], edges)
    return torch.where((flips.kind == THREE_TO_TWO)[:, None], flips.ring[:, :3].sort(1).values, edges)


def _first_of_equal_rows(rows: torch.Tensor) -> torch.Tensor:
    """(N,) bool: no earlier row of (N, K) int32 is the same."""
    name = torch.zeros(rows.shape[0], dtype=torch.int64, device=rows.device)
    for column in rows.unbind(1):
        _, name = torch.unique((name << _ITEM_BITS) | column, return_inverse=True)
    places = torch.arange(rows.shape[0], device=rows.device)
    first = torch.full_like(places, rows.shape[0]).scatter_reduce_(0, name, places, "amin")
    return first[name] == places
