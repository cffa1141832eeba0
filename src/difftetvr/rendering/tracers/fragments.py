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

from difftetvr.rendering.search.bundle_hits import BundleSearch
from difftetvr.rendering.search.hits import Hit
from difftetvr.rendering.search.rasterise import for_each_hit, work_items, workers_for
from difftetvr.rendering.search.scene import NONE
from difftetvr.rendering.search.starts import find_cells_around
from difftetvr.rendering.tracers.aim import Aim
from difftetvr.rendering.tracers.bands import Band
from difftetvr.rendering.traversal.bundle import BundleRays
from difftetvr.rendering.traversal.walk import crossing_depth, find_exit, holds_ray

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

    def __init__(self, aim: Aim) -> None:
        """Take a view."""
        self.scene, backend = aim.scene, aim.scene.backend
        self.half_faces = 4 * aim.ordered.order.topology.num_cells
        self.bundle, self.around, self.around_count = None, None, 0
        if isinstance(self.scene.rays, BundleRays):
            self.bundle = BundleSearch.for_fragments(self.scene, aim.ordered, aim.view.limits)
            return
        cells = backend.lanes(self.half_faces // 4)
        self.around, _, self.around_count = find_cells_around(self.scene, cells, aim.ordered.extent)

    @property
    def starts_inside(self) -> bool:
        """Whether some crossings begin behind the camera."""
        return self.around_count > 0

    def count(self) -> torch.Tensor:
        """(lanes,) int64 number of fragments of each lane: its depth complexity."""
        uint = self.scene.backend.UInt
        counts = dr.zeros(uint, self.scene.rays.lane_count)

        def add(hit: Hit) -> None:
            dr.scatter_add(counts, uint(1), hit.lane, hit.is_hit)

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
            is_hit = hit.is_hit & (hit.lane >= first) & (hit.lane < last)
            node = dr.scatter_inc(used, uint(0), is_hit)
            before = dr.scatter_exch(lists.heads, node, hit.lane - first, is_hit)
            dr.scatter(lists.following, before, node, is_hit)
            dr.scatter(lists.faces, hit.half_face, node, is_hit)
            dr.scatter(lists.depths, hit.depth, node, is_hit)

        self._for_each(push, lists)
        return lists

    def _for_each(self, visit: Any, results: Any) -> None:
        backend = self.scene.backend
        backend.run(results)
        if self.bundle is not None:
            self.bundle.for_each_fragment(visit)
            backend.run(results)
            return
        for begin in range(0, self.half_faces, _FACES_AT_A_TIME):
            count = min(_FACES_AT_A_TIME, self.half_faces - begin)
            half_face = dr.arange(backend.UInt, count) + backend.opaque_uint(begin)
            worker = backend.lanes(workers_for(count, self.scene.rays.count))
            items = work_items(self.scene, half_face, worker)
            for_each_hit(self.scene, items, visit)
            backend.run(results)
        if self.around_count:
            self._for_each_around(visit)
            backend.run(results)

    def _for_each_around(self, visit: Any) -> None:
        """Crossings of cells that hold the camera: they begin behind it, where no face is rasterised."""
        scene, uint = self.scene, self.scene.backend.UInt
        lane = dr.arange(uint, scene.rays.lane_count)
        rays = scene.rays.of_lanes(lane)
        count = scene.backend.opaque_uint(4 * self.around_count)

        def body(index: Any) -> tuple[Any]:
            half_face = 4 * dr.gather(uint, self.around, index >> 2) + (index & 3)
            face, apex = scene.face_and_apex(rays.frame, half_face)
            depth, exit_depth = crossing_depth(face), crossing_depth(find_exit(face, apex).face(face, apex))
            is_hit = rays.valid & holds_ray(face) & (depth <= 0) & (exit_depth > 0)
            visit(Hit(rays.pixel, lane, half_face, depth, is_hit))
            return (index + 1,)

        dr.while_loop((dr.zeros(uint, scene.rays.lane_count),), lambda index: index < count, body)
