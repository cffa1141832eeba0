"""The marching renderer: rays walk from cell to cell, front to back, and so does their adjoint (Dr.Jit kernels).

Nothing is sorted and nothing stored per crossing: the adjoint walks again and keeps what of the image is still ahead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.backend import Backend
from difftetvr.optics import OpticalModel
from difftetvr.render.camera import Camera
from difftetvr.render.entry import EntryLists
from difftetvr.render.rays import Frame, Pinhole, lane_count, lane_pixel, pixel_frame
from difftetvr.render.walk import (
    BOUNDARY,
    Corner,
    Exit,
    Face,
    find_exit,
    interpolate,
    make_face,
    table_row,
)


@dataclass
class MarchingScene:
    """What the marching kernels read, as flat Dr.Jit arrays.

    Attributes:
        backend: Array types.
        camera: Image size (the intrinsics are read from the device).
        optics: Optical model of one cell.
        vertices: Vertex records: (V, 4) x, y, z in camera space and 0 for per-cell fields, else (V, 8) x, y, z,
            density, linear RGB and 0, so that one cache line holds all of a vertex.
        cells: (T, 4) linear RGB and density for per-cell fields, else None.
        table: Walk table, see :func:`difftetvr.render.walk.walk_table`.
        entries: Entry lists of this view.
        threshold: Transmittance below which a ray stops, as a device value.
    """

    backend: Backend
    camera: Camera
    optics: OpticalModel
    vertices: Any
    cells: Any | None
    table: Any
    entries: EntryLists
    threshold: Any


def vertex_records(backend: Backend, vertices: Any, density: Any, color: Any) -> Any:
    """Flat (V, 8) records x, y, z, density, red, green, blue, 0 from flat arrays, in one pass on all cores."""
    real = backend.Float
    vertex = dr.arange(backend.UInt, dr.width(density))
    x, y, z = (dr.gather(real, vertices, 3 * vertex + k) for k in range(3))
    r, g, b = (dr.gather(real, color, 3 * vertex + k) for k in range(3))
    records = dr.empty(real, 8 * dr.width(density))
    dr.scatter(records, backend.Float4(x, y, z, density), 2 * vertex)
    dr.scatter(records, backend.Float4(r, g, b, real(0)), 2 * vertex + 1)
    backend.run(records)
    return records


@dataclass
class Radiance:
    """What a ray has gathered.

    Attributes:
        color: Premultiplied radiance, three components.
        distance: Integral of the distance at which light is absorbed.
        optical_depth: Optical depth; beside the transmittance, since 1 - exp(-x) of a thin medium needs it.
        transmittance: Its exponential, the part of light still to come.
    """

    color: list[Any]
    distance: Any
    optical_depth: Any
    transmittance: Any


@dataclass
class Step:
    """One crossing of a cell: the faces it enters and leaves through, and the interpolated values there."""

    cell: Any
    face: Face
    apex: Corner
    exit: Exit
    next_face: Face
    entry: list[Any]
    leaving: list[Any]


@dataclass
class Rays:
    """The rays of a kernel's lanes."""

    pixel: Any
    valid: Any
    frame: Frame


def make_rays(scene: MarchingScene) -> Rays:
    """Rays of all pixels, one a lane, in Morton order."""
    pinhole = Pinhole.of(scene.backend, scene.camera)
    column, row, valid = lane_pixel(pinhole, dr.arange(scene.backend.UInt, lane_count(scene.camera)))
    return Rays(row * pinhole.width + column, valid, pixel_frame(pinhole, column, row))


def walk(
    scene: MarchingScene,
    rays: Rays,
    read: Callable[[Any, Any], Corner],
    visit: Callable[[Step, Any], Any],
    leave: Callable[[Face, Any, Any], Any],
    ray: Any,
) -> Any:
    """Walk every ray through all cells it crosses, front to back.

    Args:
        scene: Mesh tables and entries.
        rays: The rays.
        read: ``read(vertex, active)`` returns the vertex as the ray sees it.
        visit: ``visit(step, ray)`` returns the ray's new state; it may add to the adjoints of the step's entry face.
        leave: ``leave(face, ray, active)`` is called at the face through which a ray leaves the mesh.
        ray: State of the rays, a PyTree with a ``transmittance``.

    Returns:
        The final state of the rays.
    """
    uint = scene.backend.UInt
    offset = dr.gather(uint, scene.entries.offset, rays.pixel, rays.valid)
    count = dr.gather(uint, scene.entries.count, rays.pixel, rays.valid)

    def enter(index: Any, ray: Any) -> tuple[Any, Any]:
        active = (index < count) & rays.valid
        row = dr.gather(uint, scene.entries.rows, offset + index, active)
        cell = dr.gather(uint, scene.entries.cells, row, active)
        apex = dr.gather(uint, scene.entries.apices, row, active)
        vertices = [dr.gather(uint, scene.entries.corners, 3 * row + k, active) for k in range(3)]
        face = make_face([read(vertex, active) for vertex in vertices])
        entry = interpolate(face)

        def advance(active: Any, cell: Any, apex: Any, face: Face, entry: list[Any], ray: Any) -> tuple[Any, ...]:
            corner = read(apex, active)
            way_out = find_exit(face, corner)
            next_face = way_out.face(face, corner)
            leaving = interpolate(next_face)
            ray = visit(Step(cell, face, corner, way_out, next_face, entry, leaving), ray)
            link = table_row(cell, way_out.vertex(face), face, corner)
            behind = dr.gather(scene.backend.UInt2, scene.table, link, active)
            active = active & (behind[0] != BOUNDARY) & (ray.transmittance > scene.threshold)
            return active, behind[0], behind[1], next_face, leaving, ray

        state = (active, cell, apex, face, entry, ray)
        state = dr.while_loop(state, lambda active, *_: active, advance)
        ray = leave(state[3], state[5], active)
        return index + 1, ray

    if scene.entries.is_simple:
        return enter(uint(0), ray)[1]
    more = lambda index, ray: (index < count) & rays.valid & (ray.transmittance > scene.threshold)  # noqa: E731
    return dr.while_loop((dr.zeros(uint, dr.width(rays.pixel)), ray), more, enter)[1]


def read_vertex(scene: MarchingScene, vertex: Any, active: Any) -> tuple[Any, list[Any]]:
    """A vertex's position record and its attributes: density and linear RGB, or none for per-cell fields."""
    float4 = scene.backend.Float4
    if scene.cells is not None:
        return dr.gather(float4, scene.vertices, vertex, active), []
    position = dr.gather(float4, scene.vertices, 2 * vertex, active)
    color = dr.gather(float4, scene.vertices, 2 * vertex + 1, active)
    return position, [position[3], color[0], color[1], color[2]]


def corner_of(frame: Frame, vertex: Any, record: Any, values: list[Any], adjoints: int) -> Corner:
    """A vertex record as a ray sees it, with ``adjoints`` accumulators at zero."""
    a, b, t = frame.project(record[0], record[1], record[2])
    zero = type(a)(0)
    return Corner(vertex, a, b, [t, *values], [zero for _ in range(adjoints)])


def inverse_length(t0: Any, t1: Any) -> Any:
    """One over the length of a crossing, 1 where rounding leaves none."""
    return 1.0 / dr.select(t1 > t0, t1 - t0, 1.0)


@dataclass
class Clip:
    """The part of a crossing in front of the camera: x = 0 keeps all of it."""

    x: Any
    clipped: Any

    @staticmethod
    def at_camera(t0: Any, t1: Any) -> Clip:
        """Clip a crossing from t0 to t1 at t = 0."""
        clipped = t0 < 0
        x = dr.select(clipped, dr.fmin(-t0 * inverse_length(t0, t1), 1.0), 0.0)
        return Clip(x, clipped)

    def apply(self, entry: list[Any], leaving: list[Any]) -> list[Any]:
        """Values where the crossing now starts."""
        return [dr.fma(self.x, v1 - v0, v0) for v0, v1 in zip(entry, leaving, strict=True)]


def render_forward(scene: MarchingScene) -> tuple[Any, Any]:
    """Render a view.

    Returns:
        Flat arrays: (H, W, 4) premultiplied radiance and optical depth, (H, W) integral of the distance.
    """
    backend = scene.backend
    real, pixels = backend.Float, scene.camera.width * scene.camera.height
    rays = make_rays(scene)

    def read(vertex: Any, active: Any) -> Corner:
        position, attributes = read_vertex(scene, vertex, active)
        return corner_of(rays.frame, vertex, position, attributes, 0)

    def visit(step: Step, ray: Radiance) -> Radiance:
        entry, leaving = step.entry, step.leaving
        if scene.entries.camera_inside:
            entry = Clip.at_camera(entry[0], leaving[0]).apply(entry, leaving)
        if scene.cells is not None:
            record = dr.gather(backend.Float4, scene.cells, step.cell)
            entry, leaving = ([values[0], record[3], record[0], record[1], record[2]] for values in (entry, leaving))
        length = dr.fmax(leaving[0] - entry[0], 0.0)
        w0, w1, transmittance = scene.optics.weights(length, entry[1], leaving[1])
        w0, w1 = w0 * ray.transmittance, w1 * ray.transmittance
        color = [dr.fma(w0, c0, dr.fma(w1, c1, c)) for c0, c1, c in zip(entry[2:], leaving[2:], ray.color, strict=True)]
        distance = dr.fma(w0, entry[0], dr.fma(w1, leaving[0], ray.distance))
        optical_depth = dr.fma(0.5 * length, entry[1] + leaving[1], ray.optical_depth)
        return Radiance(color, distance, optical_depth, ray.transmittance * transmittance)

    lanes = dr.width(rays.pixel)
    zeros = [dr.zeros(real, lanes) for _ in range(5)]
    start = Radiance(zeros[:3], zeros[3], zeros[4], dr.ones(real, lanes))
    ray = walk(scene, rays, read, visit, lambda face, ray, active: ray, start)
    light, distance = dr.empty(real, 4 * pixels), dr.empty(real, pixels)
    dr.scatter(light, backend.Float4(*ray.color, ray.optical_depth), rays.pixel, rays.valid)
    dr.scatter(distance, ray.distance, rays.pixel, rays.valid)
    backend.run(light, distance)
    return light, distance
