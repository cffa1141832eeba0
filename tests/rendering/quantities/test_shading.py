"""Gradient shading: which way what is seen faces to the light, and its derivatives."""

import numpy as np
import pytest
import torch

import difftetvr as dtv
from difftetvr.errors import DiffTetError

CAMERA = dtv.Camera.look_at((0.4, -2.0, 0.7), (0.5, 0.5, 0.5), width=3, height=3, fov_y=0.4)


def medium(mesh, scalar, location="vertex"):
    function = dtv.TransferFunction([0.0, 1.0], [0.3, 0.9], [[1, 0, 0], [0, 1, 0]])
    return dtv.ScalarField(scalar, function, 2.0, (-3.0, 3.0), location)


def test_a_linear_scalar_has_one_shade():
    """Lambert's, of both sides, of the angle between gradient and light; whatever the transfer function."""
    mesh = dtv.TetMesh.grid((3, 3, 3), dtype=torch.float64)
    normal, light = torch.tensor([0.6, 0.0, 0.8]).double(), (1.0, 2.0, -2.0)
    scalar = mesh.vertices @ normal
    for sign in (1.0, -1.0):
        shade = dtv.render_shading(mesh, medium(mesh, sign * scalar), CAMERA, light, 0.2)
        cosine = abs(float(normal @ torch.tensor(light).double())) / 3.0
        assert torch.allclose(shade, torch.full_like(shade, 0.2 + 0.8 * cosine), atol=1e-12)
    field = dtv.Field(torch.ones(mesh.num_vertices, 3).double(), scalar + 1.0)
    assert torch.allclose(dtv.render_shading(mesh, field, CAMERA, light, 0.2), shade, atol=1e-12)


def test_cells_that_are_constant_are_shaded_by_their_neighbours():
    mesh = dtv.TetMesh.grid((6, 6, 6), dtype=torch.float64)
    heights = mesh.vertices[mesh.tets.long()].mean(1)[:, 2]
    shade = dtv.render_shading(mesh, medium(mesh, heights, "cell"), CAMERA, (0.0, 0.0, 1.0), 0.0)
    assert float(shade.min()) > 0.95


def test_where_nothing_changes_or_nothing_is_seen_nothing_is_darkened():
    mesh = dtv.TetMesh.grid((2, 2, 2))
    flat = medium(mesh, torch.ones(mesh.num_vertices))
    assert torch.allclose(dtv.render_shading(mesh, flat, CAMERA, (1.0, 0.0, 0.0)), torch.ones(3, 3))
    away = dtv.Camera.look_at((0.5, -2.0, 0.5), (0.5, -9.0, 0.5), width=2, height=2)
    assert torch.equal(
        dtv.render_shading(mesh, medium(mesh, mesh.vertices[:, 0]), away, (1.0, 0.0, 0.0)), torch.ones(2, 2)
    )


def test_several_cameras():
    mesh = dtv.TetMesh.grid((2, 2, 2), dtype=torch.float64)
    lit = medium(mesh, mesh.vertices[:, 0] ** 2)
    cameras = [CAMERA, dtv.Camera.look_at((2.0, 0.3, 0.7), (0.5, 0.5, 0.5), width=3, height=3)]
    alone = [dtv.render_shading(mesh, lit, camera, (1.0, 0.4, 0.0)) for camera in cameras]
    assert torch.allclose(dtv.render_shading(mesh, lit, cameras, (1.0, 0.4, 0.0)), torch.stack(alone), atol=1e-7)
    large, small = dtv.render_shading(mesh, lit, [CAMERA, CAMERA.with_size(3, 2)], (1.0, 0.4, 0.0))
    assert torch.allclose(large, alone[0], atol=1e-7) and small.shape == (2, 3)


def test_the_unit_of_length_and_of_the_scalar_do_not_matter():
    shades = []
    for factor, steep in ((1.0, 1.0), (2.0**70, 2.0**-300)):
        mesh = dtv.TetMesh.grid((3, 3, 3), dtype=torch.float64)
        scalar = (mesh.vertices**2).sum(1) * steep
        function = dtv.TransferFunction([0.0, 1.0], [0.3, 0.9], [[1, 0, 0], [0, 1, 0]])
        field = dtv.ScalarField(scalar, function, 2.0 / factor)
        camera = dtv.Camera.look_at([factor * v for v in (0.4, -2.0, 0.7)], [0.5 * factor] * 3, width=3, height=3)
        shades.append(dtv.render_shading(mesh.with_vertices(factor * mesh.vertices), field, camera, (1.0, 0.5, 0.2)))
    assert torch.allclose(*shades, atol=1e-9) and float(shades[0].std()) > 0.001


@pytest.mark.parametrize("kind", ["scalar", "density", "cell"])
def test_shades_are_differentiable_in_the_field_the_vertices_and_the_light(kind):
    generator = np.random.default_rng(3)
    grid = dtv.TetMesh.grid((1, 1, 1), dtype=torch.float64)
    places = grid.vertices + torch.from_numpy(generator.normal(0.0, 0.05, (8, 3)))
    count = grid.num_cells if kind == "cell" else 8
    values = torch.from_numpy(generator.uniform(0.5, 2.0, count))

    def shade(values, vertices, light):
        mesh = grid.with_vertices(vertices)
        if kind == "density":
            return dtv.render_shading(mesh, dtv.Field(torch.ones(8, 3).double(), values), CAMERA, light)
        return dtv.render_shading(mesh, medium(mesh, values, "cell" if kind == "cell" else "vertex"), CAMERA, light)

    leaves = [v.clone().requires_grad_() for v in (values, places, torch.tensor([0.3, -0.9, 0.5]).double())]
    assert torch.autograd.gradcheck(shade, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, nondet_tol=1e-12)


def test_lights_that_are_none_are_told():
    mesh = dtv.TetMesh.grid((1, 1, 1))
    field = medium(mesh, mesh.vertices[:, 0])
    for light in ((0.0, 0.0, 0.0), (1.0, 2.0), (float("nan"), 0.0, 1.0)):
        with pytest.raises(DiffTetError, match="light is"):
            dtv.render_shading(mesh, field, CAMERA, light)
    with pytest.raises(DiffTetError, match="ambient is 2"):
        dtv.render_shading(mesh, field, CAMERA, (0.0, 0.0, 1.0), ambient=2.0)
