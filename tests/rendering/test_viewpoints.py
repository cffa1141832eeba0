"""Colours that depend on the direction, seen along bundles of rays, and their derivatives."""

from __future__ import annotations

import pytest
import torch
from rendering.bundles import INSIDE, OUTSIDE, assert_same, random_rays, scene

import difftetvr as dtv
from difftetvr.errors import DiffTetError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, Rays, RenderedImage, render


def test_colours_that_depend_on_the_direction() -> None:
    mesh, field = scene()
    harmonics = torch.randn(mesh.num_vertices, 8, 3, dtype=torch.float64)
    seen = Field(field.color, field.density, harmonics=harmonics)
    assert_same(render(mesh, seen, OUTSIDE.rays()), render(mesh, seen, OUTSIDE), 2e-6)
    both = render(mesh, seen, [OUTSIDE, INSIDE])
    assert isinstance(both, RenderedImage)
    assert_same(both[1], render(mesh, seen, INSIDE), 2e-6)
    with pytest.raises(DiffTetError, match="start at 1,025 points"):
        render(mesh, seen, Rays(*random_rays(1025)))
    with pytest.raises(DiffTetError, match="start at one point"):
        dtv.rendering.gauss_newton.model_image(mesh, seen, Rays(*random_rays(8)), torch.ones(8, 3), torch.ones(8, 3))


def test_rays_of_several_cameras_mixed_see_what_each_camera_sees() -> None:
    """Also where harmonics give each point of view its own colours; with their derivatives."""
    mesh, field = scene()
    harmonics = torch.randn(mesh.num_vertices, 8, 3, dtype=torch.float64).requires_grad_()
    seen = Field(field.color, field.density, harmonics=harmonics)
    views = [OUTSIDE, INSIDE, Camera.look_at((-2.0, 0.3, 1.2), (0.5, 0.5, 0.5), width=9, height=8)]
    both = Rays.joined([camera.rays() for camera in views])
    shuffle = torch.randperm(both.shape[0])[: both.shape[0] // 4 * 4].reshape(-1, 4)
    mixed = Rays(both.origins[shuffle], both.directions[shuffle])
    expected = torch.cat([render(mesh, seen, camera.rays()).color.reshape(-1, 3) for camera in views])[shuffle]
    found = render(mesh, seen, mixed).color
    assert found.shape == (*shuffle.shape, 3)
    torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-9)
    weight = torch.randn_like(found)
    (one,) = torch.autograd.grad((found * weight).sum(), harmonics)
    (other,) = torch.autograd.grad((expected * weight).sum(), harmonics)
    torch.testing.assert_close(one, other, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("is_parallel", [False, True])
def test_each_ray_has_its_own_derivative_by_what_colours_depend_on(is_parallel: bool) -> None:
    """Rays that start at one point, or go in one direction, by moving one of them alone."""
    mesh, field = scene()
    generator = torch.Generator().manual_seed(3)
    harmonics = 0.1 * torch.randn(mesh.num_vertices, 8, 3, dtype=torch.float64, generator=generator)
    seen = Field(field.color + 1.0, field.density, harmonics=harmonics)
    origins = torch.tensor([[1.7, 1.4, 1.1]], dtype=torch.float64).repeat(4, 1)
    directions = 0.5 - origins + 0.2 * torch.rand(4, 3, dtype=torch.float64, generator=generator)
    if is_parallel:
        origins, directions = origins + 0.3 * (directions - directions[:1]), directions[:1].repeat(4, 1)
    leaves = [origins.requires_grad_(), directions.requires_grad_()]
    weight = torch.randn(4, 3, dtype=torch.float64, generator=generator)
    loss = lambda o, d: (render(mesh, seen, Rays(o, d)).color * weight).sum()  # noqa: E731
    gradients = torch.autograd.grad(loss(*leaves), leaves)
    step = 1e-5
    for k, gradient in enumerate(gradients):
        assert bool((gradient.abs() > 1e-3).any())
        for row, axis in ((0, 0), (1, 2), (3, 1)):
            ends = []
            for sign in (1.0, -1.0):
                moved = [leaf.detach().clone() for leaf in leaves]
                moved[k][row, axis] += sign * step
                # A single ray is one that starts at one point, but has colours of its direction here.
                rays = Rays(moved[0][row], moved[1][row])
                eye, way = rays.origins, rays.directions
                medium = seen.seen_along(way) if is_parallel else seen.seen_from(mesh, eye)
                ends.append(float((render(mesh, medium, rays).color * weight[row]).sum()))
            expected = (ends[0] - ends[1]) / (2.0 * step)
            assert float(gradient[row, axis]) == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_parallel_rays_see_colours_of_their_direction() -> None:
    """As a pinhole camera does from very far away."""
    mesh, field = scene()
    harmonics = torch.randn(mesh.num_vertices, 8, 3, dtype=torch.float64)
    seen = Field(field.color, field.density, harmonics=harmonics)
    camera = dtv.ParallelCamera.look_at((3.0, 2.0, 1.5), (0.5, 0.5, 0.5), extent=1.5, width=9, height=7)
    rays, away = camera.rays(), 1e7
    eye = rays.origins.mean((0, 1)) - away * rays.directions[0, 0]
    far = Rays(eye, rays.origins + rays.directions - eye)
    torch.testing.assert_close(render(mesh, seen, camera).color, render(mesh, seen, far).color, rtol=0.0, atol=1e-4)


def test_a_lone_ray_among_parallel_ones_has_colours_of_its_direction() -> None:
    mesh, field = scene()
    harmonics = torch.randn(mesh.num_vertices, 8, 3, dtype=torch.float64)
    seen = Field(field.color, field.density, harmonics=harmonics)
    ways = torch.tensor([[0.1, 0.2, -1.0], [-1.0, 0.3, 0.2]], dtype=torch.float64)
    directions = ways[[0, 0, 0, 1]]
    through = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    found = render(mesh, seen, Rays(through - 2.0 * directions, directions))
    lone = render(mesh, seen.seen_along(ways[1]), Rays(through[3] - 2.0 * ways[1], ways[1]))
    assert float(lone.alpha) > 0.1
    torch.testing.assert_close(found.color[3], lone.color)


def test_a_lens_sees_colours_that_depend_on_the_direction() -> None:
    mesh, field = scene()
    harmonics = torch.randn(mesh.num_vertices, 8, 3, dtype=torch.float64)
    seen = Field(field.color, field.density, harmonics=harmonics)
    pose = INSIDE.world_to_camera.clone().requires_grad_()
    lens = dtv.LensCamera(pose, 15.0, 15.0, 11.5, 9.5, 23, 19, coefficients=[-0.2, 0.05])
    expected = render(mesh, seen.seen_from(mesh, INSIDE.position), lens)
    assert torch.allclose(render(mesh, seen, lens).color, expected.color, rtol=0.0, atol=1e-9)
    shift = torch.tensor([4.2e5, 5.4e6, 300.0], dtype=torch.float64)
    far = TetMesh(mesh.vertices + shift, mesh.tets).to(dtype=torch.float32)
    moved = pose.detach().clone()
    moved[:3, 3] -= moved[:3, :3] @ shift
    image = render(far, seen.to(dtype=torch.float32), lens.with_pose(moved))
    assert float((image.color - expected.color.detach()).abs().max()) < 5e-5
    (gradient,) = torch.autograd.grad(render(mesh, seen, lens).color.sum(), pose)
    assert float(gradient[:3].abs().max()) > 0.0
