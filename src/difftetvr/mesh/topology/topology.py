"""Topology of a tetrahedral mesh as flat arrays, each built when first asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import chunks, sort_keys, true_indices
from difftetvr.mesh.topology.faces import LOCAL_FACES, check_matching, face_vertices, match_faces

__all__ = ["LOCAL_EDGES", "LOCAL_EDGE_OF", "LOCAL_FACES", "Topology"]

LOCAL_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
"""Local vertices of a cell's six edges."""

LOCAL_EDGE_OF = tuple(
    tuple(LOCAL_EDGES.index((min(i, j), max(i, j))) if i != j else -1 for j in range(4)) for i in range(4)
)
"""Which of the six edges joins two local vertices; -1 on the diagonal."""

_ROW_BITS = 32
_ROW_MASK = (1 << _ROW_BITS) - 1

X = TypeVar("X")


class Topology:
    """Who neighbours whom in a tetrahedral mesh: no positions, only indices.

    Every table is built on first use, kept, and lies on the device of `tets`; treat all of them as read-only. Meshes
    that differ in vertex positions alone share one `Topology`.

    Attributes:
        tets: (T, 4) int32 vertex indices of positively oriented cells.
        num_vertices: Number of vertices V.
        is_conforming: Whether cells meet face to face. Loose cells need not: they have edges and the cells around a
            vertex, but nothing that comes from `cell_adjacency`.
    """

    def __init__(
        self,
        tets: torch.Tensor,
        num_vertices: int,
        cell_adjacency: torch.Tensor | None = None,
        *,
        is_conforming: bool = True,
    ) -> None:
        """Wrap the cells; nothing is computed yet.

        Args:
            tets: (T, 4) int32 vertex indices, all in [0, num_vertices).
            num_vertices: Number of vertices V, unused ones included.
            cell_adjacency: (T, 4) int32, where the caller knows it already; None for loose cells.
            is_conforming: False for loose cells.
        """
        self.tets = tets.contiguous()
        self.num_vertices = num_vertices
        self.is_conforming = is_conforming
        self._tables: dict[str, Any] = {} if cell_adjacency is None else {"cell_adjacency": cell_adjacency}

    @property
    def num_cells(self) -> int:
        """Number of cells T."""
        return self.tets.shape[0]

    @property
    def cell_adjacency(self) -> torch.Tensor:
        """(T, 4) int32: the cell across the face opposite local vertex k, -1 on the boundary.

        Raises:
            MeshError: The cells are loose, more than two of them share a face, or two neighbours overlap.
        """
        return self.cached("cell_adjacency", self._build_cell_adjacency)

    @property
    def faces(self) -> torch.Tensor:
        """(F, 3) int32: every face once, counter-clockwise seen from outside its first cell `face_cells[:, 0]`."""
        return self._face_table[0]

    @property
    def face_cells(self) -> torch.Tensor:
        """(F, 2) int32: the cells of each of `faces`, the smaller index first; the second is -1 on the boundary."""
        return self._face_table[1]

    @property
    def boundary_faces(self) -> torch.Tensor:
        """(B, 3) int32: faces of one cell only, counter-clockwise seen from outside the mesh."""
        return self._boundary[0]

    @property
    def boundary_cells(self) -> torch.Tensor:
        """(B,) int32: the cell behind each of `boundary_faces`."""
        return self._boundary[1]

    @property
    def edges(self) -> torch.Tensor:
        """(E, 2) int32: every edge once, smaller vertex first, in lexicographic order."""
        return self.cached("edges", self._build_edges)

    @property
    def vertex_cells(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The cells around each vertex, compressed: offsets (V + 1,) int32 and cells (4 T,) int32.

        Those of vertex v are `cells[offsets[v]:offsets[v + 1]]`, ascending.
        """
        offsets, corners = self.vertex_corners
        return offsets, self.cached("vertex_cells", lambda: corners >> 2)

    @property
    def vertex_corners(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The same with corners, 4 * cell + k where the vertex is the cell's k-th, in place of cells."""
        return self.cached("vertex_corners", self._build_vertex_corners)

    def cached(self, key: str, build: Callable[[], X]) -> X:
        """A table derived from this topology alone, built once and kept as long as the topology.

        Args:
            key: Name of the table, unique to its builder; prefix it with the caller's module.
            build: Makes the table; called when `key` is not known yet.

        Returns:
            What `build` returned the first time.
        """
        if key not in self._tables:
            self._tables[key] = build()
        return self._tables[key]

    def to(self, device: torch.device | str) -> Topology:
        """The same topology on another device; the adjacency comes along, other tables are rebuilt there on demand.

        Args:
            device: Where the tables shall lie.

        Returns:
            This object when it is there already.
        """
        tets = self.tets.to(device)
        if tets is self.tets:
            return self
        adjacency = self._tables.get("cell_adjacency")
        known = None if adjacency is None else adjacency.to(device)
        return Topology(tets, self.num_vertices, known, is_conforming=self.is_conforming)

    def __getstate__(self) -> dict[str, Any]:
        """What a copy, or a file, needs; other tables, which may hold arrays of kernels, are rebuilt on demand."""
        adjacency = self._tables.get("cell_adjacency")
        return {**self.__dict__, "_tables": {} if adjacency is None else {"cell_adjacency": adjacency}}

    def _build_cell_adjacency(self) -> torch.Tensor:
        if not self.is_conforming:
            raise MeshError(
                "This mesh is made of loose cells (conforming=False), which have no neighbours: only "
                "renderer='linked-list', renderer='projected' and what looks at cells one by one work with it; build "
                "it with conforming=True if its cells meet face to face."
            )
        matching = match_faces(self.tets, self.num_vertices)
        check_matching(matching, self.tets)
        return matching.cell_adjacency

    @property
    def _face_table(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.cached("face_table", self._build_face_table)

    @property
    def _boundary(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.cached("boundary", self._build_boundary)

    def _build_face_table(self) -> tuple[torch.Tensor, torch.Tensor]:
        faces, face_cells = [], []
        for part in chunks(self.num_cells, self.tets.device, width=12):
            neighbours = self.cell_adjacency[part]
            cells = torch.arange(part.start, part.stop, dtype=torch.int32, device=neighbours.device)[:, None]
            # Of the two half-faces of an inner face, the one of the smaller cell stands for it.
            half_faces = true_indices(((neighbours < 0) | (neighbours > cells)).view(-1))
            others = neighbours.reshape(-1).index_select(0, half_faces)
            half_faces += 4 * part.start
            faces.append(face_vertices(self.tets, half_faces))
            face_cells.append(torch.stack(((half_faces >> 2).int(), others), 1))
        return torch.cat(faces), torch.cat(face_cells)

    def _build_boundary(self) -> tuple[torch.Tensor, torch.Tensor]:
        half_faces = true_indices((self.cell_adjacency < 0).view(-1))
        return face_vertices(self.tets, half_faces), (half_faces >> 2).int()

    def _build_edges(self) -> torch.Tensor:
        parts = []
        for part in chunks(self.num_cells, self.tets.device, width=6):
            corners = self.tets[part].long().unbind(1)
            ends = [(corners[i], corners[j]) for i, j in LOCAL_EDGES]
            keys = torch.cat([(torch.minimum(p, q) << _ROW_BITS) | torch.maximum(p, q) for p, q in ends])
            parts.append(torch.unique_consecutive(sort_keys(keys)))
        keys = torch.unique_consecutive(sort_keys(torch.cat(parts)))
        return torch.stack(((keys >> _ROW_BITS).int(), (keys & _ROW_MASK).int()), 1)

    def _build_vertex_corners(self) -> tuple[torch.Tensor, torch.Tensor]:
        keys = torch.empty((self.num_cells, 4), dtype=torch.int64, device=self.tets.device)
        for part in chunks(self.num_cells, self.tets.device, width=4):
            corners = torch.arange(4 * part.start, 4 * part.stop, device=self.tets.device)
            keys[part] = (self.tets[part].long() << _ROW_BITS) | corners.view(-1, 4)
        corners = sort_keys(keys.view(-1)).bitwise_and_(_ROW_MASK).int()
        counts = torch.bincount(self.tets.view(-1), minlength=self.num_vertices)
        return torch.nn.functional.pad(counts.cumsum(0), (1, 0)).int(), corners
