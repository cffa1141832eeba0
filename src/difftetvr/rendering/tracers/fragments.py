"""Per-pixel linked lists of fragments (article section 4; Yang et al. 2010), built by rasterising faces (Dr.Jit).

A fragment is a face through which a ray enters a cell, so it stands for the whole crossing of that cell: which face
the ray leaves through follows from the exact rule of the walk. Every crossing makes one fragment, on any mesh; an order
that rounding has mixed up costs as little as the crossings concerned are long.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.mesh import TetMesh
from difftetvr.rendering.tracers.bands import Band
from difftetvr.rendering.tracers.camera_inside import cells_around_camera
from difftetvr.rendering.tracers.entry_table import HalfFaceScene
from difftetvr.rendering.tracers.rasterise import Hit, for_each_hit, work_items
from difftetvr.rendering.traversal.rays import lane_count, lane_pixel, pixel_lane
from difftetvr.rendering.traversal.walk import crossing_depth, find_exit, holds_ray

NONE = 0xFFFFFFFF
"""Ends a list."""

_FACES_AT_A_TIME = 1 << 22  # bounds the memory of work items


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


class FragmentRaster:
    """Finds the fragments of a view."""

    def __init__(self, scene: HalfFaceScene, mesh: TetMesh, vertices: torch.Tensor) -> None:
        self.scene = scene
        self.rows = 4 * mesh.num_cells
        around = cells_around_camera(scene.backend, mesh, vertices)
        self.around = None if around is None else scene.backend.uints(around)

    def count(self) -> torch.Tensor:
        """(lanes,) int64 number of fragments of each lane: its depth complexity."""
        uint = self.scene.backend.UInt
        counts = dr.zeros(uint, lane_count(self.scene.camera.width, self.scene.camera.height))

        def add(hit: Hit) -> None:
            dr.scatter_add(counts, uint(1), pixel_lane(self.scene.rays, hit.column, hit.row), hit.is_hit)

        self._for_each(add, counts)
        return self.scene.backend.tensor(self.scene.backend.Int(counts)).long()

    def lists(self, band: Band) -> FragmentLists:
        """Push the fragments of a band's pixels to their lists."""
        backend = self.scene.backend
        uint, size = backend.UInt, max(band.total, 1)
        lists = FragmentLists(
            dr.full(uint, NONE, band.last - band.first),
            dr.empty(uint, size),
            dr.empty(uint, size),
            dr.empty(backend.Float, size),
        )
        used = dr.zeros(uint, 1)
        first, last = backend.opaque_uint(band.first), backend.opaque_uint(band.last)

        def push(hit: Hit) -> None:
            lane = pixel_lane(self.scene.rays, hit.column, hit.row)
            is_hit = hit.is_hit & (lane >= first) & (lane < last)
            node = dr.scatter_inc(used, uint(0), is_hit)
            before = dr.scatter_exch(lists.heads, node, lane - first, is_hit)
            dr.scatter(lists.following, before, node, is_hit)
            dr.scatter(lists.faces, hit.face, node, is_hit)
            dr.scatter(lists.depths, hit.depth, node, is_hit)

        self._for_each(push, lists)
        return lists

    def _for_each(self, visit: Any, results: Any) -> None:
        self.scene.backend.run(results)
        for begin in range(0, self.rows, _FACES_AT_A_TIME):
            items = work_items(self.scene, begin, min(begin + _FACES_AT_A_TIME, self.rows))
            for_each_hit(self.scene, items, visit)
            self.scene.backend.run(results)
        if self.around is not None:
            self._for_each_around(visit)
            self.scene.backend.run(results)

    def _for_each_around(self, visit: Any) -> None:
        """Crossings of cells that hold the camera: they begin behind it, where no face is rasterised."""
        scene, uint = self.scene, self.scene.backend.UInt
        lanes = lane_count(scene.camera.width, scene.camera.height)
        column, row, valid = lane_pixel(scene.rays, dr.arange(uint, lanes))
        frame = scene.rays.frame(column, row)
        count = scene.backend.opaque_uint(4 * dr.width(self.around))

        def body(index: Any) -> tuple[Any]:
            half_face = 4 * dr.gather(uint, self.around, index >> 2) + (index & 3)
            face = scene.face(frame, half_face)
            apex = scene.corner(frame, scene.indices_and_apex(half_face)[3])
            depth, exit_depth = crossing_depth(face), crossing_depth(find_exit(face, apex).face(face, apex))
            visit(Hit(column, row, half_face, depth, valid & holds_ray(face) & (depth <= 0) & (exit_depth > 0)))
            return (index + 1,)

        dr.while_loop((dr.zeros(uint, dr.width(column)),), lambda index: index < count, body)
