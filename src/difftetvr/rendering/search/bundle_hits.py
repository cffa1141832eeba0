"""Where the rays of a bundle enter cells, found in hierarchies of boxes (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from difftetvr.backend import Backend
from difftetvr.recording import replayed
from difftetvr.rendering.search.hierarchy import CELLS_OF_A_LEAF, Hierarchy, SortedItems, sorted_cells
from difftetvr.rendering.search.hits import Hit
from difftetvr.rendering.search.memory_order import OrderedMesh
from difftetvr.rendering.search.scene import Scene, boundary_half_faces
from difftetvr.rendering.search.starts import (
    NEAR,
    PointStarts,
    StartSearch,
    find_cells_around,
    for_each_start_among,
    reach_of_beginnings,
)
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.walk import crossing_depth, find_exit, holds_ray

_FACES_OF_A_LEAF = 1
_ONE_POINT = 64.0  # roundings by which the beginnings of rays may differ to count as one point


@dataclass
class BundleSearch:
    """The cells of a mesh, and a bundle of rays that may cross them.

    Attributes:
        scene: The cells and the rays.
        lane: Numbers of all lanes.
        limits: Flat (N, 2) distances between which each ray is looked at; None for all of it.
        boundary: Over the half-faces of the boundary; None where entries are not asked for.
        cells: Over all cells; None where no cells are looked for in it.
        adjacency: Flat (T, 4) cells behind the half-faces, where rays may start inside.
        starts: The cells around the one point where all rays begin; None where there is none.
    """

    scene: Scene
    lane: Any
    limits: Any | None
    boundary: Hierarchy | None
    cells: Hierarchy | None
    adjacency: Any | None
    starts: PointStarts | None

    @staticmethod
    def for_entries(scene: Scene, mesh: OrderedMesh, limits: Any | None) -> BundleSearch:
        """What finds where rays enter the mesh, or start in it.

        Args:
            scene: The cells and the rays.
            mesh: The cells, and where they are in the space of the rays.
            limits: (N, 2) distances between which each ray is looked at; None for all of it.
        """
        backend, topology = scene.backend, mesh.order.topology

        def build() -> SortedItems:
            return SortedItems.of(boundary_half_faces(topology), topology.boundary_faces, mesh.positions)

        items = topology.cached("hierarchy.boundary", build)
        boundary = Hierarchy.over(backend, items, mesh.positions, _FACES_OF_A_LEAF)
        lane = backend.lanes(scene.rays.lane_count)
        if limits is None:
            return BundleSearch(scene, lane, None, boundary, None, None, None)
        starts = _starts_at_one_point(scene, lane, mesh, limits)
        cells = _over_cells(backend, mesh) if starts is None else None
        return BundleSearch(scene, lane, limits, boundary, cells, mesh.tables.adjacency, starts)

    @staticmethod
    def for_fragments(scene: Scene, mesh: OrderedMesh, limits: Any | None) -> BundleSearch:
        """What finds all cells that rays cross; the arguments are those of :meth:`for_entries`."""
        lane = scene.backend.lanes(scene.rays.lane_count)
        return BundleSearch(scene, lane, limits, None, _over_cells(scene.backend, mesh), None, None)

    def for_each(self, visit: Callable[[Hit], None], settle: Callable[[], Any]) -> None:
        """Call ``visit`` for all half-faces that rays may enter through, or start behind.

        Args:
            visit: Takes a hit.
            settle: Called after each kernel's worth of hits.
        """
        if self.adjacency is not None:
            self._for_each_start(visit)
            settle()
        self._for_each_entry(visit)
        settle()

    def _lanes(self) -> tuple[Lanes, Any, Any]:
        """The rays, and the distances between which they are looked at."""
        real, rays = self.scene.backend.Float, self.scene.rays.of_lanes(self.lane)
        if self.limits is None:
            near, far = (dr.full(real, end, dr.width(self.lane)) for end in (-dr.inf, dr.inf))
            return rays, near, far
        ends = dr.gather(self.scene.backend.Float2, self.limits, rays.pixel, rays.valid)
        return rays, ends[0], ends[1]

    def _for_each_entry(self, visit: Callable[[Hit], None]) -> None:
        """Call ``visit`` for all boundary faces that rays may enter through between their limits."""
        assert self.boundary is not None
        rays, near, far = self._lanes()

        def at_face(half_face: Any, active: Any, state: Any) -> Any:
            face, _ = self.scene.face_and_apex(rays.frame, half_face, active)

            def held(state: Any) -> Any:
                depth = crossing_depth(face)
                is_hit = (depth > near) & (depth < far)
                visit(Hit(rays.pixel, self.lane, half_face, depth, is_hit))
                return state

            return dr.if_stmt((state,), holds_ray(face) & active, held, lambda state: state)

        self.boundary.meet_lines(rays.frame, near, far, rays.valid, at_face, self.lane)

    def for_each_fragment(self, visit: Callable[[Hit], None]) -> None:
        """Call ``visit`` for all cells that rays may cross between their limits, whole or in part."""
        assert self.cells is not None
        rays, near, far = self._lanes()

        def at_cell(cell: Any, active: Any, state: Any) -> Any:
            is_crossed, half_face = self.scene.entered(rays.frame, cell, active)

            def crossed(state: Any) -> Any:
                face, apex = self.scene.face_and_apex(rays.frame, half_face)
                exit_depth = crossing_depth(find_exit(face, apex).face(face, apex))
                depth = crossing_depth(face)
                is_hit = (exit_depth > near) & (depth < far)
                visit(Hit(rays.pixel, self.lane, half_face, depth, is_hit))
                return state

            return dr.if_stmt((state,), is_crossed, crossed, lambda state: state)

        self.cells.meet_lines(rays.frame, near, far, rays.valid, at_cell, self.lane)

    def _for_each_start(self, visit: Callable[[Hit], None]) -> None:
        """Call ``visit`` for all cells in which rays may start."""
        rays, near, _ = self._lanes()
        if self.starts is not None:
            for_each_start_among(self.starts.search(self.scene, rays, near), self.starts, visit)
            return
        assert self.cells is not None
        search = StartSearch(self.scene, self.adjacency, rays, self.lane, near)
        frame = rays.frame
        assert frame.origin is not None
        begin = tuple(dr.fma(near, d, o) for d, o in zip(frame.direction, frame.origin, strict=True))

        def at_cell(cell: Any, active: Any, state: Any) -> Any:
            search.look_at(cell, active, visit)
            return state

        self.cells.meet_points(begin, NEAR, rays.valid, at_cell, self.lane)


def _starts_at_one_point(scene: Scene, lane: Any, mesh: OrderedMesh, limits: Any) -> PointStarts | None:
    """Cells around the point where all rays begin, which are found once for all of them; None if it is not one."""
    reach = replayed(reach_of_beginnings, scene, lane, limits)
    assert mesh.largest is not None
    ends = reach.numpy()[:6].astype(float)
    if not np.isfinite(ends).all():
        return None
    spread, size = (ends[0::2] + ends[1::2]).max(), max(abs(ends).max(), mesh.largest)
    if not spread <= _ONE_POINT * float(dr.epsilon(scene.backend.Float)) * size:
        return None
    cell = scene.backend.lanes(mesh.order.topology.num_cells)
    cells, count, _ = find_cells_around(scene, cell, mesh.extent, reach)
    return PointStarts(cells, count, mesh.tables.adjacency, lane)


def _over_cells(backend: Backend, mesh: OrderedMesh) -> Hierarchy:
    return Hierarchy.over(backend, sorted_cells(mesh.order.topology, mesh.positions), mesh.positions, CELLS_OF_A_LEAF)
