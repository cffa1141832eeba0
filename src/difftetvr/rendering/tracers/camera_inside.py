"""Where rays start when the camera is inside the mesh, or on or near its boundary (Dr.Jit)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.mesh.topology.topology import LOCAL_FACES
from difftetvr.rendering.tracers.entry_table import EntryScene
from difftetvr.rendering.traversal.walk import BOUNDARY, crossing_depth, find_exit, holds_ray

# Cells this near to the camera, relative to their size, are tried as the cell that holds it; each ray then decides.
_NEAR = 1e-4


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


def start_rows(scene: EntryScene, mesh: TetMesh, around: torch.Tensor, begin: int) -> Any:
    """Per pixel, the row of the cell in which a ray starts inside the mesh; the number of rows where none does.

    Args:
        scene: The table's last rows are the faces of the cells around the camera.
        mesh: Mesh, for its adjacency.
        around: Cells around the camera.
        begin: First of those rows.
    """
    backend, uint, real = scene.backend, scene.backend.UInt, scene.backend.Float
    pixel = dr.arange(uint, scene.pixel_count)
    row_index = pixel // scene.rays.width
    frame = scene.rays.frame(pixel - row_index * scene.rays.width, row_index)
    none = scene.no_row
    neighbors = backend.uints(mesh.topology.cell_adjacency[around.long()].T)

    def body(row: Any, best: Any, farthest: Any, ahead: Any, rounding: Any) -> tuple[Any, ...]:
        face = scene.face(frame, row)
        apex = scene.corner(frame, dr.gather(uint, scene.apices, row))
        depth, exit_depth = crossing_depth(face), crossing_depth(find_exit(face, apex).face(face, apex))
        holds = holds_ray(face)
        spans = holds & (depth <= 0) & (exit_depth > farthest)
        enters = holds & (depth > 0) & (dr.gather(uint, neighbors, row - begin_row) == BOUNDARY)
        return (
            row + 1,
            dr.select(spans, row, best),
            dr.select(spans, exit_depth, farthest),
            dr.select(enters, dr.fmin(ahead, depth), ahead),
            dr.fmax(rounding, _rounding(face)),
        )

    lanes = dr.width(pixel)
    begin_row = backend.opaque_uint(begin)
    state = (
        begin_row + dr.zeros(uint, lanes),
        none + dr.zeros(uint, lanes),
        dr.zeros(real, lanes),
        dr.full(real, dr.inf, lanes),
        dr.zeros(real, lanes),
    )
    _, best, farthest, ahead, rounding = dr.while_loop(state, lambda row, *_: row < none, body)
    # Depths within rounding of the camera need not grow along a ray. Where it enters through a boundary face ahead and
    # before the end of the cell found here, or within rounding, both belong to one path, and it starts at that face.
    best = dr.select((ahead < farthest) | (ahead <= rounding), none, best)
    backend.run(best)
    return best


def _rounding(face: Any) -> Any:
    """By how much, at most, rounding moves where a ray crosses a face."""
    size = type(face.corners[0].a)(0)
    for corner in face.corners:
        for value in (corner.a, corner.b, corner.values[0]):
            size = dr.fmax(size, dr.abs(value))
    return 16.0 * dr.epsilon(size) * size
