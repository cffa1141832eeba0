"""Where the rays of a camera enter cells: faces are rasterised (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.rendering.search.entry import EntryLists, count_entries, list_entries
from difftetvr.rendering.search.hits import Settle, Visit
from difftetvr.rendering.search.memory_order import MeshTables
from difftetvr.rendering.search.plan import Around, Found, Told
from difftetvr.rendering.search.rasterise import for_each_hit, work_items, workers_for
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.search.starts import AROUND, StartSearch, cells_around, for_each_start_among
from difftetvr.rendering.traversal.rays import ImageRays


@dataclass
class CameraEntries:
    """Plans to find where the rays of a camera enter a mesh, or start in it.

    Attributes:
        lane: Numbers of the lanes that have rays.
        worker: Those of the lanes that rasterise.
        boundary: (faces,) half-faces of the boundary, `NONE` for none.
        lengths: Those of ``worker`` and ``boundary``.
        cell: Numbers of all cells.
        adjacency: Flat (T, 4) cells behind the half-faces.
        capacity: Cells around the camera that there is room for.
        sees_all: See :class:`difftetvr.rendering.search.plan.SearchPlan`.
    """

    lane: Any
    worker: Any
    boundary: Any
    lengths: tuple[int, int]
    cell: Any
    adjacency: Any
    capacity: int = AROUND
    sees_all: Any | None = None

    @staticmethod
    def of(backend: Backend, tables: MeshTables, rays: ImageRays) -> CameraEntries:
        """Plan for a mesh."""
        workers = workers_for(tables.faces, rays.count)
        lane, worker = (backend.lanes(count) for count in (rays.lane_count, workers))
        return CameraEntries(lane, worker, tables.boundary, (workers, tables.faces), tables.numbers, tables.adjacency)

    def find(self, scene: Scene, extent: Any) -> Found:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.find`."""
        around = cells_around(scene, self.cell, extent, self.capacity, None)
        return Found(count_entries(_CameraSearch(scene, self, around), scene.rays.count), around, [])

    def settled(self, scene: Scene, found: Found, told: Told) -> EntryLists:
        """See :meth:`difftetvr.rendering.search.plan.SearchPlan.settled`."""
        assert found.around is not None
        return list_entries(_CameraSearch(scene, self, found.around), found.counts, told, told.around > 0)


@dataclass
class _CameraSearch:
    """The boundary of a mesh in front of a camera, and the cells around it."""

    scene: Scene
    plan: CameraEntries
    around: Around

    def for_each(self, visit: Visit, settle: Settle) -> None:
        scene, plan = self.scene, self.plan
        near = dr.zeros(scene.backend.Float, dr.width(plan.lane))
        starts = StartSearch(scene, plan.adjacency, scene.rays.of_lanes(plan.lane), plan.lane, near)
        for_each_start_among(starts, self.around, visit)
        settle()
        for_each_hit(scene, work_items(scene, plan.boundary, plan.worker), visit)
        settle()
