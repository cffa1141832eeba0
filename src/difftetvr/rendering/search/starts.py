"""Where rays start when their origin is inside the mesh, or on or near its boundary (Dr.Jit).

A path is a sequence of cells that a ray's line passes one after the other, from a boundary face to another. It has to
be walked once if any of it lies ahead of the origin. If its first face does, it is entered there. Else it starts at its
first cell that spans the origin: is entered before and left behind it. Depths grow along a path only but for rounding,
and of several paths that end and begin at the origin some may seem to span it; every one is walked, and once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.mesh.topology.topology import LOCAL_FACES
from difftetvr.rendering.search.hits import Hit
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.walk import BOUNDARY, crossing_depth, find_exit

NEAR = 1e-4
"""Cells this near to an origin, relative to their size, are tried as the cell that holds it; each ray then decides."""


@dataclass(frozen=True)
class StartSearch:
    """Tells which cells around their origins rays start in.

    Attributes:
        scene: The cells.
        adjacency: Flat (T, 4) cells behind the half-faces.
        rays: The rays.
        lane: Their lanes.
        near: Distance from which on each is looked at.
    """

    scene: Scene
    adjacency: Any
    rays: Lanes
    lane: Any
    near: Any

    def look_at(self, cell: Any, active: Any, visit: Callable[[Hit], None]) -> None:
        """Call ``visit`` with the half-face through which a cell is entered, a hit if the ray starts there."""
        is_crossed, half_face = self.scene.entered(self.rays.frame, cell, active)

        def crossed(half_face: Any) -> Any:
            face, apex = self.scene.face_and_apex(self.rays.frame, half_face)
            depth, exit_depth = crossing_depth(face), crossing_depth(find_exit(face, apex).face(face, apex))
            spans = (depth <= self.near) & (exit_depth > self.near)
            visit(Hit(self.rays.pixel, self.lane, half_face, depth, self._is_first(half_face, spans)))
            return half_face

        dr.if_stmt((half_face,), is_crossed, crossed, lambda half_face: half_face)

    def _is_first(self, half_face: Any, spans: Any) -> Any:
        """Whether no cell of the path before this one spans the origin, and its first face does not lie ahead.

        The path is followed back only as far as rounding leaves a doubt, which mostly is nowhere.
        """
        scene, frame, near = self.scene, self.rays.frame, self.near

        def back(half_face: Any, is_first: Any, active: Any) -> tuple[Any, Any, Any]:
            face, _ = scene.face_and_apex(frame, half_face, active)
            depth, behind = crossing_depth(face), dr.gather(scene.backend.UInt, self.adjacency, half_face, active)
            in_doubt = active & (depth >= near - _rounding(face))
            at_boundary = in_doubt & (behind == BOUNDARY)
            goes_on = in_doubt & ~at_boundary
            _, before = scene.entered(frame, behind, goes_on)
            earlier, _ = scene.face_and_apex(frame, before, goes_on)
            spans_earlier = goes_on & (crossing_depth(earlier) <= near) & (depth > near)
            is_first &= ~((at_boundary & (depth > near)) | spans_earlier)
            goes_on &= ~spans_earlier
            return dr.select(goes_on, before, half_face), is_first, goes_on

        return dr.while_loop((half_face, spans, spans), lambda half_face, first, active: active, back)[1]


def _rounding(face: Any) -> Any:
    """By how much, at most, rounding moves where a ray crosses a face."""
    size = type(face.corners[0].a)(0)
    for corner in face.corners:
        for value in (corner.a, corner.b, corner.values[0]):
            size = dr.fmax(size, dr.abs(value))
    return 16.0 * dr.epsilon(size) * size


def for_each_start_at_camera(scene: Scene, mesh: TetMesh, around: torch.Tensor, visit: Callable[[Hit], None]) -> None:
    """Call ``visit`` for the cells in which rays of a camera may start.

    Args:
        scene: The cells, and the camera's rays.
        mesh: Mesh, for its adjacency.
        around: Cells around the camera.
        visit: Takes a hit.
    """
    backend, uint = scene.backend, scene.backend.UInt
    lane = dr.arange(uint, scene.rays.lane_count)
    rays = scene.rays.of_lanes(lane)
    cells, count = backend.uints(around), backend.opaque_uint(around.shape[0])
    near = dr.zeros(backend.Float, scene.rays.lane_count)
    search = StartSearch(scene, backend.uints(mesh.topology.cell_adjacency), rays, lane, near)

    def body(index: Any) -> tuple[Any]:
        search.look_at(dr.gather(uint, cells, index), rays.valid, visit)
        return (index + 1,)

    dr.while_loop((dr.zeros(uint, scene.rays.lane_count),), lambda index: index < count, body)


def cells_around_camera(backend: Backend, mesh: TetMesh, camera_vertices: torch.Tensor) -> torch.Tensor | None:
    """Cells that may hold the camera: it lies in them or very near; None if there are none."""
    positions = camera_vertices.detach()
    # One axis after the other: most cameras look at the mesh from outside, and z says so.
    if any(positions[:, axis].amin() > 0 or positions[:, axis].amax() < 0 for axis in (2, 0, 1)):
        return None
    vertices, tets = backend.floats(positions), backend.uints(mesh.tets)
    cell = dr.arange(backend.UInt, mesh.num_cells)
    points = []
    for k in range(4):
        index = dr.gather(backend.UInt, tets, 4 * cell + k)
        points.append([dr.gather(backend.Float, vertices, 3 * index + axis) for axis in range(3)])

    extent, around = backend.Float(0), backend.Bool(True)
    lows, highs = [], []
    for axis in range(3):
        values = [point[axis] for point in points]
        lows.append(dr.fmin(dr.fmin(values[0], values[1]), dr.fmin(values[2], values[3])))
        highs.append(dr.fmax(dr.fmax(values[0], values[1]), dr.fmax(values[2], values[3])))
        extent = dr.fmax(extent, highs[axis] - lows[axis])
    margin = NEAR * extent
    for low, high in zip(lows, highs, strict=True):
        around &= (low <= margin) & (high >= -margin)
    # The camera is the origin: with an outward face of a cell around it, it spans a positive volume.
    for i, j, k in LOCAL_FACES:
        around &= _triple(points[i], points[j], points[k]) >= -NEAR * extent * extent * extent
    found = dr.compress(around)
    return None if dr.width(found) == 0 else backend.tensor(backend.Int(found))


def _triple(p: list[Any], q: list[Any], r: list[Any]) -> Any:
    """Six times the signed volume of the origin and three points."""
    return p[0] * (q[1] * r[2] - q[2] * r[1]) + p[1] * (q[2] * r[0] - q[0] * r[2]) + p[2] * (q[0] * r[1] - q[1] * r[0])
