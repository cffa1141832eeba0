"""Half-faces to the pixels of a camera, by the exact rule of the walk (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import NONE
from difftetvr.rendering.search.hits import Hit
from difftetvr.rendering.search.scene import Scene
from difftetvr.rendering.traversal.rays import largest_coordinate, rounding_of
from difftetvr.rendering.traversal.walk import Corner, crossing_depth, holds_ray, interpolate, make_face

_ITEM_PIXELS = 64  # a work item has about so many pixels, at most _ITEM_ROWS rows, and at least one
_ITEM_ROWS = 8
_MOST_WORKERS = 1 << 18


@dataclass
class WorkItems:
    """Pieces of faces to rasterise: each is some image rows of one face's bounding box.

    Attributes:
        half_face: (F,) the faces.
        ends: (F,) number of items of each face and all before it.
        rows: (F,) image rows of one item.
        first_row, last_row, first_column, last_column: (F,) the pixels of each face's box, ends included.
        worker: (L,) numbers of the lanes that share the items.
    """

    half_face: Any
    ends: Any
    rows: Any
    first_row: Any
    last_row: Any
    first_column: Any
    last_column: Any
    worker: Any

    def owner(self, item: Any) -> Any:
        """The face that an item is of: the first whose end lies beyond it."""
        uint = type(item)
        count = dr.width(self.ends)

        def halve(step: Any, place: Any) -> tuple[Any, Any]:
            beyond = place + step
            is_before = (beyond < count) & (dr.gather(uint, self.ends, beyond - 1, beyond < count) <= item)
            return step >> 1, dr.select(is_before, beyond, place)

        first = dr.full(uint, 1 << max(0, (count - 1).bit_length() - 1), dr.width(item))
        return dr.while_loop((first, dr.zeros(uint, dr.width(item))), lambda step, place: step > 0, halve)[1]


def workers_for(faces: int, pixels: int) -> int:
    """A number of lanes, out of few, that shares the work items of some faces in an image evenly."""
    return min(1 << (faces + pixels // _ITEM_PIXELS).bit_length(), _MOST_WORKERS)


def work_items(scene: Scene, half_face: Any, worker: Any) -> WorkItems:
    """Work items of some half-faces; the scene's rays are a camera's.

    Args:
        scene: The cells and the rays.
        half_face: (F,) the faces, `NONE` for none.
        worker: (L,) numbers of the lanes that are to share the items, see :func:`workers_for`.
    """
    real, uint, integer = scene.backend.Float, scene.backend.UInt, scene.backend.Int
    is_face = half_face != NONE
    points = [scene.point(vertex, is_face) for vertex in scene.indices_and_apex(half_face, is_face)[:3]]
    (column0, column1), (row0, row1), visible = scene.image.pixel_range(scene.backend, points)
    width = dr.fmax(real(column1 - column0 + 1), 1.0)
    rows = integer(dr.fmin(dr.fmax(_ITEM_PIXELS / width, 1.0), float(_ITEM_ROWS)))
    count = dr.select(is_face & visible & _may_face_camera(points), (row1 - row0 + rows) // rows, 0)
    parts = [uint(part) for part in (count, rows, row0, row1, column0, column1)]
    dr.eval(parts)
    ends = dr.cumsum(parts[0])
    dr.eval(ends)
    return WorkItems(half_face, ends, parts[1], parts[2], parts[3], parts[4], parts[5], worker)


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


def for_each_hit(scene: Scene, items: WorkItems, visit: Callable[[Hit], None]) -> None:
    """Call ``visit`` for each pixel of each work item."""
    uint, workers = scene.backend.UInt, dr.width(items.worker)
    total = dr.gather(uint, items.ends, uint(dr.width(items.ends) - 1))

    def at_item(item: Any) -> tuple[Any]:
        owner = items.owner(item)
        begin = dr.gather(uint, items.ends, owner - 1, owner > 0)
        half_face, rows, first_row, last_row, first_column, last_column = (
            dr.gather(uint, part, owner)
            for part in (
                items.half_face,
                items.rows,
                items.first_row,
                items.last_row,
                items.first_column,
                items.last_column,
            )
        )
        first_row += (item - begin) * rows
        last = first_row + rows - 1
        box = PixelBox(first_row, dr.select(last < last_row, last, last_row), first_column, last_column)
        _for_each_pixel(scene, half_face, box, visit)
        return (item + workers,)

    dr.while_loop((uint(items.worker),), lambda item: item < total, at_item)


@dataclass
class PixelBox:
    """Pixels of an image, ends included."""

    first_row: Any
    last_row: Any
    first_column: Any
    last_column: Any


def _for_each_pixel(scene: Scene, half_face: Any, box: PixelBox, visit: Callable[[Hit], None]) -> None:
    """Call ``visit`` for the pixels that may see a half-face."""
    vertices = scene.indices_and_apex(half_face)[:3]
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
        visit(Hit(pixel, scene.image.lane_of(column, row), half_face, depth, is_hit))
        ends = column == box.last_column
        return dr.select(ends, box.first_column, column + 1), dr.select(ends, row + 1, row)

    dr.while_loop((box.first_column, box.first_row), lambda column, row: row <= box.last_row, body)
