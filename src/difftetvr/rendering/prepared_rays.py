"""Bundles of rays as kernels take them: counted from near the mesh, in the unit of kernels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from difftetvr.backend import Backend, backend_for
from difftetvr.inputs import handed_over
from difftetvr.mesh import TetMesh
from difftetvr.recording import replayed
from difftetvr.rendering.clip_plane import clip_rays
from difftetvr.rendering.rays import Rays, image_order, one_vector, unit_vectors
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.traversal.recount import CountedRays, GivenRays, Rows, recount


@dataclass(frozen=True)
class GivenBundle:
    """A bundle of rays as callers pass it, relative to the mesh's origin and where the mesh is.

    What is one in memory for all rays still has a row for each: autograd asks for the derivatives of each.

    Attributes:
        shape: Of the bundle, of N rays.
        origins, directions: (N, 3), the directions of any length but 0.
        near, far: (N, 1) distances between which rays are looked at, in world units; a number where all have the same.
    """

    shape: torch.Size
    origins: torch.Tensor
    directions: torch.Tensor
    near: torch.Tensor | float
    far: torch.Tensor | float

    @property
    def count(self) -> int:
        """N."""
        return self.shape.numel()

    @staticmethod
    def of(rays: Rays, mesh: TetMesh, clip_plane: Any) -> GivenBundle:
        """Rays before a plane, if there is one, see :func:`difftetvr.render`."""
        rays = rays.relative_to(mesh.origin)
        like, wide = mesh.vertices, backend_for(mesh.vertices).at(None).dtype
        origins, directions = (_rows(part, like, wide) for part in (rays.origins, rays.directions))
        ends: Any = (rays.near, rays.far) if clip_plane is None else rays.ends
        near, far = (_rows(e[..., None], like, wide) if isinstance(e, torch.Tensor) else e for e in ends)
        if clip_plane is not None:
            first, last = clip_rays(clip_plane, origins.to(wide), unit_vectors(directions.to(wide)), mesh.origin)
            near, far = torch.maximum(near, first[:, None]), torch.minimum(far, last[:, None])
        return GivenBundle(rays.shape, origins, directions, near, far)


@dataclass(frozen=True)
class PreparedRays:
    """A bundle of rays, each counted from where it is nearest to the mesh's centre: there, float32 resolves most.

    Attributes:
        counted: The rays in kernels' memory.
        order: (N,) number of the ray that each lane has, there; None for rays as they are numbered.
        ends: Their limits there; None where nothing is known to be cut off.
        sees_all: (2,) flags there, the first of them 1 if no ray begins or ends near the mesh; None if nobody asks.
        begins_at_point: Whether all rays are known to be looked at from one point on.
        near: (N,) distances from the true origins from which on rays are looked at, in world units, or one for all.
        lines, limits: (N, 6) and (N, 2), those of ``counted`` as autograd follows them; None where it need not.
    """

    counted: CountedRays
    order: Any | None
    ends: Any | None
    sees_all: Any | None
    begins_at_point: bool
    near: torch.Tensor | float
    lines: torch.Tensor | None
    limits: torch.Tensor | None

    @staticmethod
    def of(given: GivenBundle, mesh: TetMesh, backend: Backend, unit: float) -> PreparedRays:
        """Count rays anew from near a mesh; differentiable in them.

        Args:
            given: The rays.
            mesh: The mesh.
            backend: Where kernels run, and at which precision.
            unit: The unit of kernels, in world units.
        """
        parts = given.origins, given.directions, given.near, given.far
        rows = [part if isinstance(part, torch.Tensor) else None for part in parts]
        counted = _counted(given, mesh, backend, unit)
        is_told = backend.name == "llvm" or not given.count
        sees_all, begins_at_point = (flag > 0 for flag in counted.flags.numpy().tolist()) if is_told else (False, False)
        lines = limits = None
        needed = [part is not None and part.requires_grad for part in rows]
        if any(needed):
            lines, limits = _Recount.apply(counted, backend, unit, *rows)
        ends_matter = any(needed[2:])
        return PreparedRays(
            counted,
            lane_order(backend, tuple(given.shape)),
            None if sees_all and not ends_matter else counted.limits,
            None if is_told or ends_matter else counted.flags,
            begins_at_point,
            given.near[:, 0] if isinstance(given.near, torch.Tensor) else given.near,
            lines,
            limits if ends_matter else None,
        )


def _counted(given: GivenBundle, mesh: TetMesh, backend: Backend, unit: float) -> CountedRays:
    """The rays as kernels count them."""
    wide = backend.at(None)
    if not given.count:
        none = backend.Float()
        return CountedRays(none, none, wide.Float(), wide.Float(), backend.Float(1, 1))

    def rows(part: torch.Tensor | float) -> Rows:
        if not isinstance(part, torch.Tensor):
            return Rows(wide.constant(part), 0, 1)
        one = one_vector(part)
        return Rows(backend.at(part.dtype).floats(part if one is None else one), int(one is None), part.shape[1])

    arrays = GivenRays(
        backend,
        wide.Float,
        backend.lanes(given.count),
        given.count,
        rows(given.origins),
        rows(given.directions),
        rows(given.near),
        rows(given.far),
        backend.at(mesh.vertices.dtype).floats(mesh.vertices),
        MemoryOrder.of(mesh).tables(backend).vertices,
        wide.constant(unit),
    )
    counted: CountedRays = replayed(recount, arrays)
    backend.run(counted.flags)  # before the arrays go, of which some may be copies
    return counted


@lru_cache(maxsize=16)
def lane_order(backend: Backend, shape: tuple[int, ...]) -> Any | None:
    """See :func:`difftetvr.rendering.rays.image_order`, in kernels' memory."""
    order = image_order(shape, backend.device)
    return None if order is None else backend.uints(order)


@lru_cache(maxsize=16)
def lane_places(backend: Backend, shape: tuple[int, ...]) -> Any | None:
    """Which lane has each ray, see :func:`lane_order`."""
    order = image_order(shape, backend.device)
    return None if order is None else backend.uints(torch.argsort(order).int())


def _rows(values: torch.Tensor, like: torch.Tensor, wide: torch.dtype) -> torch.Tensor:
    """(N, width) of (..., width) on the device of another tensor, in float32 or the best precision that it knows."""
    rows = values.reshape(-1, values.shape[-1])
    dtype = rows.dtype if rows.dtype in (torch.float32, wide) else torch.float32
    one = None if rows.requires_grad else one_vector(rows)
    return handed_over(rows, like, dtype) if one is None else handed_over(one, like, dtype).expand(rows.shape)


class _Recount(torch.autograd.Function):
    """From (N, 3) origins and directions and (N, 1) ends of rays, None where a number, to their lines and limits.

    Where on its line a ray is counted from is of no consequence, so its shift counts as constant.
    """

    @staticmethod
    def forward(ctx: Any, counted: CountedRays, backend: Backend, unit: float, *rows: torch.Tensor | None) -> Any:
        """Hand over what kernels have counted."""
        ctx.set_materialize_grads(False)
        lines, limits = backend.tensor(counted.lines, -1, 6), backend.tensor(counted.limits, -1, 2)
        shift, length = (backend.at(None).tensor(part) for part in (counted.shift, counted.length))
        ctx.unit, ctx.dtypes = unit, [None if part is None else part.dtype for part in rows]
        ctx.save_for_backward(lines, shift, length)
        return lines, limits

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_lines: torch.Tensor | None, by_limits: torch.Tensor | None) -> Any:
        """The transposes of what was done to each ray."""
        lines, shift, length = ctx.saved_tensors
        found: list[torch.Tensor | None] = [None] * 4
        if by_lines is not None:
            by_origin, by_direction = by_lines.to(shift.dtype).split(3, dim=1)
            by_origin, direction = by_origin / ctx.unit, lines[:, 3:]
            by_direction = by_direction + shift[:, None] * by_origin
            along = direction * (direction * by_direction).sum(1, keepdim=True)
            found[:2] = by_origin, (by_direction - along) / length[:, None]
        if by_limits is not None:
            found[2:] = (by_limits.to(shift.dtype) / ctx.unit).split(1, dim=1)
        pairs = zip(found, ctx.dtypes, strict=True)
        by_rows = (None if part is None or dtype is None else part.to(dtype) for part, dtype in pairs)
        return None, None, None, *by_rows
