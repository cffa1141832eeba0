"""Where rays start when their origin is inside the mesh, or on or near its boundary (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.mesh.topology.topology import LOCAL_FACES
from difftetvr.rendering.tracers.scene import NONE, Scene
from difftetvr.rendering.traversal.rays import Frame
from difftetvr.rendering.traversal.walk import BOUNDARY, crossing_depth, find_exit, holds_ray

NEAR = 1e-4
"""Cells this near to an origin, relative to their size, are tried as the cell that holds it; each ray then decides."""


@dataclass
class Start:
    """What is known of where rays start, while cells around their origins are looked at.

    Attributes:
        half_face: Through which a ray would enter the cell that holds its origin; NONE while there is none.
        farthest: Where it leaves that cell.
        ahead: Where it enters the mesh in front of its origin.
        rounding: By how much rounding may move these.
    """

    half_face: Any
    farthest: Any
    ahead: Any
    rounding: Any

    @staticmethod
    def at(backend: Backend, near: Any) -> Start:
        """Nothing is known of rays that are looked at from a distance on."""
        lanes = dr.width(near)
        unknown = dr.full(backend.UInt, NONE, lanes), backend.Float(near), dr.full(backend.Float, dr.inf, lanes)
        return Start(*unknown, dr.zeros(backend.Float, lanes))

    def consider(self, scene: Scene, frame: Frame, adjacency: Any, half_face: Any, near: Any, active: Any) -> Start:
        """Look at a half-face of a cell that is around the origin, or near it."""
        face, apex = scene.face_and_apex(frame, half_face, active)
        depth, exit_depth = crossing_depth(face), crossing_depth(find_exit(face, apex).face(face, apex))
        holds = holds_ray(face) & active
        spans = holds & (depth <= near) & (exit_depth > self.farthest)
        is_boundary = dr.gather(scene.backend.UInt, adjacency, half_face, active) == BOUNDARY
        enters = holds & (depth > near) & is_boundary
        return Start(
            dr.select(spans, half_face, self.half_face),
            dr.select(spans, exit_depth, self.farthest),
            dr.select(enters, dr.fmin(self.ahead, depth), self.ahead),
            dr.select(active, dr.fmax(self.rounding, _rounding(face)), self.rounding),
        )

    def chosen(self, near: Any) -> Any:
        """The half-face to start at.

        Depths within rounding of the origin need not grow along a ray. Where it enters through a boundary face ahead
        and before the end of the cell found here, or within rounding, both belong to one path, and it starts there.
        """
        enters = (self.ahead < self.farthest) | (self.ahead - near <= self.rounding)
        return dr.select(enters, NONE, self.half_face)


def _rounding(face: Any) -> Any:
    """By how much, at most, rounding moves where a ray crosses a face."""
    size = type(face.corners[0].a)(0)
    for corner in face.corners:
        for value in (corner.a, corner.b, corner.values[0]):
            size = dr.fmax(size, dr.abs(value))
    return 16.0 * dr.epsilon(size) * size


def starts_at_camera(scene: Scene, mesh: TetMesh, around: torch.Tensor) -> Any:
    """(pixels,) half-face at which each ray of a camera starts inside the mesh; NONE where it does not.

    Args:
        scene: The cells, and the camera's rays.
        mesh: Mesh, for its adjacency.
        around: Cells around the camera.
    """
    backend, uint = scene.backend, scene.backend.UInt
    frame = scene.rays.of_pixels(dr.arange(uint, scene.rays.count))
    cells, adjacency = backend.uints(around), backend.uints(mesh.topology.cell_adjacency)
    near, count = dr.zeros(backend.Float, scene.rays.count), backend.opaque_uint(4 * around.shape[0])

    def body(index: Any, start: Start) -> tuple[Any, Start]:
        half_face = 4 * dr.gather(uint, cells, index >> 2) + (index & 3)
        return index + 1, start.consider(scene, frame, adjacency, half_face, near, True)

    state = (dr.zeros(uint, scene.rays.count), Start.at(backend, near))
    start = dr.while_loop(state, lambda index, _: index < count, body)[1].chosen(near)
    backend.run(start)
    return start


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
