"""Bundles at the ends of their ranges: no rays, directions of any length, rays without a beginning."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from difftetvr.errors import CameraError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Rays, render, transmittance_at


def scene(channels: int = 3) -> tuple[TetMesh, Field]:
    generator = torch.Generator().manual_seed(5)
    mesh = TetMesh.grid((4, 4, 4), dtype=torch.float64)
    color, density = (torch.rand(mesh.num_vertices, count, generator=generator).double() for count in (channels, 1))
    return mesh, Field(color, 4.0 * density[:, 0])


def random_rays(count: int) -> tuple[Tensor, Tensor]:
    """Origins, half of them inside the unit cube, and directions towards points inside it."""
    generator = torch.Generator().manual_seed(count)
    origins, targets = (torch.rand(count, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    origins[: count // 2] = 4.0 * origins[: count // 2] - 1.5
    return origins, targets - origins


@pytest.mark.parametrize("renderer", ["marching", "linked-list"])
def test_no_rays_have_derivatives_of_zero(renderer: str) -> None:
    mesh, field = scene(channels=2)
    leaves = [part.detach().clone().requires_grad_() for part in (mesh.vertices, field.color, field.density)]
    origins = torch.zeros(0, 3).requires_grad_()
    rays = Rays(origins, torch.zeros(0, 3))
    mesh, field = mesh.with_vertices(leaves[0]), type(field)(leaves[1], leaves[2])
    image = render(mesh, field, rays, renderer=renderer)
    (image.color.sum() + image.depth.sum() + transmittance_at(mesh, field, rays, 1.0).sum()).backward()
    assert all(leaf.grad is not None and not leaf.grad.any() for leaf in leaves)
    assert origins.grad is not None and origins.grad.shape == (0, 3)


@pytest.mark.parametrize("length", [1e-300, 1e-200, 1e-30, 1e30, 1e200, 1e300])
def test_directions_of_any_length_mean_the_same(length: float) -> None:
    mesh, field = scene()
    origins, directions = random_rays(20)
    directions = directions.double() / directions.double().abs().amax(-1, keepdim=True)
    expected, found = (render(mesh, field, Rays(origins.double(), scale * directions)) for scale in (1.0, length))
    assert float(expected.alpha.max()) > 0.1
    torch.testing.assert_close(found.alpha, expected.alpha)
    at, expected_at = (Rays(origins.double(), scale * directions).at(2.0) for scale in (length, 1.0))
    torch.testing.assert_close(at, expected_at)


@pytest.mark.parametrize("least", [torch.tensor(2.0**-149), torch.tensor(2.0**-1074, dtype=torch.float64)])
def test_directions_of_denormal_numbers_mean_the_same(least: Tensor) -> None:
    """Kernels take such numbers for 0."""
    mesh, field = scene()
    origins, directions = random_rays(20)
    directions = torch.round(1000.0 * directions).to(least.dtype)
    expected, found = (render(mesh, field, Rays(origins, scale * directions)) for scale in (1.0, least))
    assert float(expected.alpha.max()) > 0.1
    torch.testing.assert_close(found.alpha, expected.alpha)
    # The greatest component is none of them, others are.
    mixed = torch.tensor([[1000.0, -999.0, 500.0]], dtype=least.dtype)
    scale = torch.finfo(least.dtype).tiny / 999.5
    expected, found = (render(mesh, field, Rays([0.1, 0.9, 0.2], mixed * factor)) for factor in (1.0, scale))
    torch.testing.assert_close(found.alpha, expected.alpha)


@pytest.mark.parametrize("unit", [2.0**-1000, 2.0**-530, 2.0**530, 2.0**1000])
def test_rays_begin_inside_meshes_of_any_size(unit: float) -> None:
    """The square of a mesh's size need not be a number."""
    mesh, field = scene()
    # All of them look to the middle, from inside of the mesh.
    origins, directions = 0.55 + 0.4 * random_rays(20)[0][10:], torch.tensor([-1.0, -0.7, -0.9]).double()
    expected = render(mesh, field, Rays(origins, directions))
    scaled, thinned = mesh.with_vertices(unit * mesh.vertices), Field(field.color, field.density / unit)
    torch.testing.assert_close(render(scaled, thinned, Rays(unit * origins, directions)).alpha, expected.alpha)


def test_what_is_one_in_memory_has_derivatives_of_each_ray() -> None:
    mesh, field = scene()
    _, directions = random_rays(12)
    parts = torch.tensor([0.4, 0.3, 0.6]).double(), torch.tensor(0.05).double(), torch.tensor(0.4).double()
    weights = torch.linspace(1.0, 2.0, 12).double()

    def derivatives(is_one: bool) -> tuple[Tensor, ...]:
        rows = [part.expand(12, *part.shape) for part in parts]
        leaves = [(row if is_one else row.contiguous()).detach().requires_grad_() for row in rows]
        rays = Rays(leaves[0], directions, leaves[1], leaves[2])
        return torch.autograd.grad((weights * render(mesh, field, rays).optical_depth).sum(), leaves)

    for found, expected in zip(derivatives(True), derivatives(False), strict=True):
        assert bool(expected.any())
        torch.testing.assert_close(found, expected)


@pytest.mark.filterwarnings("error")
def test_rays_from_infinitely_far_away_end_where_they_are_told_to() -> None:
    mesh, field = scene()
    origins, directions = random_rays(30)
    half = Rays(origins, directions, -math.inf, 2.0)
    image, far = render(mesh, field, half), render(mesh, field, Rays(origins, directions, -50.0, 2.0))
    torch.testing.assert_close(image.alpha, far.alpha)
    for ends in ((math.inf, math.inf), (-math.inf, -math.inf)):
        with pytest.raises(CameraError, match="infinitely far away on one side"):
            Rays(origins, directions, *ends)


@pytest.mark.parametrize("renderer", ["marching", "linked-list"])
def test_a_ray_that_begins_on_the_boundary_is_not_lost(renderer: str) -> None:
    """Where that point, told by its distance along the ray, is rounded out of the mesh's box."""
    mesh, field = scene()
    directions = torch.tensor([[1000.0, -999.0, 500.0]], dtype=torch.float64)
    for step in range(40):
        ray = Rays([0.0, 1.0, 0.2], directions * (1e-3 + 1e-5 * step))
        assert float(render(mesh, field, ray, renderer=renderer).alpha) == pytest.approx(0.9654, abs=1e-3), step
