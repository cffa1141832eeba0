"""Where rays enter the mesh: boundary faces rasterised into per-pixel lists, nearest first (Dr.Jit).

A row of the entry table is a face that can start a walk: three corners, the cell behind it and that cell's apex. The
rows are the boundary faces and, when the camera is inside the mesh, the faces of the cells that hold it. Each pixel
gets the rows that its ray enters through, by the same exact rule as the walk.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.mesh.topology import LOCAL_FACES
from difftetvr.render.camera import Camera
from difftetvr.render.rays import Pinhole, pixel_frame
from difftetvr.render.walk import BOUNDARY, Corner, crossing_depth, find_exit, holds_ray, make_face

# Cells this near to the camera, relative to their size, are tried as the cell that holds it; each ray then decides.
_NEAR = 1e-4


@dataclass
class EntryTable:
    """Faces that can start a walk: (R, 3) corners wound to hold entering rays, (R,) cells behind and (R,) apices."""

    corners: torch.Tensor
    cells: torch.Tensor
    apices: torch.Tensor

    @staticmethod
    def boundary(mesh: TetMesh) -> EntryTable:
        """Table of the mesh's boundary faces."""

        def build() -> EntryTable:
            topology = mesh.topology
            # Counter-clockwise from outside is clockwise in the ray's plane: a, b, direction are right-handed.
            corners = topology.boundary_faces[:, [0, 2, 1]].contiguous()
            cells = topology.boundary_cells.contiguous()
            apices = (mesh.tets[cells.long()].sum(dim=1) - corners.sum(dim=1)).to(torch.int32)
            return EntryTable(corners, cells, apices)

        return mesh.topology.cached("entry_table", build)

    @staticmethod
    def of_cells(mesh: TetMesh, cells: torch.Tensor) -> EntryTable:
        """Table of all faces of some cells, seen from outside them."""
        tets = mesh.tets[cells.long()]
        corners = torch.cat([tets[:, [face[0], face[2], face[1]]] for face in LOCAL_FACES])
        apices = torch.cat([tets[:, k] for k in range(4)])
        return EntryTable(corners.contiguous(), cells.to(torch.int32).repeat(4), apices.contiguous())


@dataclass
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


@dataclass
class _Scene:
    """What the entry kernels read."""

    backend: Backend
    camera: Camera
    pinhole: Pinhole
    vertices: Any
    corners: Any
    cells: Any
    apices: Any

    def corner(self, frame: Any, vertex: Any, mask: Any) -> Corner:
        x, y, z = (dr.gather(self.backend.Float, self.vertices, 3 * vertex + k, mask) for k in range(3))
        a, b, t = frame.project(x, y, z)
        return Corner(vertex, a, b, [t], [])

    def face(self, frame: Any, row: Any, mask: Any = True) -> Any:
        vertices = [dr.gather(self.backend.UInt, self.corners, 3 * row + k, mask) for k in range(3)]
        return make_face([self.corner(frame, vertex, mask) for vertex in vertices])


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
    around = _cells_around_camera(backend, mesh, camera_vertices)
    if around is not None:
        inner = EntryTable.of_cells(mesh, around)
        table = EntryTable(
            *(torch.cat([getattr(t, n) for t in (table, inner)]) for n in ("corners", "cells", "apices"))
        )
    scene = _Scene(
        backend,
        camera,
        Pinhole.of(backend, camera),
        backend.floats(camera_vertices),
        *(backend.uints(part) for part in (table.corners, table.cells, table.apices)),
    )
    start = None if around is None else _start_rows(scene, mesh, around, boundary_rows)
    count, first, items = _rasterise(scene, boundary_rows, start)
    deepest = int(dr.max(count)[0])
    lists = EntryLists(scene.corners, scene.cells, scene.apices, None, count, first, around is not None, deepest <= 1)
    if lists.is_simple:
        lists.offset = dr.arange(backend.UInt, camera.width * camera.height)
        return lists
    counts = backend.tensor(backend.Int(count))
    lists.offset = backend.uints((counts.cumsum(0) - counts).to(torch.int32))
    lists.rows = _fill_lists(scene, items, lists, start)
    return lists


def _cells_around_camera(backend: Backend, mesh: TetMesh, camera_vertices: torch.Tensor) -> torch.Tensor | None:
    """Cells that may hold the camera: it lies in them or very near; None if there are none."""
    positions = camera_vertices.detach()
    # One axis after the other: most cameras look at the mesh from outside, and z says so.
    if any(bool((positions[:, axis].amin() > 0) | (positions[:, axis].amax() < 0)) for axis in (2, 0, 1)):
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
    margin = _NEAR * extent
    for low, high in zip(lows, highs, strict=True):
        around &= (low <= margin) & (high >= -margin)
    # The camera is the origin: with an outward face of a cell around it, it spans a positive volume.
    for i, j, k in LOCAL_FACES:
        around &= _triple(points[i], points[j], points[k]) >= -_NEAR * extent * extent * extent
    found = dr.compress(around)
    return None if dr.width(found) == 0 else backend.tensor(backend.Int(found))


def _triple(p: list[Any], q: list[Any], r: list[Any]) -> Any:
    """Six times the signed volume of the origin and three points."""
    return p[0] * (q[1] * r[2] - q[2] * r[1]) + p[1] * (q[2] * r[0] - q[0] * r[2]) + p[2] * (q[0] * r[1] - q[1] * r[0])


def _start_rows(scene: _Scene, mesh: TetMesh, around: torch.Tensor, begin: int) -> Any:
    """Per pixel, the row of the cell in which a ray starts inside the mesh; the number of rows where none does.

    Args:
        scene: The table's last rows are the faces of the cells around the camera.
        mesh: Mesh, for its adjacency.
        around: Cells around the camera.
        begin: First of those rows.
    """
    backend, uint, real = scene.backend, scene.backend.UInt, scene.backend.Float
    pixel = dr.arange(uint, scene.camera.width * scene.camera.height)
    row_index = pixel // scene.pinhole.width
    frame = pixel_frame(scene.pinhole, pixel - row_index * scene.pinhole.width, row_index)
    none = backend.opaque_uint(dr.width(scene.cells))
    neighbors = backend.uints(mesh.topology.cell_adjacency[around.long()].T)

    def body(row: Any, best: Any, farthest: Any, ahead: Any) -> tuple[Any, Any, Any, Any]:
        face = scene.face(frame, row)
        apex = scene.corner(frame, dr.gather(uint, scene.apices, row), True)
        depth, exit_depth = crossing_depth(face), crossing_depth(find_exit(face, apex).face(face, apex))
        holds = holds_ray(face)
        spans = holds & (depth <= 0) & (exit_depth > farthest)
        enters = holds & (depth > 0) & (dr.gather(uint, neighbors, row - begin_row) == BOUNDARY)
        return (
            row + 1,
            dr.select(spans, row, best),
            dr.select(spans, exit_depth, farthest),
            dr.select(enters, dr.fmin(ahead, depth), ahead),
        )

    lanes = dr.width(pixel)
    begin_row = backend.opaque_uint(begin)
    state = (
        begin_row + dr.zeros(uint, lanes),
        none + dr.zeros(uint, lanes),
        dr.zeros(real, lanes),
        dr.full(real, dr.inf, lanes),
    )
    _, best, farthest, ahead = dr.while_loop(state, lambda row, *_: row < none, body)
    # Depths within rounding of the camera need not grow along a ray. Where it enters through a boundary face ahead and
    # before the end of the cell found here, both belong to one path, and it starts at that face.
    best = dr.select(ahead < farthest, none, best)
    backend.run(best)
    return best


def _rasterise(scene: _Scene, rows: int, start: Any | None) -> tuple[Any, Any, Any]:
    """Count the entries of each pixel; also a row of each and the work items (face, image row) for a second pass."""
    uint = scene.backend.UInt
    pixels = scene.camera.width * scene.camera.height
    count, first = dr.zeros(uint, pixels), dr.zeros(uint, pixels)
    if start is not None:
        has_start = start < scene.backend.opaque_uint(dr.width(scene.cells))
        count, first = dr.select(has_start, uint(1), uint(0)), uint(start)
        scene.backend.run(count, first)
    items = _work_items(scene, rows)

    def visit(pixel: Any, row: Any, depth: Any, hit: Any) -> None:
        dr.scatter_add(count, uint(1), pixel, hit)
        dr.scatter(first, row, pixel, hit)

    _for_each_hit(scene, items, visit)
    scene.backend.run(count, first)
    return count, first, items


@dataclass
class _WorkItems:
    """Pieces of faces to rasterise: each is one image row of one face's bounding box."""

    face: Any
    row: Any
    first_column: Any
    last_column: Any
    count: int


def _work_items(scene: _Scene, rows: int) -> _WorkItems | None:
    backend, uint, real = scene.backend, scene.backend.UInt, scene.backend.Float
    pinhole = scene.pinhole
    face = dr.arange(uint, rows)
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
    (column0, column1), (row0, row1) = box
    visible = (farthest > 0) & (column1 >= column0) & (row1 >= row0)
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
    return _WorkItems(owner, row, first_column, last_column, total)


def _for_each_hit(scene: _Scene, items: _WorkItems | None, visit: Any) -> None:
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


def _fill_lists(scene: _Scene, items: _WorkItems | None, lists: EntryLists, start: Any | None) -> Any:
    """Rows of every pixel, sorted by depth."""
    uint, real = scene.backend.UInt, scene.backend.Float
    pixels = scene.camera.width * scene.camera.height
    total = int(lists.offset[pixels - 1]) + int(lists.count[pixels - 1])
    rows, depths, used = dr.zeros(uint, total), dr.zeros(real, total), dr.zeros(uint, pixels)
    if start is not None:
        has_start = start < scene.backend.opaque_uint(dr.width(scene.cells))
        dr.scatter(rows, start, lists.offset, has_start)
        dr.scatter(depths, real(-1), lists.offset, has_start)
        used = dr.select(has_start, uint(1), uint(0))
    scene.backend.run(rows, depths, used)

    def visit(pixel: Any, row: Any, depth: Any, hit: Any) -> None:
        slot = dr.gather(uint, lists.offset, pixel, hit) + dr.scatter_inc(used, pixel, hit)
        dr.scatter(rows, row, slot, hit)
        dr.scatter(depths, depth, slot, hit)

    _for_each_hit(scene, items, visit)
    scene.backend.run(rows, depths)
    return _sort_lists(scene, lists, rows, depths)


def _sort_lists(scene: _Scene, lists: EntryLists, rows: Any, depths: Any) -> Any:
    """Each pixel's rows by (depth, row): an entry's place is the number of smaller ones, for the lists are short."""
    uint, real = scene.backend.UInt, scene.backend.Float
    end = lists.offset + lists.count
    ordered = dr.zeros(uint, dr.width(rows))

    def place(position: Any) -> tuple[Any]:
        row, depth = dr.gather(uint, rows, position), dr.gather(real, depths, position)

        def compare(other: Any, rank: Any) -> tuple[Any, Any]:
            other_row, other_depth = dr.gather(uint, rows, other), dr.gather(real, depths, other)
            smaller = (other_depth < depth) | ((other_depth == depth) & (other_row < row))
            return other + 1, rank + dr.select(smaller, uint(1), uint(0))

        _, rank = dr.while_loop((uint(lists.offset), dr.zeros(uint, 1)), lambda other, rank: other < end, compare)
        dr.scatter(ordered, row, lists.offset + rank)
        return (position + 1,)

    dr.while_loop((uint(lists.offset),), lambda position: position < end, place)
    scene.backend.run(ordered)
    return ordered
