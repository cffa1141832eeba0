"""Where the rays of a bundle enter cells, found in hierarchies of boxes (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import drjit as dr
import torch

from difftetvr.mesh import TetMesh
from difftetvr.rendering.search.hierarchy import CELLS_OF_A_LEAF, Hierarchy, SortedItems, sorted_cells
from difftetvr.rendering.search.hits import Hit
from difftetvr.rendering.search.scene import Scene, boundary_half_faces
from difftetvr.rendering.search.starts import NEAR, StartSearch
from difftetvr.rendering.traversal.walk import crossing_depth, find_exit, holds_ray

_FACES_OF_A_LEAF = 1


class BundleScene:
    """The cells of a mesh, and a bundle of rays that may cross them."""

    def __init__(self, scene: Scene, mesh: TetMesh, vertices: torch.Tensor, limits: Any | None) -> None:
        """Take what was uploaded.

        Args:
            scene: The cells and the rays.
            mesh: The mesh, for its topology.
            vertices: (V, 3) its vertices in the space of the rays.
            limits: (N, 2) distances between which each ray is looked at; None for all of it.
        """
        self.scene, self.mesh, self.vertices, self.limits = scene, mesh, vertices.detach(), limits
        backend = scene.backend
        self.lane = dr.arange(backend.UInt, scene.rays.lane_count)
        self.lanes = scene.rays.of_lanes(self.lane)
        if limits is None:
            self.near, self.far = (dr.full(backend.Float, end, scene.rays.lane_count) for end in (-dr.inf, dr.inf))
        else:
            ends = dr.gather(backend.Float2, limits, self.lanes.pixel, self.lanes.valid)
            self.near, self.far = ends[0], ends[1]

    @cached_property
    def boundary(self) -> Hierarchy:
        """Over the half-faces of the boundary."""

        def build() -> SortedItems:
            half_faces = boundary_half_faces(self.mesh)
            return SortedItems.of(half_faces, self.mesh.topology.boundary_faces, self.vertices)

        items = self.mesh.topology.cached("hierarchy.boundary", build)
        return Hierarchy.over(self.scene.backend, items, self.vertices, _FACES_OF_A_LEAF)

    @cached_property
    def cells(self) -> Hierarchy:
        """Over all cells."""
        items = sorted_cells(self.mesh, self.vertices)
        return Hierarchy.over(self.scene.backend, items, self.vertices, CELLS_OF_A_LEAF)

    def for_each_entry(self, visit: Callable[[Hit], None]) -> None:
        """Call ``visit`` for all boundary faces that rays may enter through between their limits."""

        def at_face(half_face: Any, active: Any, state: Any) -> Any:
            face, _ = self.scene.face_and_apex(self.lanes.frame, half_face, active)

            def held(state: Any) -> Any:
                depth = crossing_depth(face)
                is_hit = (depth > self.near) & (depth < self.far)
                visit(Hit(self.lanes.pixel, self.lane, half_face, depth, is_hit))
                return state

            return dr.if_stmt((state,), holds_ray(face) & active, held, lambda state: state)

        self.boundary.meet_lines(self.lanes.frame, self.near, self.far, self.lanes.valid, at_face, self.lane)

    def for_each_fragment(self, visit: Callable[[Hit], None]) -> None:
        """Call ``visit`` for all cells that rays may cross between their limits, whole or in part."""

        def at_cell(cell: Any, active: Any, state: Any) -> Any:
            is_crossed, half_face = self.scene.entered(self.lanes.frame, cell, active)

            def crossed(state: Any) -> Any:
                face, apex = self.scene.face_and_apex(self.lanes.frame, half_face)
                exit_depth = crossing_depth(find_exit(face, apex).face(face, apex))
                depth = crossing_depth(face)
                is_hit = (exit_depth > self.near) & (depth < self.far)
                visit(Hit(self.lanes.pixel, self.lane, half_face, depth, is_hit))
                return state

            return dr.if_stmt((state,), is_crossed, crossed, lambda state: state)

        self.cells.meet_lines(self.lanes.frame, self.near, self.far, self.lanes.valid, at_cell, self.lane)

    @property
    def may_start_inside(self) -> bool:
        """Whether rays may start inside the mesh."""
        return self.limits is not None

    def for_each_start(self, visit: Callable[[Hit], None]) -> None:
        """Call ``visit`` for all cells in which rays may start."""
        scene, frame = self.scene, self.lanes.frame
        adjacency = scene.backend.uints(self.mesh.topology.cell_adjacency)
        search = StartSearch(scene, adjacency, self.lanes, self.lane, self.near)
        assert frame.origin is not None
        begin = tuple(dr.fma(self.near, d, o) for d, o in zip(frame.direction, frame.origin, strict=True))

        def at_cell(cell: Any, active: Any, state: Any) -> Any:
            search.look_at(cell, active, visit)
            return state

        self.cells.meet_points(begin, NEAR, self.lanes.valid, at_cell, self.lane)
