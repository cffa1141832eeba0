"""Per-pixel linked lists of fragments (article section 4; Yang et al. 2010), built by rasterising faces (Dr.Jit).

A fragment is a face through which a ray enters a cell, so it stands for the whole crossing of that cell: which face
the ray leaves through follows from the exact rule of the walk. Every crossing makes one fragment, on any mesh; an order
that rounding has mixed up costs as little as the crossings concerned are long.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import NONE, Backend
from difftetvr.mesh import TetMesh
from difftetvr.recording import few_lengths
from difftetvr.rendering.search.beams import Beam
from difftetvr.rendering.search.bundle_hits import Stretches
from difftetvr.rendering.search.hierarchy import Hierarchy, Leaves, leaves_of_cells
from difftetvr.rendering.search.hits import Hit, Settle, Visit
from difftetvr.rendering.search.memory_order import MemoryOrder, MeshTables
from difftetvr.rendering.search.plan import Around, Counts, Found, Search, Told
from difftetvr.rendering.search.rasterise import for_each_hit, work_items, workers_for
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.search.starts import AROUND, cells_around
from difftetvr.rendering.traversal.rays import ImageRays
from difftetvr.rendering.traversal.walk import crossing_depth, find_exit, holds_ray

_FACES_AT_A_TIME = 1 << 22  # bounds the memory of work items


@dataclass
class Fragments:
    """What is known of the fragments of a view.

    Attributes:
        search: Finds them.
        count: (lanes,) number of fragments of each lane: its depth complexity.
        longest: The greatest of them.
        total: Their sum.
        starts_inside: Whether some crossings begin behind the camera.
    """

    search: Search
    count: Any
    longest: int
    total: int
    starts_inside: bool


@dataclass
class CameraFragments:
    """Plans to find the fragments of a camera's rays.

    Attributes:
        lane: Numbers of the lanes that have rays.
        worker: Those of the lanes that rasterise.
        half_face: Numbers of half-faces, as many as are rasterised at a time.
        lengths: Those of ``worker`` and ``half_face``.
        firsts: What to add to them, each time.
        end: Number of all half-faces, as a device value.
        cell: Numbers of all cells.
        capacity: Cells around the camera that there is room for.
        sees_all: See :class:`difftetvr.rendering.search.plan.SearchPlan`.
    """

    lane: Any
    worker: Any
    half_face: Any
    lengths: tuple[int, int]
    firsts: list[Any]
    end: Any
    cell: Any
    capacity: int = AROUND
    sees_all: Any | None = None

    @staticmethod
    def of(backend: Backend, tables: MeshTables, rays: ImageRays) -> CameraFragments:
        """Plan for a mesh."""
        end = 4 * dr.width(tables.numbers)
        at_a_time = min(few_lengths(end), _FACES_AT_A_TIME)
        lengths = workers_for(at_a_time, rays.count), at_a_time
        lane, worker, half_face = (backend.lanes(size) for size in (rays.lane_count, *lengths))
        firsts = [backend.constant(first) for first in range(0, end, at_a_time)]
        return CameraFragments(lane, worker, half_face, lengths, firsts, backend.constant(end), tables.numbers)

    def find(self, scene: Scene, extent: Any) -> Found:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.find`."""
        around = cells_around(scene, self.cell, extent, self.capacity, None)
        return Found(_counted(_CameraFragmentSearch(scene, self, around)), around, [])

    def settled(self, scene: Scene, found: Found, told: Told) -> Fragments:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.settled`."""
        assert found.around is not None
        search = _CameraFragmentSearch(scene, self, found.around)
        return Fragments(search, found.counts.count, told.most, told.total, told.around > 0)


@dataclass
class _CameraFragmentSearch:
    """All half-faces in front of a camera, and the cells around it."""

    scene: Scene
    plan: CameraFragments
    around: Around

    def for_each(self, visit: Visit, settle: Settle) -> None:
        scene, plan = self.scene, self.plan
        for first in plan.firsts:
            half_face = plan.half_face + first
            items = work_items(scene, dr.select(half_face < plan.end, half_face, NONE), plan.worker)
            for_each_hit(scene, items, visit)
            settle()
        self._for_each_around(visit)
        settle()

    def _for_each_around(self, visit: Visit) -> None:
        """Crossings of cells that hold the camera: they begin behind it, where no face is rasterised."""
        scene, uint, lane = self.scene, self.scene.backend.UInt, self.plan.lane
        rays, count = scene.rays.of_lanes(lane), 4 * self.around.held

        def body(index: Any) -> tuple[Any]:
            half_face = 4 * dr.gather(uint, self.around.cells, index >> 2) + (index & 3)
            face, apex = scene.face_and_apex(rays.frame, half_face)
            depth, exit_depth = crossing_depth(face), crossing_depth(find_exit(face, apex).face(face, apex))
            is_hit = rays.valid & holds_ray(face) & (depth <= 0) & (exit_depth > 0)
            visit(Hit(rays.pixel, lane, half_face, depth, is_hit))
            return (index + 1,)

        dr.while_loop((dr.zeros(uint, dr.width(lane)),), lambda index: index < count, body)


@dataclass
class BundleFragments:
    """Plans to find the fragments of a bundle's rays.

    Attributes:
        stretches: What is looked at.
        cells: All cells.
        capacity: See :class:`difftetvr.rendering.search.plan.SearchPlan`.
    """

    stretches: Stretches
    cells: Leaves
    capacity: int = 0

    @staticmethod
    def of(backend: Backend, mesh: TetMesh, stretches: Stretches) -> BundleFragments:
        """Plan for a mesh."""
        order = MemoryOrder.of(mesh)
        return BundleFragments(stretches, leaves_of_cells(backend, order.topology, lambda: order.mesh(mesh).vertices))

    @property
    def sees_all(self) -> Any | None:
        """See :class:`difftetvr.rendering.search.plan.SearchPlan`."""
        return self.stretches.sees_all

    def find(self, scene: Scene, extent: Any) -> Found:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.find`."""
        cells = Hierarchy.over(self.cells, scene)
        return Found(_counted(_BundleFragmentSearch(scene, self, cells)), None, [cells.boxes])

    def settled(self, scene: Scene, found: Found, told: Told) -> Fragments:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.settled`."""
        search = _BundleFragmentSearch(scene, self, Hierarchy(scene.backend, self.cells, found.boxes[0]))
        return Fragments(search, found.counts.count, told.most, told.total, False)


@dataclass
class _BundleFragmentSearch:
    """All cells that may lie along a bundle."""

    scene: Scene
    plan: BundleFragments
    cells: Hierarchy

    def for_each(self, visit: Visit, settle: Settle) -> None:
        scene, lane = self.scene, self.plan.stretches.lane
        rays, near, far = self.plan.stretches.seen(scene)

        def at_cell(cell: Any, active: Any, state: Any) -> Any:
            is_crossed, half_face = scene.entered(rays.frame, cell, active)

            def crossed(state: Any) -> Any:
                face, apex = scene.face_and_apex(rays.frame, half_face)
                exit_depth = crossing_depth(find_exit(face, apex).face(face, apex))
                depth = crossing_depth(face)
                is_hit = (exit_depth > near) & (depth < far)
                visit(Hit(rays.pixel, lane, half_face, depth, is_hit))
                return state

            return dr.if_stmt((state,), is_crossed, crossed, lambda state: state)

        self.cells.meet_lines(Beam.of(rays, near, far), at_cell, lane)
        settle()


def _counted(search: Search) -> Counts:
    """Number of fragments of each lane."""
    uint, lanes = search.scene.backend.UInt, search.scene.rays.lane_count
    count = dr.zeros(uint, lanes)
    search.for_each(lambda hit: dr.scatter_add(count, uint(1), hit.lane, hit.is_hit), lambda: dr.eval(count))
    return Counts.of(count, None)


@dataclass
class FragmentBand:
    """Lanes whose lists are held at a time.

    Attributes:
        lane: Their numbers.
        first, last: The first, and the one behind the last, as device values.
        count: How many there are.
        size: Fragments that there is room for.
    """

    lane: Any
    first: Any
    last: Any
    count: int
    size: int


@dataclass
class FragmentLists:
    """Lists of the fragments of a band's lanes, in no order.

    Attributes:
        heads: (lanes,) first node of each lane, NONE where there is none.
        following: (nodes,) next node.
        faces: (nodes,) half-face 4 c + k through which the ray enters cell c.
        depths: (nodes,) distance at which it does.
    """

    heads: Any
    following: Any
    faces: Any
    depths: Any

    @staticmethod
    def of(search: Search, band: FragmentBand) -> FragmentLists:
        """Push the fragments of a band's lanes to their lists; may be recorded."""
        backend = search.scene.backend
        uint, size = backend.UInt, band.size
        lists = FragmentLists(
            dr.full(uint, NONE, band.count), dr.empty(uint, size), dr.empty(uint, size), dr.empty(backend.Float, size)
        )
        used = dr.zeros(uint, 1)

        def push(hit: Hit) -> None:
            is_hit = hit.is_hit & (hit.lane >= band.first) & (hit.lane < band.last)
            node = dr.scatter_inc(used, uint(0), is_hit)
            before = dr.scatter_exch(lists.heads, node, hit.lane - band.first, is_hit)
            dr.scatter(lists.following, before, node, is_hit)
            dr.scatter(lists.faces, hit.half_face, node, is_hit)
            dr.scatter(lists.depths, hit.depth, node, is_hit)

        dr.eval(lists, used)
        search.for_each(push, lambda: dr.eval(lists, used))
        return lists
