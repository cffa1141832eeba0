"""What is asked of rays that meet nothing, or matter beyond all bounds; shapes, several cameras, and mistakes."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from rendering.helpers import assert_sentence
from torch import Tensor

from difftetvr.errors import DiffTetError, MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, CellFeatures, Rays, ScalarField, depth_at, render, transmittance_at

RENDERERS = ("marching", "linked-list", "projected")
CAMERA = Camera.look_at((0.4, -1.7, 0.6), (0.5, 0.5, 0.5), fov_y=0.9, width=7, height=5)


def constant(mesh: TetMesh, density: float) -> Field:
    values = torch.full((mesh.num_vertices,), density, dtype=mesh.vertices.dtype)
    return Field(values[:, None], values)


def through(count: int = 1, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Rays through the unit cube along z, which it holds from 1 to 2."""
    across = 0.1 + 0.8 * torch.rand(count, 2, generator=torch.Generator().manual_seed(6), dtype=dtype)
    origins = torch.cat([across, torch.full((count, 1), -1.0, dtype=dtype)], 1)
    return origins, torch.tensor([0.0, 0.0, 1.0], dtype=dtype)


def one(found: Any) -> Tensor:
    assert isinstance(found, Tensor)
    return found


@pytest.mark.parametrize("renderer", RENDERERS)
def test_nothing_is_reached_where_nothing_is(renderer: str) -> None:
    """Past the mesh, and in it where it is empty; with derivatives of 0."""
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    away = Camera.look_at((0.4, -1.7, 0.6), (0.5, -5.0, 0.5), width=7, height=5)
    for camera, density in ((CAMERA, 0.0), (away, 5.0)):
        field = constant(mesh, density)
        values, vertices = field.density.clone().requires_grad_(), mesh.vertices.clone().requires_grad_()
        moved = mesh.with_vertices(vertices)
        depth = one(depth_at(moved, Field(field.color, values), camera, (0.999, 0.5), renderer))
        light = one(transmittance_at(moved, Field(field.color, values), camera, (0.0, 1.5, math.inf), renderer))
        assert depth.shape == (5, 7, 2) and light.shape == (5, 7, 3)
        assert bool(torch.isinf(depth).all()) and bool((light == 1.0).all())
        loss = torch.where(torch.isfinite(depth), depth, 0.0).sum() + (1.0 / depth).sum()
        for gradient in torch.autograd.grad(loss, (values, vertices)):
            assert not gradient.any()
        if density > 0.0:
            assert not torch.autograd.grad(light.sum(), values)[0].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("density", [1e9, 1e37, 3e38])
def test_the_surface_of_what_is_opaque(density: float, dtype: torch.dtype) -> None:
    mesh = TetMesh.grid((3, 3, 3), dtype=dtype)
    origins, direction = through(20, dtype)
    values = torch.full((mesh.num_vertices,), density, dtype=dtype, requires_grad=True)
    vertices = mesh.vertices.clone().requires_grad_()
    depth = one(
        depth_at(mesh.with_vertices(vertices), Field(values[:, None], values), Rays(origins, direction), (0.9, 1e-9))
    )
    assert torch.allclose(depth.detach(), torch.ones(20, 2, dtype=dtype), rtol=1e-6)
    by_vertices, by_values = torch.autograd.grad(depth.sum(), (vertices, values))
    # The surface is the mesh's side at z = 0, and moves with it.
    assert bool(torch.isfinite(by_values).all()) and float(by_values.abs().max()) < 1e-7
    if density < 1e38 or dtype == torch.float64:  # one over it is no normal number of float32, and taken as 0
        assert float(by_vertices[:, 2].sum()) == pytest.approx(40.0, rel=1e-4)
        assert float(by_vertices[mesh.vertices[:, 2] == 0.0, 2].sum()) == pytest.approx(40.0, rel=1e-4)
    light = one(transmittance_at(mesh, Field(values[:, None], values), Rays(origins, direction), (0.999, 1.5)))
    assert bool((light[:, 0] == 1.0).all()) and not light[:, 1].any()


def test_thin_cells() -> None:
    """Ninety-nine layers a millionth thick before one that holds the rest."""
    heights = torch.cat([torch.linspace(0.0, 1e-4, 100, dtype=torch.float64), torch.ones(1, dtype=torch.float64)])
    mesh = TetMesh.grid((1, 1, 100), dtype=torch.float64)
    layer = (100.0 * mesh.vertices[:, 2]).round().long()
    mesh = mesh.with_vertices(torch.cat([mesh.vertices[:, :2], heights[layer][:, None]], 1))
    for scale in (1.0, 1e4):
        field = constant(mesh, 2.0 * scale)
        origins, direction = through(9)
        for value in (0.99999, 0.9, 0.5):
            expected = 1.0 - math.log(value) / (2.0 * scale)
            depth = one(depth_at(mesh, field, Rays(origins, direction), value))
            assert torch.allclose(depth, torch.full_like(depth, expected), rtol=1e-12)


@pytest.mark.parametrize("renderer", RENDERERS[:2])
def test_rays_that_begin_or_end_inside(renderer: str) -> None:
    """Distances count from the origin, light from where the ray begins; behind its end it stays what it is there."""
    mesh = TetMesh.grid((3, 3, 3), dtype=torch.float64)
    field, (origins, direction) = constant(mesh, 2.0), through(6)
    rays = Rays(origins, direction, 1.25, 1.75)
    asked = torch.tensor([-math.inf, 0.5, 1.2, 1.5, 1.75, 3.0, math.inf], dtype=torch.float64)
    light = one(transmittance_at(mesh, field, rays, asked, renderer))
    expected = torch.exp(-2.0 * (asked.clamp(1.25, 1.75) - 1.25))
    assert torch.allclose(light, expected.expand(6, 7), rtol=1e-12)
    depth = one(depth_at(mesh, field, rays, (0.6, 0.3), renderer))
    assert torch.allclose(depth[:, 0], torch.tensor(1.25 - math.log(0.6) / 2.0, dtype=torch.float64), rtol=1e-12)
    assert bool(torch.isinf(depth[:, 1]).all())
    inside = Rays(origins + 1.5 * direction, direction)
    depth = one(depth_at(mesh, field, inside, 0.5, renderer))
    assert torch.allclose(depth, torch.full_like(depth, math.log(2.0) / 2.0), rtol=1e-12)
    # Lines are looked at from behind their origins.
    line = Rays(origins + 1.5 * direction, direction, -math.inf)
    depth = one(depth_at(mesh, field, line, 0.5, renderer))
    assert torch.allclose(depth, torch.full_like(depth, math.log(2.0) / 2.0 - 0.5), rtol=1e-12)
    light = one(transmittance_at(mesh, field, line, torch.tensor([-0.25, 0.0]), renderer))
    assert torch.allclose(light, torch.exp(torch.tensor([-0.5, -1.0], dtype=torch.float64)).expand(6, 2))


def test_gaps_between_parts_of_a_mesh() -> None:
    """Distances in a gap see what is before it, and nothing changes as they move."""
    parts = [TetMesh.grid((1, 1, 1), (0.0, 0.0, z), (1.0, 1.0, z + 1.0), dtype=torch.float64) for z in (0.0, 3.0)]
    mesh = TetMesh(torch.cat([p.vertices for p in parts]), torch.cat([parts[0].tets, parts[1].tets + 8]))
    field, (origins, direction) = constant(mesh, 1.0), through(4)
    distances = torch.tensor([2.5, 1.5, 4.5, 3.9], dtype=torch.float64, requires_grad=True)
    light = one(transmittance_at(mesh, field, Rays(origins, direction), distances))
    assert torch.allclose(light.detach(), torch.exp(-torch.tensor([1.0, 0.5, 1.5, 1.0]).double()).expand(4, 4))
    (gradient,) = torch.autograd.grad(light.sum(), distances)
    assert torch.allclose(gradient, -4.0 * torch.tensor([0.0, math.exp(-0.5), math.exp(-1.5), 0.0]).double())
    depth = one(depth_at(mesh, field, Rays(origins, direction), math.exp(-1.25)))
    assert torch.allclose(depth, torch.full_like(depth, 4.25))


@pytest.mark.parametrize("renderer", RENDERERS[:2])
def test_jumps_of_a_transfer_function(renderer: str) -> None:
    """The scalar is the height: nothing up to 1/2, then 4, found behind a piece without a length."""
    mesh = TetMesh.grid((2, 2, 3), dtype=torch.float64)
    function = TransferFunction([0.0, 0.5, 0.5, 1.0], [0.0, 0.0, 1.0, 1.0], torch.rand(4, 3))
    knots = torch.tensor([0.0, 0.5, 0.5, 1.0], dtype=torch.float64, requires_grad=True)
    function = TransferFunction(knots, torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64), function.color)
    field = ScalarField(mesh.vertices[:, 2].clone(), function, 4.0, (0.0, 1.0), "vertex")
    origins, direction = through(3)
    depth = one(depth_at(mesh, field, Rays(origins, direction), (0.5, 0.9), renderer))
    expected = 1.5 - torch.log(torch.tensor([0.5, 0.9], dtype=torch.float64)) / 4.0
    assert torch.allclose(depth.detach(), expected.expand(3, 2), rtol=1e-12)
    (gradient,) = torch.autograd.grad(depth.sum(), knots)
    # The later knot takes the surface up with it, half as far: what is between the knots then is half as dense.
    assert float(gradient[2]) == pytest.approx(6.0 * 0.5, rel=1e-9)
    light = one(transmittance_at(mesh, field, Rays(origins, direction), (1.5, 1.75), renderer))
    assert torch.allclose(light.detach(), torch.tensor([1.0, math.exp(-1.0)], dtype=torch.float64).expand(3, 2))


# ------------------------------------------------------------------------------------------------- shapes and mistakes


def test_one_number_adds_no_dimension() -> None:
    mesh = TetMesh.grid((2, 2, 2))
    field = constant(mesh, 3.0)
    for function, value in ((depth_at, 0.5), (transmittance_at, 2.0)):
        single = one(function(mesh, field, CAMERA, value))
        assert single.shape == (5, 7) and single.dtype == torch.float32
        several = one(function(mesh, field, CAMERA, torch.tensor([value, 0.7, value])))
        assert several.shape == (5, 7, 3)
        assert torch.equal(several[..., 0], single) and torch.equal(several[..., 2], single)
        each = one(function(mesh, field, CAMERA, torch.full((5, 7, 1), value)))
        assert torch.equal(each[..., 0], single)
        assert one(function(mesh, field, CAMERA, torch.zeros(0))).shape == (5, 7, 0)
        rays = CAMERA.rays()
        bundle = Rays(rays.origins[:, :0], rays.directions[:, :0])
        assert one(function(mesh, field, bundle, value)).shape == (5, 0)
        assert torch.allclose(one(function(mesh, field, rays, value)), single, atol=1e-5)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_several_cameras(renderer: str) -> None:
    mesh = TetMesh.grid((2, 2, 2))
    field, wide = constant(mesh, 3.0), CAMERA.with_size(9, 5)
    for function, value in ((depth_at, (0.5, 0.8)), (transmittance_at, (1.9, 2.0))):
        both = function(mesh, field, [CAMERA, CAMERA], value, renderer)
        single = one(function(mesh, field, CAMERA, value, renderer))
        assert one(both).shape == (2, 5, 7, 2)
        assert torch.allclose(one(both)[1], single, atol=1e-5)
        uneven = function(mesh, field, [CAMERA, wide], value, renderer)
        assert isinstance(uneven, tuple) and [part.shape for part in uneven] == [(5, 7, 2), (5, 9, 2)]
        assert torch.equal(uneven[0], single)


def test_features_of_cells_absorb_as_their_medium_does() -> None:
    mesh = TetMesh.grid((2, 2, 2))
    field = constant(mesh, 3.0)
    features = CellFeatures(torch.rand(mesh.num_cells, 2), field)
    assert torch.equal(one(depth_at(mesh, features, CAMERA)), one(depth_at(mesh, field, CAMERA)))


def test_far_origins_lose_nothing_in_float32() -> None:
    """Distances are given and found from the true origins; only the answer is rounded."""
    mesh = TetMesh.grid((3, 3, 3))
    field, (origins, direction) = constant(mesh, 2.0), through(8)
    far = Rays(origins - 1e6 * direction, direction)
    light = one(transmittance_at(mesh, field, far, torch.tensor([1e6 + 1.25, 1e6 + 1.5], dtype=torch.float64)))
    assert torch.allclose(light, torch.exp(torch.tensor([-0.5, -1.0])).expand(8, 2), atol=1e-6)
    assert torch.allclose(one(depth_at(mesh, field, far)), torch.tensor(1e6 + 1.0 + math.log(2.0) / 2.0))


@pytest.mark.parametrize(
    ("function", "value", "message"),
    [
        (depth_at, 1.0, "transmittance is 1.0; give values between 0 and 1"),
        (depth_at, (0.5, 0.0), r"transmittance is \(0.5, 0.0\)"),
        (depth_at, math.nan, "transmittance is nan"),
        (depth_at, "half", "transmittance is 'half'"),
        (transmittance_at, math.nan, "distances is nan"),
        (transmittance_at, torch.zeros(4, 7, 2), r"distances has shape \(4, 7, 2\) and the rays \(5, 7\)"),
        (transmittance_at, torch.zeros(1).expand(1 << 24), "ask for 268,435,456 at most at a time"),
    ],
)
def test_mistakes_get_one_sentence(function: Any, value: Any, message: str) -> None:
    mesh = TetMesh.grid((2, 2, 2))
    with pytest.raises(DiffTetError, match=message) as error:
        function(mesh, constant(mesh, 1.0), CAMERA, value)
    assert_sentence(error.value)


def test_wrong_fields_are_told_as_in_rendering() -> None:
    mesh = TetMesh.grid((2, 2, 2))
    for call in (depth_at, render):
        with pytest.raises(MeshError, match="density of vertex 0 is -1"):
            call(mesh, constant(mesh, -1.0), CAMERA)
        with pytest.raises(DiffTetError, match=r"mesh is 'grid'; pass a difftetvr.TetMesh"):
            call("grid", constant(mesh, 1.0), CAMERA)  # type: ignore[call-overload,arg-type]
