"""Where the rays of a camera enter cells: faces are rasterised (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.rendering.search.hits import Hit
from difftetvr.rendering.search.memory_order import MeshTables
from difftetvr.rendering.search.rasterise import for_each_hit, work_items, workers_for
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.search.starts import PointStarts, cells_around, for_each_start_among
from difftetvr.rendering.traversal.rays import ImageRays


@dataclass
class CameraLanes:
    """Who does what in a search at a camera.

    Attributes:
        pixel: Numbers of the lanes that have rays.
        worker: Those of the lanes that rasterise.
        workers: Their number.
        cell: Numbers of all cells.
        capacity: Cells around the camera that there is room for.
    """

    pixel: Any
    worker: Any
    workers: int
    cell: Any
    capacity: int

    @staticmethod
    def of(backend: Backend, rays: ImageRays, faces: int, cells: int, capacity: int) -> CameraLanes:
        """Lanes for a camera, so many faces to rasterise, and so many cells."""
        workers = workers_for(faces, rays.count)
        lanes = (backend.lanes(count) for count in (rays.lane_count, workers, cells))
        pixel, worker, cell = lanes
        return CameraLanes(pixel, worker, workers, cell, capacity)


@dataclass
class CameraSearch:
    """The boundary of a mesh in front of a camera, and the cells around it.

    Attributes:
        scene: The cells and the rays.
        half_faces: (faces,) those of the boundary, `NONE` for none.
        worker: (workers,) numbers of the lanes that rasterise them.
        starts: The cells around the camera.
        faces: Length of ``half_faces``.
        workers: Length of ``worker``.
    """

    scene: Scene
    half_faces: Any
    worker: Any
    starts: PointStarts
    faces: int
    workers: int

    @staticmethod
    def of(scene: Scene, tables: MeshTables, lanes: CameraLanes, extent: Any) -> CameraSearch:
        """Search a scene in camera space of some extent."""
        cells, count = cells_around(scene, lanes.cell, extent, lanes.capacity, None)
        starts = PointStarts(cells, count, tables.adjacency, lanes.pixel)
        return CameraSearch(scene, tables.boundary, lanes.worker, starts, tables.faces, lanes.workers)

    def for_each(self, visit: Callable[[Hit], None], settle: Callable[[], Any]) -> None:
        """Call ``visit`` for all half-faces that rays may enter through, or start behind.

        Args:
            visit: Takes a hit.
            settle: Called after each kernel's worth of hits.
        """
        lane = self.starts.lane
        near = dr.zeros(self.scene.backend.Float, dr.width(lane))
        for_each_start_among(self.starts.search(self.scene, self.scene.rays.of_lanes(lane), near), self.starts, visit)
        settle()
        for_each_hit(self.scene, work_items(self.scene, self.half_faces, self.worker), visit)
        settle()
