"""Where the rays of a bundle enter cells, found in hierarchies of boxes (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.rendering.search.beams import Beam
from difftetvr.rendering.search.entry import EntryLists, count_entries, list_entries
from difftetvr.rendering.search.hierarchy import Hierarchy, Leaves, SortedItems, leaves_of_cells
from difftetvr.rendering.search.hits import Hit, Settle, Visit
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.search.pencils import Pencils
from difftetvr.rendering.search.plan import Around, Found, Told
from difftetvr.rendering.search.scene import Scene, boundary_half_faces
from difftetvr.rendering.search.starts import (
    AROUND,
    NEAR,
    StartSearch,
    cells_around,
    for_each_start_among,
    reach_of_beginnings,
)
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.walk import crossing_depth, holds_ray

_FACES_OF_A_LEAF = 1


@dataclass
class Stretches:
    """The lanes of a bundle, and the part of each ray that is looked at.

    Attributes:
        lane: Numbers of all lanes.
        pencil: Numbers of the pencils that they make.
        limits: Flat (N, 2) distances between which each ray is looked at; None for all of it.
        sees_all: Whether they turn out not to matter, see :class:`difftetvr.rendering.search.plan.SearchPlan`.
        begins_at_point: Whether all rays are known to begin at one point.
    """

    lane: Any
    pencil: Any
    limits: Any | None
    sees_all: Any | None
    begins_at_point: bool

    @staticmethod
    def of(backend: Backend, count: int, limits: Any | None, sees_all: Any | None, begins_at_point: bool) -> Stretches:
        """Those of so many lanes."""
        lane, pencil = (backend.lanes(number) for number in (count, Pencils.number_of(count)))
        return Stretches(lane, pencil, limits, sees_all, begins_at_point)

    def seen(self, scene: Scene) -> tuple[Lanes, Any, Any]:
        """The rays, and the distances between which they are looked at."""
        return self.seen_by(scene, self.lane)

    def seen_by(self, scene: Scene, lane: Any) -> tuple[Lanes, Any, Any]:
        """The same of some lanes."""
        real, rays = scene.backend.Float, scene.rays.of_lanes(lane)
        if self.limits is None:
            near, far = (dr.full(real, end, dr.width(lane)) for end in (-dr.inf, dr.inf))
            return rays, near, far
        ends = dr.gather(scene.backend.Float2, self.limits, rays.pixel, rays.valid)
        return rays, ends[0], ends[1]


@dataclass
class BundleEntries:
    """Plans to find where the rays of a bundle enter a mesh, or start in it.

    Attributes:
        stretches: What is looked at.
        boundary: The half-faces of the boundary.
        cells: All cells; None where none is looked for among all of them.
        cell: Numbers of all cells, where all rays begin at one point; None elsewhere.
        adjacency: Flat (T, 4) cells behind the half-faces.
        capacity: Cells around that point that there is room for.
    """

    stretches: Stretches
    boundary: Leaves
    cells: Leaves | None
    cell: Any | None
    adjacency: Any
    capacity: int = AROUND

    @staticmethod
    def of(backend: Backend, mesh: TetMesh, stretches: Stretches) -> BundleEntries:
        """Plan for a mesh."""
        order = MemoryOrder.of(mesh)
        positions = lambda: order.mesh(mesh).vertices  # noqa: E731
        topology = order.topology

        def build() -> Leaves:
            items = SortedItems.of(boundary_half_faces(topology), topology.boundary_faces, positions())
            return Leaves.of(backend, items, _FACES_OF_A_LEAF)

        boundary = topology.cached(f"hierarchy.boundary.{backend.name}", build)
        tables, cells, cell = order.tables(backend), None, None
        if stretches.limits is not None and stretches.begins_at_point:
            cell = tables.numbers
        elif stretches.limits is not None:
            cells = leaves_of_cells(backend, topology, positions)
        return BundleEntries(stretches, boundary, cells, cell, tables.adjacency)

    @property
    def sees_all(self) -> Any | None:
        """See :class:`difftetvr.rendering.search.plan.SearchPlan`."""
        return self.stretches.sees_all

    def find(self, scene: Scene, extent: Any) -> Found:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.find`."""
        around = None
        if self.cell is not None:
            reach = reach_of_beginnings(scene, self.stretches.lane, self.stretches.limits)
            around = cells_around(scene, self.cell, extent, self.capacity, reach)
        boundary = Hierarchy.over(self.boundary, scene)
        cells = None if self.cells is None else Hierarchy.over(self.cells, scene)
        stretches = self.stretches
        number = Pencils.number_of(scene.rays.lane_count)
        seen = lambda lane: stretches.seen_by(scene, lane)  # noqa: E731
        pencils = Pencils.through(scene, boundary, stretches.pencil, number, seen)
        counts = count_entries(_BundleSearch(scene, self, boundary, pencils, cells, around), scene.rays.count)
        boxes = [part.boxes for part in (boundary, cells) if part is not None]
        return Found(counts, around, boxes, pencils=pencils)

    def settled(self, scene: Scene, found: Found, told: Told) -> EntryLists:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.settled`."""
        boundary, *rest = found.boxes
        cells = None if self.cells is None else Hierarchy(scene.backend, self.cells, rest[0])
        whole = Hierarchy(scene.backend, self.boundary, boundary)
        assert found.pencils is not None
        search = _BundleSearch(scene, self, whole, found.pencils, cells, found.around)
        return list_entries(search, found.counts, told, self.stretches.limits is not None and not told.sees_all)


@dataclass
class _BundleSearch:
    """The boundary of a mesh and, where rays may begin inside, its cells."""

    scene: Scene
    plan: BundleEntries
    boundary: Hierarchy
    pencils: Pencils
    cells: Hierarchy | None
    around: Around | None

    def for_each(self, visit: Visit, settle: Settle) -> None:
        if self.around is not None or self.cells is not None:
            self._for_each_start(visit)
            settle()
        self._for_each_entry(visit)
        settle()

    def _for_each_entry(self, visit: Visit) -> None:
        """Boundary faces that rays may enter through between their limits."""
        lane = self.plan.stretches.lane
        rays, near, far = self.plan.stretches.seen(self.scene)

        def at_face(half_face: Any, active: Any, state: Any) -> Any:
            face, _ = self.scene.face_and_apex(rays.frame, half_face, active)

            def held(state: Any) -> Any:
                depth = crossing_depth(face)
                is_hit = (depth > near) & (depth < far)
                visit(Hit(rays.pixel, lane, half_face, depth, is_hit))
                return state

            return dr.if_stmt((state,), holds_ray(face) & active, held, lambda state: state)

        beam = Beam.of(rays, near, far)
        beam.valid = self.pencils.for_each(lane, rays.valid, at_face, lane)
        self.boundary.meet_lines(beam, at_face, lane)

    def _for_each_start(self, visit: Visit) -> None:
        """Cells in which rays may start."""
        plan, scene = self.plan, self.scene
        lane = plan.stretches.lane
        rays, near, _ = plan.stretches.seen(scene)
        search = StartSearch(scene, plan.adjacency, rays, lane, near)
        if self.around is not None:
            for_each_start_among(search, self.around, visit)
            return
        frame = rays.frame
        assert self.cells is not None and frame.origin is not None
        begin = tuple(dr.fma(near, d, o) for d, o in zip(frame.direction, frame.origin, strict=True))

        def at_cell(cell: Any, active: Any, state: Any) -> Any:
            search.look_at(cell, active, visit)
            return state

        self.cells.meet_points(begin, NEAR, rays.valid, at_cell, lane)
