"""``render_normals``: which way matter faces along rays."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from difftetvr.backend import backend_for
from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.recording import eager
from difftetvr.rendering.api import RenderedImage, render
from difftetvr.rendering.cell_features import CellFeatures, medium_of
from difftetvr.rendering.rays import Rays, RaySource
from difftetvr.rendering.scalar_field import ScalarField


@eager
def render_normals(
    mesh: TetMesh,
    field: Field | ScalarField | CellFeatures,
    camera: RaySource | Rays | Sequence[RaySource],
    renderer: str = "marching",
    transmittance_threshold: float = 0.0,
    deterministic: bool = False,
    clip_plane: Sequence[float] | torch.Tensor | None = None,
) -> torch.Tensor | tuple[torch.Tensor, ...]:
    """Expected normals: the integral of T s n along each ray, with the transmittance T, the density s and its normal n.

    The normal is constant in a cell: the direction in which the density falls fastest, or, of scalars with a transfer
    function, in which the scalar does, as for :func:`difftetvr.isosurface`; none where it is constant. Premultiplied
    as colours are: divide by alpha for the mean over the light that is absorbed, or normalise. Where normals differ it
    is shorter than alpha. Differentiable in all that :func:`difftetvr.render` is differentiable in.

    Args:
        mesh: The mesh, see :func:`difftetvr.render`, as all that is not told here.
        field: Densities or scalars per vertex.
        camera: A camera, any bundle of rays, or cameras.
        renderer: How crossings are found and ordered.
        transmittance_threshold: Rays stop once their transmittance is at or below this value.
        deterministic: Whether gradients are the same in every run to the last bit.
        clip_plane: (4,) a, b, c, d: only what lies where a x + b y + c z + d >= 0 is seen.

    Returns:
        (H, W, 3) in world space. Of several cameras (B, H, W, 3), or a tuple.

    Raises:
        MeshError: The field is constant in each cell, does not fit the mesh, or holds values that are no densities.
        DiffTetError: An argument is of the wrong kind or out of range.
        BackendError: See :func:`difftetvr.render`.
    """
    medium = medium_of(mesh, field).medium
    if medium.location_on(mesh) == "cell":
        raise MeshError("The field is constant in each cell, so nothing says where it faces; pass values of vertices.")
    values = medium.scalar if isinstance(medium, ScalarField) else medium.density
    normals = cell_normals(mesh, values).to(mesh.vertices.dtype)
    image = render(
        mesh,
        CellFeatures(normals, medium),
        camera,
        renderer=renderer,
        transmittance_threshold=transmittance_threshold,
        deterministic=deterministic,
        clip_plane=clip_plane,
    )
    return image.color if isinstance(image, RenderedImage) else tuple(part.color for part in image)


def cell_normals(mesh: TetMesh, values: torch.Tensor) -> torch.Tensor:
    """Directions in which the linear interpolant of values falls fastest; differentiable in vertices and values.

    Args:
        mesh: The mesh.
        values: (V,) per vertex, on the device of the mesh.

    Returns:
        (T, 3) unit vectors, 0 where the values of a cell are all the same; float64 where the device knows it.
    """
    dtype = backend_for(mesh.vertices).at(None).dtype
    corners, heights = (part.to(dtype)[mesh.tets.long()] for part in (mesh.vertices, values.to(mesh.vertices.device)))
    edges, rises = corners[:, 1:] - corners[:, :1], heights[:, 1:] - heights[:, :1]
    # In units of their own, so that no product vanishes or overflows, however small the cell or steep the field.
    edges = edges / _largest(edges.detach().flatten(1))[:, None, None]
    rises = rises / _largest(rises.detach())[:, None]
    areas = torch.stack([torch.linalg.cross(edges[:, (k + 1) % 3], edges[:, (k + 2) % 3]) for k in range(3)], 1)
    orientation = (edges[:, 0] * areas[:, 0]).sum(1).detach().sign()
    # The gradient times the cell's volume: a direction needs no division by what may be next to nothing.
    slopes = (rises[:, :, None] * areas).sum(1) * orientation[:, None]
    square = slopes.square().sum(1, keepdim=True)
    is_flat = square == 0
    return torch.where(is_flat, 0.0, -slopes / torch.where(is_flat, 1.0, square).sqrt())


def _largest(values: torch.Tensor) -> torch.Tensor:
    """(N,) greatest magnitude in each row, 1 where all is 0."""
    largest = values.abs().amax(1)
    return torch.where(largest > 0, largest, 1.0)
