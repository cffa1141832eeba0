"""The projected-tetrahedra renderer: cells sorted front to back, composited tile by tile (article appendix 10; Dr.Jit).

One order serves the whole view, so nothing is sorted per pixel and nothing is known of neighbours: loose cells render,
too. Memory does not grow with the image or its depth complexity. As in the article the order may be only approximate
where the mesh is not convex or has no order at all; then a warning says so.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.rendering.search.bundle_hits import Stretches
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.tracers.aim import Aim
from difftetvr.rendering.tracers.cell_order import KeyedCells, OrderPlan
from difftetvr.rendering.tracers.tiles import TILE_BITS, TileLists, Tiler
from difftetvr.rendering.traversal.crossing import Kernel, View, cross_cell
from difftetvr.rendering.traversal.rays import Lanes

PAIR_BUDGET = 1 << 23
"""Pairs of cell and tile that are held at a time."""


class OrderWarning(UserWarning):
    """Cells are composited in an order that may be wrong in places."""


@dataclass
class Projected:
    """Composites cells in one order.

    Attributes:
        view: What kernels read.
        scene: The cells.
        columns: Tiles in a row of the image.
        parts: The cells of each tile, front to back; where they are too many to be held, what sorts some at a time.
        starts_inside: Whether some crossings may begin behind the camera.
    """

    view: View
    scene: Scene
    columns: int
    parts: list[TileLists] | Tiler
    starts_inside: bool

    @staticmethod
    def plan(backend: Backend, mesh: TetMesh, rays: Any, stretches: Stretches | None) -> OrderPlan:
        """How to sort the cells."""
        return OrderPlan.of(backend, mesh)

    @staticmethod
    def of(aim: Aim) -> Projected:
        """Sort the cells front to back, and into tiles."""
        found: KeyedCells = aim.found
        cells = found.sorted(aim.view.backend, aim.order.topology)
        if not cells.exact:
            warnings.warn(
                "The cells of this mesh have no certain front-to-back order for the whole view (it is not convex, has "
                "cells that overlap cyclically, or loose ones), so renderer='projected' may blend some in the wrong "
                "order; renderer='marching' is exact for meshes of joined cells.",
                OrderWarning,
                stacklevel=2,
            )
        told = found.told
        # The total may have run over where it could be so great.
        pairs = told.total if told.most * len(cells.order) < 1 << 32 else None
        tiler = Tiler(aim.scene, found.tiles, cells.order, pairs, PAIR_BUDGET)
        parts = [*tiler.lists()] if len(tiler.parts) < 2 else tiler
        return Projected(aim.view, aim.scene, tiler.columns, parts, found.starts_inside)

    def on_lanes(self, lane: Any) -> None:
        """See :meth:`difftetvr.rendering.traversal.crossing.Tracer.on_lanes`."""

    def trace(self, make_kernel: Callable[[Lanes], Kernel]) -> None:
        """Cross the cells of every tile, front to back."""
        rays = self.view.lanes
        kernel = make_kernel(rays)
        ray = kernel.start()
        if isinstance(self.parts, list):
            for lists in self.parts:
                ray = self._composite(kernel, rays, lists, ray)
        else:
            for lists in self.parts.lists():
                ray = self._composite(kernel, rays, lists, ray)
                self.view.backend.run(ray)  # before the lists of the next part
        kernel.finish(ray)

    def _composite(self, kernel: Kernel, rays: Lanes, lists: TileLists, ray: Any) -> Any:
        integer, uint, width = self.view.backend.Int, self.view.backend.UInt, self.scene.image.width
        row = rays.pixel // width
        tile = (row >> TILE_BITS) * self.columns + ((rays.pixel - row * width) >> TILE_BITS)
        # A ray without a tile has an empty list: gathers give 0 where they are masked.
        begin, end = (uint(dr.gather(integer, lists.bounds, tile + k, rays.valid)) for k in range(2))

        def cross(index: Any, ray: Any) -> tuple[Any, Any]:
            cell = uint(dr.gather(integer, lists.cells, index))
            is_hit, half_face = self.scene.entered(rays.frame, cell)

            def hit(ray: Any) -> Any:
                return cross_cell(kernel, cell, self.scene.indices_and_apex(half_face), ray, True)

            return index + 1, dr.if_stmt((ray,), is_hit, hit, lambda ray: ray)

        more = lambda index, ray: (index < end) & kernel.goes_on(ray)  # noqa: E731
        return dr.while_loop((begin, ray), more, cross)[1]
