"""What tracers are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.mesh import TetMesh
from difftetvr.rendering.search.memory_order import MemoryOrder, MeshTables
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.traversal.crossing import View


@dataclass
class Aim:
    """A mesh in memory, and rays that are about to cross it.

    Attributes:
        view: What kernels read.
        scene: The cells in the space of the rays.
        mesh: The mesh as it was passed.
        found: What the tracer's plan has found: where rays enter the mesh, their fragments, or nothing.
    """

    view: View
    scene: Scene
    mesh: TetMesh
    found: Any

    @property
    def order(self) -> MemoryOrder:
        """The order of the mesh in memory."""
        return MemoryOrder.of(self.mesh)

    @property
    def tables(self) -> MeshTables:
        """What kernels read of the topology."""
        return self.order.tables(self.view.backend)

    @property
    def positions(self) -> torch.Tensor:
        """(V, 3) vertices in the space of the rays, in the order of memory."""
        rows = self.view.backend.tensor(self.scene.vertices, -1, 4 * self.scene.stride)
        return rows[: self.mesh.num_vertices, :3]
