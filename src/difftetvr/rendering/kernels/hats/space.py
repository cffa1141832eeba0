"""What there are hats of, and records of what is known of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.recording import few_lengths
from difftetvr.rendering.kernels.hats.tables import Chosen
from difftetvr.rendering.search.memory_order import MemoryOrder

STEP_RECORD = 2
"""Floats a step: derivative of the error, and sum of the squared responses."""

_PACKETS = {"llvm": 16}
_PACKET = 4


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
        packet = min(_PACKETS.get(self.backend.name, _PACKET), 1 << (self.floats - 1).bit_length())
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
