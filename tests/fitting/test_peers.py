"""The voxel grid that benchmarks/peers holds against the meshes: its images and gradients."""

import dataclasses
import math
import sys
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
import torch

import difftetvr as dtv

STEP = 0.5
BOUNDS = torch.tensor([[-0.5, -0.4, -0.3], [0.5, 0.4, 0.3]])


@pytest.fixture
def peers(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks" / "peers"))
    names = ("voxel_kernels", "voxel_learning", "voxel_grid", "voxel_rays", "voxel_fit")
    yield __import__("voxel_fit")
    for name in names:
        sys.modules.pop(name)


def capture_of(views: int = 3, size: int = 12) -> dtv.Capture:
    """Views of a red ball in front of nothing."""
    cameras, images, alphas = [], [], []
    for k in range(views):
        eye = (2.0 * math.cos(2.1 * k), 2.0 * math.sin(2.1 * k), 0.5)
        camera = dtv.Camera.look_at(eye, (0.0, 0.0, 0.0), fov_y=0.6, width=size, height=size)
        rays = camera.rays()
        along = -(rays.origins * rays.directions).sum(-1)
        miss = (rays.origins + along[..., None] * rays.directions).norm(dim=-1)
        alphas.append((miss < 0.25).float())
        images.append(alphas[-1][..., None] * torch.tensor([0.9, 0.2, 0.1]))
        cameras.append(camera)
    test = torch.arange(views) == views - 1
    return dtv.Capture(cameras, torch.stack(images), torch.stack(alphas), test, BOUNDS, "ball", encoding="srgb")


def fit_of(peers, degree: int = 2):
    """A fit whose vertices hold random values, negative densities and colours among them."""
    settings = peers.Settings(stages=((0.0, 8),), prunings=(), degree=degree, batch=64, varied=0.5)
    fit = peers.VoxelFit(capture_of(), settings)
    random = np.random.default_rng(3)
    rows = random.normal(0.0, 0.4, fit.grid.rows.shape).astype(np.float32)
    rows[:, fit.grid.lattice.density_place] = random.normal(1.0, 4.0, len(rows))
    fit.grid.rows.copy_(torch.from_numpy(rows))
    fit._use(fit.grid)
    return fit


def reference(grid, basis, rows, origin, direction, background):
    """Colour of one ray, step by step, in torch."""
    lattice = grid.lattice
    start = (origin - torch.tensor(lattice.lower)) / lattice.edge
    ends = torch.stack((-start / direction, (torch.tensor(lattice.size) - 1 - start) / direction))
    near, far = ends.amin(0).max().clamp_min(0.0), ends.amax(0).min()
    color, through = torch.zeros(3, dtype=torch.float64), torch.ones((), dtype=torch.float64)
    for k in range(max(0, math.ceil((far - near - 0.5 * STEP) / STEP))):
        place = start + (near + (k + 0.5) * STEP) * direction
        cell = place.floor().long().clamp_min(0)
        x, y, z = cell.tolist()
        if not grid.held[z, y, x] or through < 1e-4:
            continue
        value = torch.zeros(rows.shape[1], dtype=torch.float64)
        for corner in range(8):
            shift = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2])
            weight = torch.where(shift == 1, place - cell, 1 - place + cell).prod()
            i, j, m = (cell + shift).tolist()
            value = value + weight * rows[grid.row[m, j, i]]
        terms = len(basis)
        density = value[3 * terms].clamp_min(0.0)
        seen = torch.stack([(value[c * terms : (c + 1) * terms] * basis).sum() for c in range(3)])
        alpha = 1 - torch.exp(-density * STEP * lattice.edge)
        color = color + through * alpha * (0.5 + seen).clamp_min(0.0)
        through = through * (1 - alpha)
    return color + through * background


@pytest.fixture
def scene(peers):
    """A fit, the rays of one view, and their colours as the reference sees them, differentiable in rows."""
    fit, kernels = fit_of(peers), sys.modules["voxel_kernels"]
    rays = fit.capture.cameras[2].rays()
    origins, directions = (v.reshape(-1, 3)[40:104].double() for v in (rays.origins, rays.directions))
    rows = fit.current().rows.double().requires_grad_()
    white = torch.ones(3, dtype=torch.float64)
    pairs = zip(origins, directions)
    seen = torch.stack([reference(fit.grid, harmonics_of(kernels, d), rows, o, d, white) for o, d in pairs])
    return fit, origins, directions, rows, seen


def harmonics_of(kernels, direction):
    float_array = dr.scalar.ArrayXf64
    functions = kernels.harmonics([float_array(float(v)) for v in direction], 2)
    return torch.tensor([float(f[0]) for f in functions], dtype=torch.float64)


def test_images_are_those_of_a_march_step_by_step(scene):
    fit, _, _, _, seen = scene
    image = fit.image(2).reshape(-1, 3)[40:104].double()
    assert (image - 1.0).abs().max() > 0.2
    assert torch.allclose(image, seen.detach(), atol=2e-5)


def test_gradients_are_those_of_autograd(scene, peers):
    fit, origins, directions, rows, seen = scene
    kernels, learning, lattice = sys.modules["voxel_kernels"], sys.modules["voxel_learning"], fit.grid.lattice
    weights = torch.from_numpy(np.random.default_rng(5).normal(size=seen.shape))
    (seen * weights).sum().backward()
    columns = ([fit._floats(v.float()) for v in values.unbind(1)] for values in (origins, directions, weights))
    origin, direction, wanted = columns
    rays, white = kernels.Rays(origin, direction), [fit._floats(torch.ones(len(seen))) for _ in range(3)]
    samples, lane = fit._samples(rays)
    colors = kernels.color_samples(lattice, fit._rows, samples, direction, lane)
    adjoint = kernels.adjoint_of_samples(lattice, samples, colors, white, wanted)
    smoothing = dataclasses.replace(fit._smoothing(), color=0.0, density=0.0)
    length = fit.grid.rows.numel()
    found = learning.gradient_of(lattice, fit._rows, samples, direction, adjoint, lane, smoothing, length)
    found = torch.from_numpy(found.numpy()).reshape(rows.shape).double()
    scale = rows.grad.abs().amax(0).clamp_min(1e-12)
    assert bool((rows.grad != 0).any(0)[:-1].all() if rows.shape[1] > 28 else (rows.grad != 0).any(0).all())
    assert float(((found - rows.grad) / scale).abs().max()) < 1e-3


def test_total_variation_pulls_as_autograd_says(peers):
    fit = fit_of(peers, degree=0)
    learning, lattice, count = sys.modules["voxel_learning"], fit.grid.lattice, len(fit.grid.vertices)
    rows = fit.current().rows.double().requires_grad_()
    following = fit.grid.next_rows()
    along = torch.stack([rows[following[:, axis]] - rows for axis in range(3)])
    length = (along.square().sum(0) + 1e-9).sqrt().mean(0)
    (0.3 * length[:3].sum() + 0.7 * length[3]).backward()
    smoothing = dataclasses.replace(fit._smoothing(), color=0.3, density=0.7)
    smoothing.lane = fit._backend.lanes(count * lattice.width // 4)  # all vertices
    sums = dr.zeros(fit._backend.Float, fit.grid.rows.numel())
    learning.add_variation(lattice, fit._rows, smoothing, sums)
    found = torch.from_numpy(sums.numpy()).reshape(rows.shape).double()
    assert torch.allclose(found, rows.grad, atol=1e-7, rtol=1e-4)


def test_a_finer_grid_shows_the_same(peers):
    """Trilinear values are those of a grid twice as fine but for the cuts at 0, and the steps."""
    fit = fit_of(peers, degree=0)
    rows = fit.grid.rows
    rows[:, :3], rows[:, 3] = 0.5, rows[:, 3].abs()
    fit._use(fit.grid)
    before = fit.image(2)
    fit._use(
        sys.modules["voxel_grid"].refined(fit.current(), BOUNDS, 16, np.ones(int(fit.grid.held.sum()), dtype=bool))
    )
    assert len(fit.grid.vertices) > 4 * len(rows)
    assert (before - fit.image(2)).abs().max() < 0.1 < before.std()


def test_a_ball_is_found_and_what_nobody_sees_goes(peers):
    fit = peers.VoxelFit(capture_of(views=9, size=24), peers.Settings(stages=((0.0, 12), (0.4, 16)), batch=512))
    held = float(fit.grid.held.mean())
    before = fit.psnr([8])
    for k in range(60):
        if k == 40:
            fit.refine(16)
        fit.step(k / 60)
    assert fit.psnr([8]) > before + 6.0
    assert float(fit.grid.held.mean()) <= held
