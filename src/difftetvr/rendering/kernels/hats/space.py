"""What there are hats of, and records of what is known of each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.mesh.arrays import true_indices
from difftetvr.recording import few_lengths
from difftetvr.rendering.search.memory_order import MemoryOrder

STEP_RECORD = 2
"""Floats a step: derivative of the error, and sum of the squared responses."""

_SPARE = 16
"""Records that take what is added for hats which nobody asks for: threads of a CPU would guess wrong half of the time
whether they have to add, and additions to one record would wait for each other."""


@dataclass(frozen=True)
class Chosen:
    """The edges or faces that have records.

    Attributes:
        mask: (N,) bool, those that are asked for; None: all.
        count: Number N of all.
    """

    mask: torch.Tensor | None
    count: int

    @cached_property
    def rows(self) -> torch.Tensor:
        """(M,) int64 which of all have records, in the order of these."""
        assert self.mask is not None
        return true_indices(self.mask)

    @property
    def asked(self) -> int:
        """Number M of those that are asked for."""
        return self.count if self.mask is None else self.rows.shape[0]

    @property
    def records(self) -> int:
        """Number of their records, with those that are spare."""
        return self.count if self.mask is None else self.asked + _SPARE

    def numbered(self, table: torch.Tensor) -> torch.Tensor:
        """A table of indices with numbers of records instead."""
        if self.mask is None:
            return table
        spare = torch.arange(self.count, dtype=torch.int32, device=table.device).remainder_(_SPARE).add_(self.asked)
        places = self.mask.cumsum(0, dtype=torch.int32).sub_(1)
        numbers = torch.where(self.mask, places, spare)
        return numbers.index_select(0, table.view(-1)).view_as(table)

    def values(self, values: torch.Tensor) -> torch.Tensor:
        """(N, ...) values of all, as those of the records; 0 for spare ones."""
        if self.mask is None:
            return values
        chosen = values.index_select(0, self.rows)
        return torch.cat((chosen, chosen.new_zeros(_SPARE, *chosen.shape[1:])))

    def spread(self, records: torch.Tensor) -> torch.Tensor:
        """(N, width) what is known of all, from their records; 0 where nothing is."""
        if self.mask is None:
            return records[: self.count]
        known = records.new_zeros(self.count, records.shape[1])
        return known.index_copy_(0, self.rows, records[: self.asked])


@dataclass
class HatRecords:
    """Flat arrays of a record for each vertex, edge and face."""

    vertices: Any
    edges: Any
    faces: Any


@dataclass(frozen=True)
class HatSpace:
    """What there are hats of.

    Attributes:
        backend: What makes the records.
        mesh: The mesh that is seen.
        order: Its order in memory.
        edges: Edges that are looked at.
        faces: Faces that are looked at.
        floats: What is known of a hat.
        has_steps: Whether but one step of each face is looked at.
    """

    backend: Backend
    mesh: TetMesh
    order: MemoryOrder
    edges: Chosen
    faces: Chosen
    floats: int
    has_steps: bool

    @property
    def width(self) -> int:
        """Floats of a record: whole packets, where there are many; for a CPU these are the lines of its cache."""
        packet = min(16 if self.backend.name == "llvm" else 4, 1 << (self.floats - 1).bit_length())
        return -(-self.floats // packet) * packet

    @property
    def widths(self) -> list[int]:
        """Floats of a record of vertices, edges and faces."""
        return [self.width, self.width, STEP_RECORD if self.has_steps else self.width]

    @property
    def counts(self) -> list[int]:
        """Records of vertices, edges and faces that there is room for; few different numbers: kernels know them."""
        return [few_lengths(n) for n in (self.mesh.num_vertices, self.edges.records, self.faces.records)]

    def tensors(self, found: HatRecords) -> list[torch.Tensor]:
        """What is known of vertices, edges and faces in the order of the mesh, (N, width) each."""
        arrays = zip((found.vertices, found.edges, found.faces), self.widths, strict=True)
        vertices, edges, faces = (self.backend.tensor(array, -1, width) for array, width in arrays)
        known = self.order.in_order_of_mesh(vertices[: self.mesh.num_vertices])
        return [known, self.edges.spread(edges), self.faces.spread(faces)]
