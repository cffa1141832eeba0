"""Derivatives of what depends on the optical depth alone: found without light, they are those found with it."""

import math

import pytest
import torch
from torch import Tensor

import difftetvr as dtv
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, CellFeatures, Rays, ScalarField, render

CAMERA = Camera.look_at((1.4, -1.1, 0.8), (0.0, 0.0, 0.0), fov_y=0.8, width=20, height=14)
KNOTS = torch.tensor([0.0, 0.3, 0.3, 0.7, 1.0], dtype=torch.float64)


def made(shape: tuple[int, ...], seed: int, least: float = 0.0) -> Tensor:
    values = torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (values + least).requires_grad_()


def mesh_of() -> TetMesh:
    grid = TetMesh.grid((3, 2, 3), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    noise = torch.randn(grid.vertices.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return grid.with_vertices((grid.vertices.double() + 0.03 * noise).requires_grad_())


def scene(kind: str, mesh: TetMesh) -> tuple[object, list[Tensor]]:
    """A field on a mesh, and what it is made of."""
    vertices, cells = mesh.num_vertices, mesh.num_cells
    if kind == "scalar":
        parts = [made((vertices,), 2), made((5,), 3, 0.1), made((5, 3), 4)]
        return ScalarField(parts[0], dtv.TransferFunction(KNOTS, parts[1], parts[2]), 4.0, (0.0, 1.0)), parts
    if kind == "features":
        parts = [made((cells, 5), 2), made((vertices,), 3, 0.5)]
        none = parts[1].new_zeros(vertices, 0)
        return CellFeatures(parts[0], Field(none, parts[1])), parts
    count = cells if kind == "cell" else vertices
    parts = [made((count, 0 if kind == "no channels" else 3), 2), made((count,), 3, 1.5)]
    return Field(*parts, "cell" if kind == "cell" else "vertex"), parts


@pytest.mark.parametrize("threshold", [0.0, 0.2])
@pytest.mark.parametrize("kind", ["vertex", "no channels", "cell", "scalar", "features"])
@pytest.mark.parametrize("what", ["optical_depth", "alpha"])
def test_what_depends_on_the_optical_depth_needs_no_light(what: str, kind: str, threshold: float) -> None:
    mesh = mesh_of()
    field, parts = scene(kind, mesh)
    plane = (0.3, 0.2, 0.9, 0.05)
    image = render(mesh, field, CAMERA, transmittance_threshold=threshold, clip_plane=plane)  # type: ignore[arg-type]
    weights = torch.rand(image.alpha.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    loss = (weights * getattr(image, what)).sum()
    leaves = [mesh.vertices, *(part for part in parts if part.numel())]
    alone = torch.autograd.grad(loss, leaves, retain_graph=True, allow_unused=True)
    # Whatever is lit has a depth, too, so asking for that takes the way of light.
    with_light = torch.autograd.grad(loss + 0.0 * image.depth.sum(), leaves, allow_unused=True)
    assert any(g is not None and bool((g != 0).any()) for g in alone)
    for one, other in zip(alone, with_light, strict=True):
        torch.testing.assert_close(
            torch.zeros(1) if one is None else one, torch.zeros(1) if other is None else other, rtol=1e-9, atol=1e-11
        )


@pytest.mark.parametrize("renderer", ["marching", "linked-list"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("what", ["optical_depth", "alpha"])
def test_rays_that_stop_at_a_face_stop_there_in_the_adjoint(what: str, dtype: torch.dtype, renderer: str) -> None:
    """In a uniform medium, the threshold lies where many rays pass a face: rounding decides, and must decide alike."""
    mesh = TetMesh.grid((4, 4, 4), (0.0, 0.0, 0.0), (4.0, 4.0, 4.0)).to(dtype=dtype)
    density = torch.full((mesh.num_vertices,), 0.5, dtype=dtype, requires_grad=True)
    origins = 3.8 * torch.rand(200, 3, generator=torch.Generator().manual_seed(2)) + 0.1
    origins[:, 2] = -1.0
    rays = Rays(origins.to(dtype), torch.tensor([0.0, 0.0, 1.0], dtype=dtype))
    image = render(
        mesh,
        Field(density.new_zeros(len(density), 3), density),
        rays,
        transmittance_threshold=math.exp(-1.0),
        renderer=renderer,
    )
    (found,) = torch.autograd.grad(getattr(image, what).sum(), density)
    # Of the same density everywhere, both are known functions.
    depth = image.optical_depth.detach()
    by_depth = torch.ones_like(depth) if what == "optical_depth" else torch.exp(-depth)
    torch.testing.assert_close(found.sum(), (by_depth * depth / 0.5).sum(), rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("wanted", ["color", "optical_depth"])
def test_scalars_have_the_same_derivatives_whether_their_function_needs_some(wanted: str) -> None:
    mesh = mesh_of()
    scalar, opacity, color = made((mesh.num_vertices,), 2), made((5,), 3, 0.1), made((5, 3), 4)
    found = []
    for function in (
        dtv.TransferFunction(KNOTS, opacity, color),
        dtv.TransferFunction(KNOTS, *map(Tensor.detach, (opacity, color))),
    ):
        image = render(mesh, ScalarField(scalar, function, 4.0, (0.0, 1.0)), CAMERA, deterministic=True)
        found.append(torch.autograd.grad(getattr(image, wanted).square().sum(), [mesh.vertices, scalar]))
    for known, unknown in zip(*found, strict=True):
        assert torch.equal(known, unknown)
