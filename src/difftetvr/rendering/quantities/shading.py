"""``render_shading``: how brightly a distant light shines on what rays see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import overload

import torch

from difftetvr.backend import backend_for
from difftetvr.errors import DiffTetError, shown
from difftetvr.inputs import as_number, as_reals
from difftetvr.mesh import Field, TetMesh
from difftetvr.recording import eager
from difftetvr.rendering.api import RenderedImage, render
from difftetvr.rendering.cell_features import CellFeatures, medium_of
from difftetvr.rendering.rays import Rays, RaySource
from difftetvr.rendering.scalar_field import ScalarField


@overload
def render_shading(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: RaySource | Rays,
    light: Sequence[float] | torch.Tensor,
    ambient: float = 0.35,
    renderer: str = "marching",
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> torch.Tensor: ...


@overload
def render_shading(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: Sequence[RaySource],
    light: Sequence[float] | torch.Tensor,
    ambient: float = 0.35,
    renderer: str = "marching",
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> torch.Tensor | tuple[torch.Tensor, ...]: ...


@eager
def render_shading(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: RaySource | Rays | Sequence[RaySource],
    light: Sequence[float] | torch.Tensor,
    ambient: float = 0.35,
    renderer: str = "marching",
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> torch.Tensor | tuple[torch.Tensor, ...]:
    """Gradient shading: the mean shade of what each ray sees, by which the colours of an image are multiplied.

    The shade of a cell is Lambert's, of both sides: ambient + (1 - ambient) abs(n . l), with the direction l to the
    light and the direction n of the gradient of the density, or of the scalar that a transfer function is applied to.
    The gradient is that of the linear interpolant, averaged by volume at each vertex and then over the cell's four: a
    smooth scalar is shaded smoothly, though the shade is constant in a cell. Where it is 0 there is no side that light
    could fall on, and the shade is 1. Of the shades along a ray, the mean is weighted by the light that is absorbed
    there: the integral of T s shade over alpha, with the transmittance T and the density s. On an opaque surface it is
    that of the surface; in fog it is one of many.

    Differentiable once in all that :func:`difftetvr.render` is differentiable in, in values and vertices through the
    gradient, too; and in the light.

    Args:
        mesh: The mesh, see :func:`difftetvr.render`.
        field: What is lit: densities or scalars per vertex or per cell; the latter are averaged at vertices first.
        camera: A camera, any bundle of rays, or cameras.
        light: (3,) direction to the light in world space, of any length but 0.
        ambient: Shade of what faces across the light, in [0, 1].
        renderer: How crossings are found and ordered.
        clip_plane: (4,) a, b, c, d: only what lies where a x + b y + c z + d >= 0 is seen.

    Returns:
        (H, W) shades in [0, 1], or (...) of the rays; 1 where a ray sees nothing. Of several cameras (B, H, W), or a
        tuple.

    Raises:
        MeshError: The field does not fit the mesh, or holds values that are no densities.
        DiffTetError: The light is no direction, the ambient is out of range, or another argument is not valid.
        BackendError: See :func:`difftetvr.render`.
    """
    medium = medium_of(mesh, field).medium
    ambient = as_number(ambient, "The ambient", DiffTetError)
    if not 0.0 <= ambient <= 1.0:
        raise DiffTetError(f"The ambient is {shown(ambient)}; it must lie between 0 and 1.")
    gradients = smooth_gradients(mesh, medium)
    cosine = (_directions(gradients) @ _direction(light).to(gradients)).abs()
    is_flat = (gradients == 0.0).all(1)
    shade = torch.where(is_flat, 1.0, ambient + (1.0 - ambient) * cosine)
    features = CellFeatures(shade[:, None].to(mesh.vertices.dtype), medium)
    image = render(mesh, features, camera, renderer=renderer, clip_plane=clip_plane)
    return _mean_shade(image) if isinstance(image, RenderedImage) else tuple(map(_mean_shade, image))


def _mean_shade(image: RenderedImage) -> torch.Tensor:
    is_empty = image.alpha <= 0.0
    return torch.where(is_empty, 1.0, image.color[..., 0] / torch.where(is_empty, 1.0, image.alpha))


def smooth_gradients(mesh: TetMesh, medium: Field | ScalarField) -> torch.Tensor:
    """Gradients of a density or a scalar, averaged around vertices; differentiable in vertices and values.

    Args:
        mesh: The mesh.
        medium: What it holds.

    Returns:
        (T, 3) up to one factor for all cells, 0 where nothing changes; float64 where the device knows it.
    """
    values = medium.scalar if isinstance(medium, ScalarField) else medium.density
    dtype = backend_for(mesh.vertices).at(None).dtype
    cells, values = mesh.tets.long(), values.to(mesh.vertices.device, dtype)
    corners = mesh.vertices.to(dtype)[cells]
    edges = corners[:, 1:] - corners[:, :1]
    # In units of their own, so that no product vanishes or overflows, however small the mesh or steep the field.
    edges, values = edges / _largest(edges), values / _largest(values)
    areas = torch.stack([torch.linalg.cross(edges[:, (k + 1) % 3], edges[:, (k + 2) % 3]) for k in range(3)], 1)
    sixfold = (edges[:, 0] * areas[:, 0]).sum(1)
    weights = sixfold.abs()
    if medium.location_on(mesh) == "cell":
        values = _at_vertices(mesh, values[:, None], weights)[:, 0]
    heights = values[cells]
    # The gradient times six volumes, which is what is averaged: no division by what may be next to nothing.
    slopes = ((heights[:, 1:] - heights[:, :1])[:, :, None] * areas).sum(1) * sixfold.detach().sign()[:, None]
    return _at_vertices(mesh, slopes, weights, is_weighted=True)[cells].mean(1)


def _at_vertices(mesh: TetMesh, values: torch.Tensor, weights: torch.Tensor, is_weighted: bool = False) -> torch.Tensor:
    """(V, C) means of the (T, C) values of the cells around each vertex, which may have been weighted already."""
    cells = mesh.tets.long().flatten()
    weighted = values if is_weighted else values * weights[:, None]
    total = values.new_zeros(mesh.num_vertices, values.shape[1]).index_add(0, cells, weighted.repeat_interleave(4, 0))
    weight = weights.new_zeros(mesh.num_vertices).index_add(0, cells, weights.repeat_interleave(4))
    is_alone = weight <= 0.0
    return torch.where(is_alone[:, None], 0.0, total / torch.where(is_alone, 1.0, weight)[:, None])


def _directions(gradients: torch.Tensor) -> torch.Tensor:
    """(T, 3) unit vectors, 0 where there is none."""
    scaled = gradients / _largest(gradients)
    square = scaled.square().sum(1, keepdim=True)
    is_flat = square == 0.0
    return torch.where(is_flat, 0.0, scaled / torch.where(is_flat, 1.0, square).sqrt())


def _direction(light: Sequence[float] | torch.Tensor) -> torch.Tensor:
    """(3,) unit vector to the light.

    Raises:
        DiffTetError: It is none.
    """
    vector = as_reals(light, "light", DiffTetError, torch.float64, "pass a direction, three numbers").double()
    length = float(vector.detach().norm()) if vector.shape == (3,) else math.nan
    if not (math.isfinite(length) and length > 0.0):
        raise DiffTetError(f"light is {shown(light)}; pass a direction other than 0, three finite numbers.")
    return vector / vector.norm()


def _largest(values: torch.Tensor) -> torch.Tensor:
    """The greatest magnitude of all, 1 where all is 0."""
    largest = values.detach().abs().max()
    return torch.where(largest > 0.0, largest, 1.0)
