"""The reference itself, held against closed forms, other quadrature, another way to find cells, and gradcheck."""

from __future__ import annotations

import math
from dataclasses import replace

import mpmath  # type: ignore[import-untyped]
import numpy as np
import pytest
import torch
from oracle.oracle import barycentric_functions, find_crossings, pixel_directions, quadrature, render_oracle
from oracle.scenes import (
    EXTREME_SCENES,
    SCENES,
    Scene,
    axis_camera,
    kuhn_grid,
    make_scene,
    random_camera,
    relative_error,
    scaled,
)
from scipy.special import dawsn, erfcx
from torch import Tensor

from difftetvr.rendering.cameras.pinhole import Camera


def camera_in_double(camera: Camera) -> Camera:
    return camera.with_pose(camera.world_to_camera.double())


def closed_form(length: float, s0: float, s1: float) -> tuple[float, float, float]:
    """Weights of the entry and exit colour, and the transmittance, by scaled error functions and Dawson's integral."""
    u, v = length * s0, 0.5 * length * (s1 - s0)
    transmittance = math.exp(-u - v)
    root = math.sqrt(abs(v))
    z0, z1 = 0.5 * u / root, 0.5 * (u + 2.0 * v) / root
    if v > 0:
        psi = 0.5 * math.sqrt(math.pi) * (erfcx(z0) - transmittance * erfcx(z1)) / root
    else:
        psi = (dawsn(z0) - transmittance * dawsn(z1)) / root
    return 1.0 - psi, psi - transmittance, transmittance


def box_chords(directions: Tensor, eye: Tensor, lower: float, upper: float) -> Tensor:
    """Length of each ray inside an axis-aligned cube, by slabs."""
    to_lower, to_upper = (lower - eye) / directions, (upper - eye) / directions
    t_in = torch.minimum(to_lower, to_upper).amax(-1).clamp(min=0.0)
    return (torch.maximum(to_lower, to_upper).amin(-1) - t_in).clamp(min=0.0)


@pytest.mark.parametrize("name", [*SCENES, *EXTREME_SCENES])
def test_scenes_are_valid_and_crossings_do_not_overlap(name: str) -> None:
    scene = (SCENES | EXTREME_SCENES)[name]()
    corners = scene.vertices.double()[scene.tets.long()]
    volumes = torch.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    assert bool((volumes.abs() > 0).all())
    assert len(torch.unique(scene.tets)) == len(scene.vertices)

    pose = scene.camera.world_to_camera.double()
    offset, slope = barycentric_functions((scene.vertices.double() @ pose[:3, :3].T + pose[:3, 3])[scene.tets.long()])
    directions = pixel_directions(scene.camera)
    found = find_crossings(offset, slope, directions)
    rate = (slope[found.cell] * directions[found.ray, None]).sum(-1)
    ends = -offset[found.cell] / rate
    t_in = ends.gather(1, found.enter[:, None]).squeeze(1).clamp(min=0.0)
    t_out = ends.gather(1, found.leave[:, None]).squeeze(1)
    same_ray = found.ray[1:] == found.ray[:-1]
    overlap = (t_out[:-1] - t_in[1:])[same_ray]
    assert overlap.numel() == 0 or float(overlap.max()) < 1e-10


def test_grids_of_cubes_fill_their_box_with_positive_cells() -> None:
    vertices, cells = kuhn_grid((3, 2, 4))
    corners = vertices[cells]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    np.testing.assert_allclose(volumes, 1.0 / (6 * 24), rtol=1e-12)


@pytest.mark.parametrize("density", [1e-6, 0.7, 60.0, 3000.0])
def test_constant_density_in_a_box(density: float) -> None:
    camera = random_camera(30, size=(20, 16))
    scene = make_scene(kuhn_grid((3, 2, 4)), camera)
    color = torch.tensor([0.2, 0.5, 0.9]).expand(len(scene.vertices), 3)
    scene = replace(scene, color=color, density=torch.full((len(scene.vertices),), density))
    image = scene.oracle()
    pose = camera.world_to_camera.double()
    world = pixel_directions(camera) @ pose[:3, :3]
    chord = box_chords(world, -pose[:3, :3].T @ pose[:3, 3], -0.5, 0.5)
    # The float32 pose is a rotation only to 1e-7.
    torch.testing.assert_close(image.alpha.ravel(), -torch.expm1(-density * chord), rtol=1e-5, atol=2e-6)
    torch.testing.assert_close(image.color, image.alpha[..., None] * color[0].double(), rtol=1e-12, atol=1e-13)


def test_expected_depth_in_a_box_of_constant_density() -> None:
    camera = axis_camera((0.0, 0.0, -2.0), 64.0, (1, 1), (0.5, 0.5))
    scene = make_scene(kuhn_grid((2, 2, 2)), camera)
    scene = replace(scene, density=torch.full((len(scene.vertices),), 3.0))
    image = scene.oracle(nudge=(1e-9, 2e-9))
    expected = 1.5 + 1.0 / 3.0 - math.exp(-3.0) / (1.0 - math.exp(-3.0))
    assert float(image.depth) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("density", [0.05, 2.0, 40.0, 900.0])
def test_one_cell_agrees_with_the_closed_form(density: float) -> None:
    """Positions, distances and weights by solving for the ray's hit with each of the four triangles."""
    scene = SCENES["single"]()
    scene = replace(scene, density=scene.density * (density / 3.0), background=None)
    image = scene.oracle()
    pose = scene.camera.world_to_camera.double()
    points = (scene.vertices.double() @ pose[:3, :3].T + pose[:3, 3]).numpy()
    values = torch.cat([scene.color, scene.density[:, None]], dim=-1).double().numpy()
    hits = 0
    for pixel, direction in enumerate(pixel_directions(scene.camera).numpy()):
        ends = []
        for face in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]):
            system = np.column_stack([points[face[1]] - points[face[0]], points[face[2]] - points[face[0]], -direction])
            a, b, t = np.linalg.solve(system, -points[face[0]])
            if a >= 0 and b >= 0 and a + b <= 1:
                ends.append((t, np.array([1 - a - b, a, b]) @ values[face]))
        if len(ends) != 2:
            assert float(image.alpha.ravel()[pixel]) == 0.0
            continue
        hits += 1
        (t0, q0), (t1, q1) = sorted(ends, key=lambda end: end[0])
        w0, w1, transmittance = closed_form(t1 - t0, q0[3], q1[3])
        np.testing.assert_allclose(image.color.reshape(-1, 3)[pixel], w0 * q0[:3] + w1 * q1[:3], rtol=0, atol=3e-9)
        assert float(image.alpha.ravel()[pixel]) == pytest.approx(1.0 - transmittance, abs=1e-12)
    assert hits > 50


@pytest.mark.parametrize("depth", [1e-4, 0.3, 7.9, 8.1, 50.0, 1e3, 1e6])
@pytest.mark.parametrize("ramp", ["constant", "rising", "falling", "steep"])
def test_quadrature_of_a_cell_is_exact_to_rounding(depth: float, ramp: str) -> None:
    s0, s1 = {"constant": (1.0, 1.0), "rising": (0.0, 2.0), "falling": (2.0, 0.0), "steep": (0.02, 1.98)}[ramp]
    u, v = mpmath.mpf(depth) * s0, mpmath.mpf(depth) * (s1 - s0) / 2
    with mpmath.workdps(40):
        breaks = [0] + [mpmath.mpf(2) ** -k for k in range(24, -1, -1)]
        exact = [
            mpmath.quad(lambda x, k=k: (x**k) * (u + 2 * v * x) * mpmath.exp(-u * x - v * x * x), breaks)
            for k in (0, 1)
        ]
    x, w = quadrature(depth)
    u, v = float(u), float(v)
    weights = w * (u + 2 * v * x) * torch.exp(-u * x - v * x * x)
    assert float(weights.sum()) == pytest.approx(float(exact[0]), abs=1e-13)
    assert float((weights * x).sum()) == pytest.approx(float(exact[1]), abs=1e-13)


@pytest.mark.parametrize("name", ["inside", "porous-cells", "components"])
def test_cells_of_a_ray_agree_with_locating_points(name: str) -> None:
    """A ray march that asks at every step which cell holds the point, on a few rays."""
    scene = SCENES[name]()
    image = scene.oracle()
    pose = scene.camera.world_to_camera.double()
    offset, slope = barycentric_functions((scene.vertices.double() @ pose[:3, :3].T + pose[:3, 3])[scene.tets.long()])
    values = torch.cat([scene.color, scene.density[:, None]], dim=-1).double()
    corners = values[:, None].expand(-1, 4, -1) if scene.per_cell else values[scene.tets.long()]
    steps, far = 2000, 2.4
    t = (torch.arange(steps, dtype=torch.float64) + 0.5) * (far / steps)
    background = torch.zeros(3) if scene.background is None else scene.background
    alpha = image.alpha.ravel()
    for pixel in [*torch.linspace(0, len(alpha) - 1, 6).long().tolist(), int(alpha.argmax())]:
        points = t[:, None] * pixel_directions(scene.camera)[pixel]
        weights = offset + torch.einsum("nj,tkj->ntk", points, slope)
        inside, cell = weights.amin(-1).max(dim=1)
        sample = (weights[torch.arange(steps), cell][..., None] * corners[cell]).sum(1) * (inside >= 0)[:, None]
        depth = sample[:, 3] * (far / steps)
        before = depth.cumsum(0) - depth
        emitted = (torch.exp(-before) * -torch.expm1(-depth))[:, None] * sample[:, :3]
        color = emitted.sum(0) + torch.exp(-depth.sum()) * background
        torch.testing.assert_close(color, image.color.reshape(-1, 3)[pixel], rtol=0, atol=5e-3)
        torch.testing.assert_close(1.0 - torch.exp(-depth.sum()), alpha[pixel], rtol=0, atol=5e-3)


def test_the_picture_knows_no_unit_of_length_and_no_order_of_cells() -> None:
    scene = SCENES["porous"]()
    reference = scene.oracle()
    # Powers of two scale float32 values without rounding.
    moved = scaled(scene, 2.0**-10).oracle()
    torch.testing.assert_close(moved.color, reference.color, rtol=0, atol=1e-12)
    torch.testing.assert_close(moved.depth * 2.0**10, reference.depth, rtol=0, atol=1e-11)
    order = torch.randperm(len(scene.tets), generator=torch.Generator().manual_seed(0))
    shuffled = replace(scene, tets=scene.tets[order][:, [2, 0, 3, 1]]).oracle()
    torch.testing.assert_close(shuffled.color, reference.color, rtol=0, atol=1e-12)
    assert torch.equal(shuffled.crossings, reference.crossings)


def _small(name: str) -> Scene:
    scene = SCENES[name]()
    camera = camera_in_double(scene.camera.with_size(5, 4))
    return replace(scene, camera=camera, background=torch.rand(3, generator=torch.Generator().manual_seed(0)))


@pytest.mark.parametrize("name", ["single", "delaunay", "in-hole", "inside-cells"])
def test_gradients_of_the_reference_agree_with_differences(name: str) -> None:
    scene = _small(name)
    weights = torch.Generator().manual_seed(1)
    w_color, w_alpha, w_depth = (
        torch.rand(shape, generator=weights, dtype=torch.float64) for shape in ((4, 5, 3), (4, 5), (4, 5))
    )

    def loss(vertices: Tensor, color: Tensor, density: Tensor, pose: Tensor, background: Tensor) -> Tensor:
        camera = scene.camera.with_pose(pose)
        image = render_oracle(vertices, scene.tets, color, density, camera, background, scene.per_cell)
        return (image.color * w_color).sum() + (image.alpha * w_alpha).sum() + (image.depth * w_depth).sum()

    leaves = [scene.vertices, scene.color, scene.density, scene.camera.world_to_camera, scene.background]
    inputs = [leaf.double().clone().requires_grad_() for leaf in leaves if leaf is not None]
    gradients = torch.autograd.grad(loss(*inputs), inputs)
    generator = torch.Generator().manual_seed(2)
    for k, gradient in enumerate(gradients):
        direction = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        if k == 3:
            direction[3] = 0.0
        h = 1e-7
        both = [
            float(loss(*[x.detach() + s * h * direction if i == k else x.detach() for i, x in enumerate(inputs)]))
            for s in (1.0, -1.0)
        ]
        numeric = (both[0] - both[1]) / (2 * h)
        assert float((gradient * direction).sum()) == pytest.approx(numeric, rel=2e-5, abs=1e-7)


def test_errors_of_comparisons_notice_what_is_not_finite() -> None:
    assert relative_error(torch.tensor([math.nan, 1.0]), torch.tensor([1.0, 1.0])) == math.inf
