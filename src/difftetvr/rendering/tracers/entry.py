"""Where rays enter the mesh: per-pixel lists of the faces that start a walk, nearest first (Dr.Jit).

Boundary faces are rasterised into the lists by the same exact rule as the walk; when the camera is inside the mesh, the
cells that hold it come first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.tracers.camera_inside import cells_around_camera, start_rows
from difftetvr.rendering.tracers.entry_table import EntryScene, EntryTable
from difftetvr.rendering.tracers.rasterise import Hit, WorkItems, for_each_hit, work_items


@dataclass(frozen=True)
class EntryLists:
    """Per-pixel lists of entry-table rows.

    Attributes:
        corners, cells, apices: The table as flat Dr.Jit arrays.
        offset: (pixels,) start of each pixel's list in ``rows``.
        count: (pixels,) length of each pixel's list.
        rows: Row numbers, each pixel's nearest first.
        camera_inside: Whether some walks start behind the camera and must be clipped there.
        is_simple: Whether no pixel has more than one entry.
    """

    corners: Any
    cells: Any
    apices: Any
    offset: Any
    count: Any
    rows: Any
    camera_inside: bool
    is_simple: bool


def find_entries(backend: Backend, mesh: TetMesh, camera_vertices: torch.Tensor, camera: Camera) -> EntryLists:
    """Entry lists of every pixel of a view.

    Args:
        backend: Dr.Jit back end of the vertices' device and precision.
        mesh: Mesh, for its topology.
        camera_vertices: (V, 3) vertices in camera space.
        camera: Intrinsics and image size.
    """
    table = EntryTable.boundary(mesh)
    boundary_rows = table.cells.shape[0]
    around = cells_around_camera(backend, mesh, camera_vertices)
    if around is not None:
        table = table.joined(EntryTable.of_cells(mesh, around))
    scene = EntryScene(
        backend,
        camera,
        camera.kernel_rays(backend),
        backend.floats(camera_vertices),
        *(backend.uints(part) for part in (table.corners, table.cells, table.apices)),
    )
    start = None if around is None else start_rows(scene, mesh, around, boundary_rows)
    items = work_items(scene, 0, boundary_rows)
    count, rows = _count(scene, items, start)
    is_simple = int(dr.max(count)[0]) <= 1
    if is_simple:
        offset = dr.arange(backend.UInt, scene.pixel_count)
    else:
        offset = _starts(backend, count)
        rows = _sorted(scene, offset, count, *_fill(scene, items, start, offset, count))
    inside = around is not None
    return EntryLists(scene.corners, scene.cells, scene.apices, offset, count, rows, inside, is_simple)


def _count(scene: EntryScene, items: WorkItems | None, start: Any | None) -> tuple[Any, Any]:
    """Number of entries of each pixel, and one of them, which is all where no pixel has more."""
    uint = scene.backend.UInt
    count, row_of_pixel = dr.zeros(uint, scene.pixel_count), dr.zeros(uint, scene.pixel_count)
    if start is not None:
        count, row_of_pixel = dr.select(start != scene.no_row, uint(1), uint(0)), uint(start)
        scene.backend.run(count, row_of_pixel)

    def visit(hit: Hit) -> None:
        pixel = hit.row * scene.rays.width + hit.column
        dr.scatter_add(count, uint(1), pixel, hit.is_hit)
        dr.scatter(row_of_pixel, hit.face, pixel, hit.is_hit)

    for_each_hit(scene, items, visit)
    scene.backend.run(count, row_of_pixel)
    return count, row_of_pixel


def _starts(backend: Backend, count: Any) -> Any:
    """Where each pixel's list starts: the exclusive prefix sum of the lengths."""
    counts = backend.tensor(backend.Int(count))
    return backend.uints((counts.cumsum(0) - counts).to(torch.int32))


def _fill(scene: EntryScene, items: WorkItems | None, start: Any | None, offset: Any, count: Any) -> tuple[Any, Any]:
    """Rows of every pixel and their depths, in any order within a pixel."""
    uint, real = scene.backend.UInt, scene.backend.Float
    total = int(offset[scene.pixel_count - 1]) + int(count[scene.pixel_count - 1])
    rows, depths, used = dr.zeros(uint, total), dr.zeros(real, total), dr.zeros(uint, scene.pixel_count)
    if start is not None:
        has_start = start != scene.no_row
        dr.scatter(rows, start, offset, has_start)
        dr.scatter(depths, real(-1), offset, has_start)
        used = dr.select(has_start, uint(1), uint(0))
    scene.backend.run(rows, depths, used)

    def visit(hit: Hit) -> None:
        pixel = hit.row * scene.rays.width + hit.column
        slot = dr.gather(uint, offset, pixel, hit.is_hit) + dr.scatter_inc(used, pixel, hit.is_hit)
        dr.scatter(rows, hit.face, slot, hit.is_hit)
        dr.scatter(depths, hit.depth, slot, hit.is_hit)

    for_each_hit(scene, items, visit)
    scene.backend.run(rows, depths)
    return rows, depths


def _sorted(scene: EntryScene, offset: Any, count: Any, rows: Any, depths: Any) -> Any:
    """Each pixel's rows by (depth, row): an entry's place is the number of smaller ones, for the lists are short."""
    uint, real = scene.backend.UInt, scene.backend.Float
    end = offset + count
    ordered = dr.zeros(uint, dr.width(rows))

    def place(position: Any) -> tuple[Any]:
        row, depth = dr.gather(uint, rows, position), dr.gather(real, depths, position)

        def compare(other: Any, rank: Any) -> tuple[Any, Any]:
            other_row, other_depth = dr.gather(uint, rows, other), dr.gather(real, depths, other)
            smaller = (other_depth < depth) | ((other_depth == depth) & (other_row < row))
            return other + 1, rank + dr.select(smaller, uint(1), uint(0))

        _, rank = dr.while_loop((uint(offset), dr.zeros(uint, 1)), lambda other, rank: other < end, compare)
        dr.scatter(ordered, row, offset + rank)
        return (position + 1,)

    dr.while_loop((uint(offset),), lambda position: position < end, place)
    scene.backend.run(ordered)
    return ordered
