"""Boundary faces to pixels, by the exact rule of the walk (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.render.entry_table import EntryScene
from difftetvr.render.rays import pixel_frame
from difftetvr.render.walk import Corner, crossing_depth, holds_ray, make_face


@dataclass
class WorkItems:
    """Pieces of faces to rasterise: each is one image row of one face's bounding box."""

    face: Any
    row: Any
    first_column: Any
    last_column: Any


def work_items(scene: EntryScene, rows: int) -> WorkItems | None:
    """Work items of the table's first ``rows`` rows, None if no face is in sight."""
    backend, uint = scene.backend, scene.backend.UInt
    (column0, column1), (row0, row1), visible = _pixel_boxes(scene, dr.arange(uint, rows))
    heights = backend.tensor(dr.select(visible, row1 - row0 + 1, 0))
    faces = torch.arange(rows, dtype=torch.int32, device=backend.device)
    owners = torch.repeat_interleave(faces, heights)
    total = owners.shape[0]
    if total == 0:
        return None
    begins = (heights.cumsum(0) - heights).to(torch.int32)
    owner = backend.uints(owners)
    offset = dr.arange(uint, total) - dr.gather(uint, backend.uints(begins), owner)
    row = uint(dr.gather(backend.Int, row0, owner)) + offset
    first_column, last_column = (uint(dr.gather(backend.Int, c, owner)) for c in (column0, column1))
    backend.run(owner, row, first_column, last_column)
    return WorkItems(owner, row, first_column, last_column)


def _pixel_boxes(scene: EntryScene, face: Any) -> tuple[tuple[Any, Any], tuple[Any, Any], Any]:
    """First and last column and row of the pixels that may see each face, and whether there are any."""
    uint, real, pinhole = scene.backend.UInt, scene.backend.Float, scene.pinhole
    infinity = real(dr.inf)
    low, high = [infinity, infinity], [-infinity, -infinity]
    nearest, farthest = infinity, -infinity
    for k in range(3):
        vertex = dr.gather(uint, scene.corners, 3 * face + k)
        x, y, z = (dr.gather(real, scene.vertices, 3 * vertex + axis) for axis in range(3))
        inverse = 1.0 / z
        for axis, value in enumerate((x * inverse * pinhole.fx + pinhole.cx, y * inverse * pinhole.fy + pinhole.cy)):
            low[axis] = dr.fmin(low[axis], value)
            high[axis] = dr.fmax(high[axis], value)
        nearest, farthest = dr.fmin(nearest, z), dr.fmax(farthest, z)
    crosses = nearest <= 0  # part of the face lies behind the camera: its projection is unbounded
    box = []
    for axis, size in enumerate((pinhole.width, pinhole.height)):
        last = real(size) - 1.0
        # One pixel of margin covers the rounding of the projection; the exact rule decides.
        begin = dr.select(crosses, 0.0, dr.fmin(dr.fmax(low[axis] - 1.5, 0.0), last + 1.0))
        end = dr.select(crosses, last, dr.fmin(dr.fmax(high[axis] + 0.5, -1.0), last))
        box.append((scene.backend.Int(dr.floor(begin)), scene.backend.Int(dr.floor(end))))
    visible = (farthest > 0) & (box[0][1] >= box[0][0]) & (box[1][1] >= box[1][0])
    return box[0], box[1], visible


def for_each_hit(scene: EntryScene, items: WorkItems | None, visit: Callable[..., None]) -> None:
    """Call ``visit(pixel, row, depth, hit)`` for each pixel of each work item; ``hit`` masks true entries."""
    if items is None:
        return
    uint, real = scene.backend.UInt, scene.backend.Float
    vertices = [dr.gather(uint, scene.corners, 3 * items.face + k) for k in range(3)]
    points = [[dr.gather(real, scene.vertices, 3 * vertex + axis) for axis in range(3)] for vertex in vertices]

    def body(column: Any) -> tuple[Any]:
        frame = pixel_frame(scene.pinhole, column, items.row)
        corners = []
        for vertex, point in zip(vertices, points, strict=True):
            a, b, t = frame.project(*point)
            corners.append(Corner(vertex, a, b, [t], []))
        face = make_face(corners)
        depth = crossing_depth(face)
        visit(items.row * scene.pinhole.width + column, items.face, depth, holds_ray(face) & (depth > 0))
        return (column + 1,)

    dr.while_loop((uint(items.first_column),), lambda column: column <= items.last_column, body)
