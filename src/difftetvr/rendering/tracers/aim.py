"""What tracers are made of."""

from __future__ import annotations

from dataclasses import dataclass

from difftetvr.mesh import TetMesh
from difftetvr.rendering.search.entry import EntryLists
from difftetvr.rendering.search.memory_order import OrderedMesh
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.traversal.crossing import View


@dataclass
class Aim:
    """A mesh in memory, and rays that are about to cross it.

    Attributes:
        view: What kernels read.
        scene: The cells in the space of the rays.
        ordered: The mesh in the order of memory, in that space.
        mesh: The mesh as it was passed.
        entries: Where rays enter the mesh, if that is known already.
    """

    view: View
    scene: Scene
    ordered: OrderedMesh
    mesh: TetMesh
    entries: EntryLists | None
