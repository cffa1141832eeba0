"""What rays meet: depth complexity and the quality of cells (Dr.Jit kernel)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import require_own_threads
from difftetvr.errors import DiffTetError
from difftetvr.inputs import require_type
from difftetvr.memory import tried_twice
from difftetvr.mesh import Field, TetMesh
from difftetvr.recording import eager
from difftetvr.rendering.preparation import ViewOptions, prepare_view
from difftetvr.rendering.rays import Rays, RaySource
from difftetvr.rendering.traversal.crossing import Span, Step, Tracer, corner_of, read_vertex
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.walk import Corner, Face


@dataclass(frozen=True)
class RayStatistics:
    """What the rays of a view meet.

    Attributes:
        depth_complexity: (H, W) int32, number of cells that each ray crosses.
        worst_quality: (H, W) least quality Q of these cells, in (0, 1]; NaN where a ray meets none.
    """

    depth_complexity: torch.Tensor
    worst_quality: torch.Tensor


@eager
@tried_twice
@torch.no_grad()
def inspect_rays(
    mesh: TetMesh,
    camera: RaySource | Rays,
    renderer: str = "marching",
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> RayStatistics:
    """Count the cells that rays cross, and find the worst of them (as the front end of the original does).

    Args:
        mesh: The mesh.
        camera: A camera, or any bundle of rays.
        renderer: How crossings are found, see :func:`difftetvr.render`.
        clip_plane: Only cells that reach into this half-space on the ray count; see there, too.

    Returns:
        The statistics, on the device of the mesh.

    Raises:
        DiffTetError: There is no such renderer, or the plane is none.
        BackendError: No back end runs on the device of the mesh.
    """
    require_type(mesh, TetMesh, "mesh", "pass a difftetvr.TetMesh", DiffTetError)
    require_own_threads()
    quality = mesh.quality()
    # A field per cell makes the smallest vertex records; its only channel carries the quality.
    field = Field(quality[:, None], torch.zeros_like(quality), "cell")
    view = prepare_view(mesh, field, camera, ViewOptions(renderer=renderer), clip_plane)
    if 0 in view.shape:
        empty = quality.new_zeros(view.shape)
        return RayStatistics(empty.int(), empty)
    backend, rays = view.task.backend, math.prod(view.shape)
    with backend.exclusive():
        tracer = view.tracer(view.ends)
        count, worst = dr.zeros(backend.Int, rays), dr.zeros(backend.Float, rays)
        tracer.trace(lambda rays: _InspectionKernel(tracer, rays, count, worst))
        counts, least = backend.tensor(count, *view.shape), backend.tensor(worst, *view.shape)
    return RayStatistics(counts, torch.where(counts > 0, least, torch.nan))


@dataclass
class _Inspected:
    count: Any
    worst: Any


class _InspectionKernel:
    """Looks at cells; see :class:`difftetvr.rendering.traversal.crossing.Kernel`."""

    def __init__(self, tracer: Tracer, rays: Lanes, count: Any, worst: Any) -> None:
        self.view, self.rays, self.count, self.worst = tracer.view, rays, count, worst
        self.span = Span.of(tracer, rays)

    def start(self) -> _Inspected:
        real, lanes = self.view.backend.Float, dr.width(self.rays.pixel)
        return _Inspected(dr.zeros(self.view.backend.Int, lanes), dr.full(real, dr.inf, lanes))

    def read(self, vertex: Any, active: Any) -> Corner:
        position, attributes = read_vertex(self.view, vertex, active)
        return corner_of(self.rays.frame, vertex, position, attributes, 0)

    def visit(self, step: Step, ray: _Inspected) -> _Inspected:
        quality = self.view.records.gather(self.view.backend, self.view.cells, step.cell)[0]
        # What lies behind the camera or is clipped is not met, whichever renderer comes across it.
        met = dr.mask_t(quality)(True)
        if self.span is not None:
            met &= step.leaving[0] > self.span.near
            if self.span.far is not None:
                met &= step.entry[0] < self.span.far
        count = ray.count + dr.select(met, 1, 0)
        return _Inspected(count, dr.select(met, dr.fmin(ray.worst, quality), ray.worst))

    def goes_on(self, ray: _Inspected) -> Any:
        return dr.mask_t(ray.worst)(True)

    def leave(self, face: Face, ray: _Inspected, active: Any) -> _Inspected:
        return ray

    def finish(self, ray: _Inspected) -> None:
        dr.scatter(self.count, ray.count, self.rays.pixel, self.rays.valid)
        dr.scatter(self.worst, ray.worst, self.rays.pixel, self.rays.valid)
