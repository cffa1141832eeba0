"""``depth_at`` and ``transmittance_at``: where along a ray its light goes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch

from difftetvr.errors import DiffTetError, shown
from difftetvr.inputs import as_reals, handed_over
from difftetvr.memory import tried_twice
from difftetvr.mesh import Field, TetMesh
from difftetvr.recording import eager
from difftetvr.rendering.api import checked_cameras
from difftetvr.rendering.cameras.checks import MOST_PIXELS
from difftetvr.rendering.cell_features import CellFeatures, medium_of
from difftetvr.rendering.preparation import PreparedView, ViewOptions, as_rays, prepare_view
from difftetvr.rendering.quantities.profile import depths_at, distances_at
from difftetvr.rendering.rays import Rays, RaySource
from difftetvr.rendering.scalar_field import ScalarField

Numbers = float | Sequence[float] | torch.Tensor
"""One number, or several, for all rays or each."""


@eager
@tried_twice
def depth_at(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: RaySource | Rays | Sequence[RaySource],
    transmittance: Numbers = 0.5,
    renderer: str = "marching",
    deterministic: bool = False,
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> torch.Tensor | tuple[torch.Tensor, ...]:
    """Distances along rays at which their transmittance has fallen to given values: at 0.5, the median depth.

    Solved exactly in the cell where it happens, in one walk for all values. Unlike the expected depth of an image, the
    median is that of a surface also where fog lies in front of it, or light behind. Differentiable, by the theorem of
    implicit functions, in all that :func:`difftetvr.render` is differentiable in, and in ``transmittance``; where the
    value is not reached there is no derivative, and it grows without bound where the density vanishes.

    Args:
        mesh: The mesh, see :func:`difftetvr.render`, as all that is not told here.
        field: The field, of which only the density counts.
        camera: A camera, any bundle of rays, or cameras.
        transmittance: Values between 0 and 1, neither of them included: a number, (K,) for all rays, or (H, W, K).
        renderer: How crossings are found and ordered.
        deterministic: Whether gradients are the same in every run to the last bit.
        clip_plane: (4,) a, b, c, d: light is absorbed only where a x + b y + c z + d >= 0.

    Returns:
        (H, W) of a number, else (H, W, K): distances from the rays' origins in world units; infinite where the
        transmittance of a ray never falls that far. Of several cameras (B, H, W), (B, H, W, K), or a tuple.

    Raises:
        MeshError: The field does not fit the mesh, or holds a negative density or a value that is not finite.
        DiffTetError: An argument is of the wrong kind or out of range.
        BackendError: See :func:`difftetvr.render`.
    """
    values = _checked(transmittance, "transmittance")
    known = values.detach()
    if not bool(((known > 0) & (known < 1)).all()):
        raise DiffTetError(f"transmittance is {shown(transmittance)}; give values between 0 and 1, without these two.")

    def distances(view: PreparedView, values: torch.Tensor) -> torch.Tensor:
        depths = -torch.log(_of_each_ray(values, view, "transmittance"))
        found = distances_at(view, view.limits, depths) * view.unit
        return found if view.shift is None else found + view.shift[:, None]

    options = ViewOptions(deterministic=deterministic, renderer=renderer)
    look = partial(_looked, mesh, field, options, clip_plane, distances)
    return _of_views(look, camera, values, renderer)


@eager
@tried_twice
def transmittance_at(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: RaySource | Rays | Sequence[RaySource],
    distances: Numbers,
    renderer: str = "marching",
    deterministic: bool = False,
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> torch.Tensor | tuple[torch.Tensor, ...]:
    """Transmittances from where rays begin to given distances along them.

    One walk serves all distances of a ray. Differentiable in all that :func:`difftetvr.render` is differentiable in,
    and in ``distances``: the derivative by one of them is minus the density there times the transmittance.

    Args:
        mesh: The mesh, see :func:`difftetvr.render`, as all that is not told here.
        field: The field, of which only the density counts.
        camera: A camera, any bundle of rays, or cameras.
        distances: Distances from the rays' origins in world units, in any order, infinite ones among them: a number,
            (K,) for all rays, or (H, W, K).
        renderer: How crossings are found and ordered.
        deterministic: Whether gradients are the same in every run to the last bit.
        clip_plane: (4,) a, b, c, d: light is absorbed only where a x + b y + c z + d >= 0.

    Returns:
        (H, W) of a number, else (H, W, K), in [0, 1]: 1 before a ray begins, and constant behind its end. Of several
        cameras (B, H, W), (B, H, W, K), or a tuple.

    Raises:
        MeshError: The field does not fit the mesh, or holds a negative density or a value that is not finite.
        DiffTetError: An argument is of the wrong kind, or a distance is NaN.
        BackendError: See :func:`difftetvr.render`.
    """
    places = _checked(distances, "distances")
    if bool(torch.isnan(places.detach()).any()):
        raise DiffTetError(f"distances is {shown(distances)}, with NaN among them; give numbers.")

    def transmittances(view: PreparedView, places: torch.Tensor) -> torch.Tensor:
        near: Any = 0.0
        along, shift = _of_each_ray(places, view, "distances"), view.shift
        if view.bundle is not None and shift is not None:
            along, near = along - shift[:, None], (view.bundle.near - shift)[:, None].to(along) / view.unit
        along, limits = along / view.unit, view.limits
        if limits is not None:
            # Distances do not pass the far end, so that it need not cut cells, and where it is has its derivatives.
            near, far = limits[:, :1], limits[:, 1:]
            along = torch.minimum(along, far.to(along))
            limits = torch.cat((near, torch.full_like(far, math.inf)), 1)
        depths = depths_at(view, limits, along)
        return torch.exp(-torch.where(along > near, depths, 0.0))

    options = ViewOptions(deterministic=deterministic, renderer=renderer)
    look = partial(_looked, mesh, field, options, clip_plane, transmittances)
    return _of_views(look, camera, places, renderer)


def _checked(values: Numbers, name: str) -> torch.Tensor:
    return as_reals(values, name, DiffTetError, torch.float64, "give a number or a tensor")


def _looked(
    mesh: Any,
    field: Any,
    options: ViewOptions,
    clip_plane: Any,
    look: Callable[[PreparedView, torch.Tensor], torch.Tensor],
    camera: RaySource | Rays,
    values: torch.Tensor,
) -> torch.Tensor:
    """What a function of views and values says of one camera, (H, W) or (H, W, K), in the precision of the mesh."""
    view = prepare_view(mesh, medium_of(mesh, field), camera, options, clip_plane)
    shape = view.shape if values.dim() == 0 else (*view.shape, values.shape[-1])
    if 0 in shape:
        return view.empty(shape)
    return look(view, values).to(mesh.vertices.dtype).reshape(shape)


def _of_each_ray(values: torch.Tensor, view: PreparedView, name: str) -> torch.Tensor:
    """(N, K) values of all rays of a view."""
    width = values.shape[-1] if values.dim() else 1
    rays = math.prod(view.shape)
    if rays * width > MOST_PIXELS:
        raise DiffTetError(f"There are {rays * width:,} {name} of all rays; ask for {MOST_PIXELS:,} at most at a time.")
    rows = values if values.dim() else values[None]
    try:
        rows = torch.broadcast_to(handed_over(rows, view.vertices, rows.dtype), (*view.shape, width))
    except RuntimeError as reason:
        raise DiffTetError(
            f"{name} has shape {tuple(values.shape)} and the rays {view.shape}; give a number, (K,), or the rays' "
            "shape and K behind it."
        ) from reason
    return rows.reshape(-1, width)


def _of_views(
    one: Callable[[RaySource | Rays, torch.Tensor], torch.Tensor], camera: Any, values: torch.Tensor, renderer: str
) -> torch.Tensor | tuple[torch.Tensor, ...]:
    """What is asked of a camera, or of several: as one tensor where they have one size."""
    if not isinstance(camera, Sequence):
        return one(camera, values)
    cameras = checked_cameras(camera)
    if renderer != "projected":
        bundles = [as_rays(view) for view in cameras]
        if len({bundle.shape for bundle in bundles}) == 1:
            return one(Rays.stacked(bundles), values)
    # Where there are values for each ray of all views, each view has its own.
    has_own, count = values.dim() == 4 and len(values) in (1, len(cameras)), len(cameras)
    own = values.expand(count, -1, -1, -1) if has_own else [values] * count
    found = [one(view, part) for view, part in zip(cameras, own, strict=True)]
    return torch.stack(found) if len({part.shape for part in found}) == 1 else tuple(found)
