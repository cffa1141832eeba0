"""The marching renderer: rays walk from cell to cell, front to back (Dr.Jit).

Nothing is sorted and nothing stored per crossing: the adjoint walks again and keeps what of the image is still ahead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.rendering.search.bundle_hits import BundleEntries, Stretches
from difftetvr.rendering.search.camera_hits import CameraEntries
from difftetvr.rendering.search.entry import EntryLists
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.search.plan import SearchPlan
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.tracers.aim import Aim
from difftetvr.rendering.traversal.crossing import Kernel, Step, View
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.walk import BOUNDARY, Face, interpolate, make_face, table_row


@dataclass
class Marching:
    """Walks along cell adjacency.

    Attributes:
        view: What kernels read.
        scene: The cells.
        table: Walk table, see :func:`difftetvr.rendering.traversal.walk.walk_table`.
        entries: Entry lists of this view.
    """

    view: View
    scene: Scene
    table: Any
    entries: EntryLists

    @staticmethod
    def plan(backend: Backend, mesh: TetMesh, rays: Any, stretches: Stretches | None) -> SearchPlan:
        """How to find where rays enter a mesh, or start in it: those of a camera, or stretches of a bundle."""
        if stretches is None:
            return CameraEntries.of(backend, MemoryOrder.of(mesh).tables(backend), rays)
        return BundleEntries.of(backend, mesh, stretches)

    @staticmethod
    def of(aim: Aim) -> Marching:
        """Take where rays enter the mesh."""
        return Marching(aim.view, aim.scene, aim.tables.walk, aim.found)

    @property
    def starts_inside(self) -> bool:
        """Whether some walks start behind the ray's origin."""
        return self.entries.has_starts

    def on_lanes(self, lane: Any) -> Marching:
        """See :meth:`difftetvr.rendering.traversal.crossing.Tracer.on_lanes`."""
        return replace(self, view=replace(self.view, lane=lane))

    def trace(self, make_kernel: Callable[[Lanes], Kernel]) -> None:
        """Walk every ray through all cells it crosses, front to back."""
        rays = self.view.lanes
        kernel = make_kernel(rays)
        kernel.finish(self._walk(kernel, rays))

    def _walk(self, kernel: Kernel, rays: Lanes) -> Any:
        uint = self.view.backend.UInt
        offset = dr.gather(uint, self.entries.offset, rays.pixel, rays.valid)
        count = dr.gather(uint, self.entries.count, rays.pixel, rays.valid)
        limits = self.view.limits
        far = None if limits is None else dr.gather(self.view.backend.Float2, limits, rays.pixel, rays.valid)[1]

        def enter(index: Any, ray: Any) -> tuple[Any, Any]:
            active = (index < count) & rays.valid
            half_face = dr.gather(uint, self.entries.half_faces, offset + index, active)
            *vertices, apex = self.scene.indices_and_apex(half_face, active)
            face = make_face([kernel.read(vertex, active) for vertex in vertices])
            state = (active, half_face >> 2, apex, face, interpolate(face), ray)
            state = dr.while_loop(state, lambda active, *_: active, advance)
            return index + 1, kernel.leave(state[3], state[5], active)

        def advance(active: Any, cell: Any, apex: Any, face: Face, entry: list[Any], ray: Any) -> tuple[Any, ...]:
            step = Step.through(cell, face, entry, kernel.read(apex, active))
            ray = kernel.visit(step, ray)
            link = table_row(cell, step.exit.vertex(face), face, step.apex)
            behind = dr.gather(self.view.backend.UInt2, self.table, link, active)
            active = active & (behind[0] != BOUNDARY) & kernel.goes_on(ray)
            if far is not None:  # nothing of what follows is looked at
                active &= step.leaving[0] < far
            return active, behind[0], behind[1], step.next_face, step.leaving, ray

        ray = kernel.start()
        if self.entries.is_simple:
            return enter(uint(0), ray)[1]
        more = lambda index, ray: (index < count) & rays.valid & kernel.goes_on(ray)  # noqa: E731
        return dr.while_loop((dr.zeros(uint, dr.width(rays.pixel)), ray), more, enter)[1]
