"""The entropy of an image's opacity, against arbitrary precision."""

from __future__ import annotations

import math

import mpmath  # type: ignore[import-untyped]
import pytest
import torch

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, RenderedImage, render

DEPTHS = [1e-30, 1e-12, 1e-5, 0.1, 0.69, math.log(2.0), 0.7, 2.0, 20.0, 60.0, 80.0]


def image_of(optical_depth: torch.Tensor) -> RenderedImage:
    zeros = torch.zeros_like(optical_depth)
    return RenderedImage(zeros[..., None], -torch.expm1(-optical_depth), zeros, optical_depth)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_values_and_derivatives_are_accurate_near_both_ends(dtype: torch.dtype, tolerance: float) -> None:
    depths = torch.tensor(DEPTHS, dtype=dtype, requires_grad=True)
    entropy = image_of(depths).entropy
    (gradient,) = torch.autograd.grad(entropy.sum(), depths)
    with mpmath.workdps(60):
        for found, slope, depth in zip(entropy.tolist(), gradient.tolist(), depths.tolist(), strict=True):
            opacity = -mpmath.expm1(-mpmath.mpf(depth))
            exact = -opacity * mpmath.log(opacity) + mpmath.mpf(depth) * (1 - opacity)
            assert found == pytest.approx(float(exact), rel=tolerance)
            by_depth = (1 - opacity) * (-mpmath.log(opacity) - mpmath.mpf(depth))
            assert slope == pytest.approx(float(by_depth), rel=10 * tolerance, abs=10 * tolerance * math.exp(-depth))


def test_clear_and_opaque_rays_have_none() -> None:
    for dtype in (torch.float32, torch.float64):
        depths = torch.tensor([0.0, 1e3, 1e30, math.inf], dtype=dtype, requires_grad=True)
        entropy = image_of(depths).entropy
        (gradient,) = torch.autograd.grad(entropy.sum(), depths)
        assert not entropy.detach().any() and not gradient.any()


def test_it_is_differentiable_in_all_that_an_image_is() -> None:
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    camera = Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5), fov_y=0.4, width=4, height=3)
    density = 3.0 * torch.rand(mesh.num_vertices, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def entropy(vertices: torch.Tensor, density: torch.Tensor) -> torch.Tensor:
        return render(mesh.with_vertices(vertices), Field(density[:, None], density), camera).entropy

    leaves = [part.clone().requires_grad_() for part in (mesh.vertices, density)]
    assert entropy(*leaves).shape == (3, 4)
    assert 0.0 < float(entropy(*leaves).detach().max()) <= math.log(2.0)
    assert torch.autograd.gradcheck(entropy, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, nondet_tol=1e-12, fast_mode=True)
