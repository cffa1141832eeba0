"""Half-faces to the pixels of a camera, by the exact rule of the walk (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.rendering.search.hits import Hit
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.traversal.rays import largest_coordinate, pixel_lane, rounding_of
from difftetvr.rendering.traversal.walk import Corner, crossing_depth, holds_ray, interpolate, make_face

_ITEM_PIXELS = 64  # a work item has about so many pixels, at most _ITEM_ROWS rows, and at least one
_ITEM_ROWS = 8


@dataclass
class WorkItems:
    """Pieces of faces to rasterise: each is some image rows of one face's bounding box.

    Attributes:
        half_face: The face.
        first_row, last_row, first_column, last_column: The pixels, ends included.
    """

    half_face: Any
    first_row: Any
    last_row: Any
    first_column: Any
    last_column: Any


def work_items(scene: Scene, half_face: Any) -> WorkItems | None:
    """Work items of some half-faces, None if none of them is in sight; the scene's rays are a camera's."""
    backend, uint, integer = scene.backend, scene.backend.UInt, scene.backend.Int
    faces = dr.width(half_face)
    points = [scene.point(vertex) for vertex in scene.indices_and_apex(half_face)[:3]]
    (column0, column1), (row0, row1), visible = scene.image.pixel_range(backend, points)
    width = dr.fmax(scene.backend.Float(column1 - column0 + 1), 1.0)
    per_item = integer(dr.fmin(dr.fmax(_ITEM_PIXELS / width, 1.0), float(_ITEM_ROWS)))
    count = dr.select(visible & _may_face_camera(points), (row1 - row0 + per_item) // per_item, 0)
    backend.run(count, row0, row1, column0, column1, per_item)
    counts = backend.tensor(count)
    owners = torch.repeat_interleave(
        torch.arange(faces, dtype=torch.int32, device=backend.device), counts, output_size=int(counts.sum())
    )
    if owners.shape[0] == 0:
        return None
    begins = (counts.cumsum(0) - counts).to(torch.int32)
    owner = backend.uints(owners)
    index = integer(dr.arange(uint, owners.shape[0]) - dr.gather(uint, backend.uints(begins), owner))
    step = dr.gather(integer, per_item, owner)
    first = dr.gather(integer, row0, owner) + index * step
    last = dr.fmin(backend.Float(first + step - 1), backend.Float(dr.gather(integer, row1, owner)))
    columns = (uint(dr.gather(integer, column, owner)) for column in (column0, column1))
    items = WorkItems(dr.gather(uint, half_face, owner), uint(first), uint(integer(last)), *columns)
    backend.run(items)
    return items


def _may_face_camera(points: list[list[Any]]) -> Any:
    """Whether rays can enter through a face: not if the camera lies clearly on the inner side of its plane."""
    p, q, r = points
    e, f = ([v - u for u, v in zip(p, other, strict=True)] for other in (q, r))
    normal = [e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]]
    side = normal[0] * p[0] + normal[1] * p[1] + normal[2] * p[2]
    size, sides = _norm(p), _norm(e) + _norm(f)
    # A ray's frame rounds offsets by parts of the distance, so faces seen edge-on are left to the exact rule.
    return side >= -16.0 * dr.epsilon(side) * size * (size + sides) * sides


def _norm(vector: list[Any]) -> Any:
    return dr.abs(vector[0]) + dr.abs(vector[1]) + dr.abs(vector[2])


def for_each_hit(scene: Scene, items: WorkItems | None, visit: Callable[[Hit], None]) -> None:
    """Call ``visit`` for each pixel of each work item."""
    if items is None:
        return
    vertices = scene.indices_and_apex(items.half_face)[:3]
    points = [scene.point(vertex) for vertex in vertices]
    nearest = dr.fmin(points[0][2], dr.fmin(points[1][2], points[2][2]))
    passes_camera = nearest <= rounding_of(largest_coordinate(points))

    def body(column: Any, row: Any) -> tuple[Any, Any]:
        frame = scene.image.frame(column, row)
        corners = []
        for vertex, point in zip(vertices, points, strict=True):
            a, b, t = frame.project(*point)
            corners.append(Corner(vertex, a, b, [t], []))
        face = make_face(corners)
        # Only where corners lie behind the camera, or nearly so, the sign of the distance is in doubt and must be the
        # exact one.
        exact = lambda face: crossing_depth(face)  # noqa: E731
        simple = lambda face: interpolate(face)[0]  # noqa: E731
        depth = dr.if_stmt((face,), passes_camera, exact, simple)
        is_hit = holds_ray(face) & (~passes_camera | (depth > 0))
        pixel = row * scene.image.width + column
        visit(Hit(pixel, pixel_lane(scene.image, column, row), items.half_face, depth, is_hit))
        ends = column == items.last_column
        return dr.select(ends, items.first_column, column + 1), dr.select(ends, row + 1, row)

    uint = scene.backend.UInt
    start = (uint(items.first_column), uint(items.first_row))
    dr.while_loop(start, lambda column, row: row <= items.last_row, body)
