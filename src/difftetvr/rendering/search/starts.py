"""Where rays start when their origin is inside the mesh, or on or near its boundary (Dr.Jit).

A path is a sequence of cells that a ray's line passes one after the other, from a boundary face to another. It has to
be walked once if any of it lies ahead of the origin. If its first face does, it is entered there. Else it starts at its
first cell that spans the origin: is entered before and left behind it. Depths grow along a path only but for rounding,
and of several paths that end and begin at the origin some may seem to span it; every one is walked, and once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.mesh.topology.topology import LOCAL_FACES
from difftetvr.rendering.search.hits import Hit, Visit
from difftetvr.rendering.search.plan import Around
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.traversal.rays import Lanes, rounding_of
from difftetvr.rendering.traversal.sums import raise_to
from difftetvr.rendering.traversal.walk import BOUNDARY, crossing_depth, find_exit

AROUND = 1 << 10
"""Cells around a camera that there is room for at first: mostly there is one."""

EXTENT = 8
"""Floats of an extent: greatest of x, -x, y, -y, z and -z; then 1 if something cannot be rendered; and one that the
greatest coordinate of a pose's translation takes the place of."""

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

    def look_at(self, cell: Any, active: Any, visit: Visit) -> None:
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


def for_each_start_among(search: StartSearch, around: Around, visit: Visit) -> None:
    """Call ``visit`` for all of some cells in which rays start."""
    uint, count = search.scene.backend.UInt, around.held

    def body(index: Any) -> tuple[Any]:
        search.look_at(dr.gather(uint, around.cells, index), search.rays.valid, visit)
        return (index + 1,)

    dr.while_loop((dr.zeros(uint, dr.width(search.lane)),), lambda index: index < count, body)


def reach_of_beginnings(scene: Scene, lane: Any, limits: Any) -> Any:
    """Greatest of x, -x, y, -y, z and -z of the points from which on some rays are looked at, and two numbers more.

    Args:
        scene: The rays; they have origins.
        lane: Numbers of all lanes.
        limits: Flat (N, 2) distances between which each ray is looked at.
    """
    backend, rays = scene.backend, scene.rays.of_lanes(lane)
    assert rays.frame.origin is not None
    near = dr.gather(backend.Float2, limits, rays.pixel, rays.valid)[0]
    reach = dr.full(backend.Float, -dr.inf, EXTENT)
    for axis, (d, o) in enumerate(zip(rays.frame.direction, rays.frame.origin, strict=True)):
        begin = dr.fma(near, d, o)
        # Where a ray begins nowhere, there is no one point.
        begin = dr.select(dr.isfinite(begin), begin, dr.inf)
        for side, end in enumerate((begin, -begin)):
            raise_to(backend, reach, dr.select(rays.valid, end, -dr.inf), 2 * axis + side)
    dr.eval(reach)
    return reach


def cells_around(scene: Scene, cell: Any, extent: Any, capacity: int, reach: Any | None) -> Around:
    """Cells that may hold the point where rays begin: it lies in them or very near.

    Args:
        scene: The cells.
        cell: (T,) their numbers.
        extent: Greatest of x, -x, y, -y, z and -z of any vertex: most cameras look at the mesh from outside.
        capacity: How many cells there is room for.
        reach: Of the point, likewise, as far as rounding lets it; None for the origin, where a camera is.
    """
    backend, uint, real = scene.backend, scene.backend.UInt, scene.backend.Float
    ends = [real(0) if reach is None else dr.gather(real, reach, uint(k)) for k in range(6)]
    around, blur = backend.Bool(True), real(0)
    farthest = [dr.gather(real, extent, uint(k)) for k in range(6)]
    if reach is not None:
        for k in range(6):
            blur = dr.fmax(blur, dr.fmax(rounding_of(dr.abs(farthest[k])), ends[k] + ends[k ^ 1]))
    for k in range(6):
        # Rounding may put a point on the boundary outside of the mesh's box.
        around &= farthest[k] >= -ends[k ^ 1] - blur
    corners = scene.cell(cell, around)
    center = [0.5 * (ends[2 * axis] - ends[2 * axis + 1]) for axis in range(3)]
    points = [[x - c for x, c in zip(scene.point(corners[k], around), center, strict=True)] for k in range(4)]
    size, lows, highs = real(0), [], []
    for axis in range(3):
        values = [point[axis] for point in points]
        lows.append(dr.fmin(dr.fmin(values[0], values[1]), dr.fmin(values[2], values[3])))
        highs.append(dr.fmax(dr.fmax(values[0], values[1]), dr.fmax(values[2], values[3])))
        size = dr.fmax(size, highs[axis] - lows[axis])
    margin = dr.fma(NEAR, size, blur)
    for low, high in zip(lows, highs, strict=True):
        around &= (low <= margin) & (high >= -margin)
    # With an outward face of a cell around it, the point spans a positive volume.
    for i, j, k in LOCAL_FACES:
        around &= _triple(points[i], points[j], points[k]) >= -margin * size * size
    found, used = dr.empty(uint, capacity), dr.zeros(uint, 1)
    place: Any = dr.scatter_inc(used, uint(0), around)
    dr.scatter(found, cell, place, around & (place < capacity))
    dr.eval(found, used)
    return Around(found, used)


def _triple(p: list[Any], q: list[Any], r: list[Any]) -> Any:
    """Six times the signed volume of the origin and three points."""
    return p[0] * (q[1] * r[2] - q[2] * r[1]) + p[1] * (q[2] * r[0] - q[0] * r[2]) + p[2] * (q[0] * r[1] - q[1] * r[0])
