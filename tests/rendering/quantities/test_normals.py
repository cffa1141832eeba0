"""Expected normals: the reference's values and derivatives, closed forms, and fields that face nowhere."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from oracle.oracle import barycentric_functions, render_oracle
from oracle.scenes import SCENES, relative_error, total_error
from rendering.helpers import assert_sentence, in_double
from torch import Tensor

from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, CellFeatures, Rays, ScalarField, depth_at, render, render_normals
from difftetvr.rendering.quantities.normals import cell_normals
from difftetvr.sampling import isosurface

RENDERERS = ("marching", "linked-list", "projected")
CAMERA = Camera.look_at((0.4, -1.7, 0.6), (0.5, 0.5, 0.5), fov_y=0.9, width=7, height=5)


def densities(values: Tensor) -> Field:
    return Field(values.new_zeros(len(values), 3), values)


def one(found: Any) -> Tensor:
    assert isinstance(found, Tensor)
    return found


def normals_oracle(vertices: Tensor, tets: Tensor, values: Tensor) -> Tensor:
    """(T, 3) minus the gradients, by barycentric coordinates, over their lengths."""
    _, slope = barycentric_functions(vertices[tets.long()])
    gradient = (slope * values[tets.long()][..., None]).sum(1)
    return -gradient / gradient.norm(dim=1, keepdim=True)


@pytest.mark.filterwarnings("ignore::difftetvr.rendering.OrderWarning")
@pytest.mark.parametrize(
    ("name", "renderer"),
    [("delaunay", "marching"), ("porous", "marching"), ("inside", "linked-list"), ("delaunay", "projected")],
)
def test_values_and_derivatives_are_those_of_the_reference(name: str, renderer: str) -> None:
    scene = SCENES[name]()
    camera = in_double(scene.camera.with_size(12, 9))
    leaves = [scene.vertices.double(), scene.density.double(), camera.world_to_camera]
    vertices, density, pose = leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    mesh, camera = TetMesh(vertices, scene.tets), camera.with_pose(pose)
    found = one(render_normals(mesh, densities(density), camera, renderer))
    normals = normals_oracle(vertices, scene.tets, density)
    truth = render_oracle(vertices, scene.tets, normals, density, camera, color_per_cell=True).color
    assert found.shape == (9, 12, 3)
    assert total_error(found.detach(), truth.detach()) < 1e-9
    weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ours, theirs = (torch.autograd.grad((weights * image).sum(), leaves) for image in (found, truth))
    for single, other in zip(ours, theirs, strict=True):
        assert relative_error(single, other) < 1e-6


@pytest.mark.parametrize("content", ["density", "scalar"])
def test_derivatives_by_finite_differences(content: str) -> None:
    """By positions, which also turn the normals, by values, and by rays."""
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    values = torch.rand(mesh.num_vertices, generator=generator, dtype=torch.float64)
    origins = torch.rand(6, 3, generator=generator, dtype=torch.float64) - torch.tensor([1.5, 0.0, 0.0])
    directions = 0.3 + 0.4 * torch.rand(6, 3, generator=generator, dtype=torch.float64) - origins
    function = TransferFunction([0.0, 0.5, 1.0], [0.9, 0.2, 0.6], torch.rand(3, 3))

    def image(vertices: Tensor, values: Tensor, origins: Tensor, directions: Tensor) -> Tensor:
        field = densities(5.0 * values) if content == "density" else ScalarField(values, function, 6.0, (0.0, 1.0))
        return one(render_normals(mesh.with_vertices(vertices), field, Rays(origins, directions)))

    leaves = [part.clone().requires_grad_() for part in (mesh.vertices, values, origins, directions)]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, nondet_tol=1e-12, fast_mode=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_ramp_faces_down_its_slope(dtype: torch.dtype) -> None:
    """Whatever the units are."""
    slope = torch.tensor([1.0, -2.0, 0.5], dtype=dtype)
    expected = -slope / slope.norm()
    for length, unit in ((1.0, 1.0), (1e-12, 1e25), (1e12, 1e-25)):
        mesh = TetMesh.grid((3, 3, 3), dtype=dtype)
        mesh = mesh.with_vertices(mesh.vertices * length)
        values = unit * ((mesh.vertices / length * slope).sum(1) + 3.0)
        assert torch.allclose(cell_normals(mesh, values).to(dtype), expected, atol=1e-5)
    mesh = TetMesh.grid((3, 3, 3), dtype=dtype)
    field = densities((mesh.vertices * slope).sum(1) + 3.0)
    found, alpha = one(render_normals(mesh, field, CAMERA)), render(mesh, field, CAMERA).alpha
    assert found.dtype == dtype and float(alpha.max()) > 0.9
    assert torch.allclose(found, alpha[..., None] * expected, atol=2e-6)


def test_a_ball_faces_outwards_where_it_is_seen() -> None:
    mesh = TetMesh.grid((16, 16, 16), dtype=torch.float64)
    center, eye = torch.tensor([[0.52, 0.48, 0.5], [0.5, -2.0, 0.5]], dtype=torch.float64)
    field = densities(300.0 * torch.exp(-((mesh.vertices - center) ** 2).sum(1) / 0.02))
    spread = 0.08 * torch.randn(200, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    rays = Rays(eye, center + spread - eye)
    depth = one(depth_at(mesh, field, rays))
    seen = torch.isfinite(depth)
    outwards = torch.nn.functional.normalize(rays.at(depth)[seen] - center, dim=1)
    found = torch.nn.functional.normalize(one(render_normals(mesh, field, rays))[seen], dim=1)
    similarity = (found * outwards).sum(1)
    assert int(seen.sum()) > 100
    assert float(similarity.mean()) > 0.98 and float(similarity.min()) > 0.9


def test_scalars_face_as_isosurfaces_do() -> None:
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    scalar = mesh.vertices[:, 1] + 0.1 * mesh.vertices[:, 0]
    field = ScalarField(scalar, TransferFunction([0.0, 1.0], [1.0, 1.0], torch.rand(2, 3)), 50.0, location="vertex")
    found = one(render_normals(mesh, field, CAMERA))[2, 3]
    vertices, triangles = isosurface(mesh, scalar, 0.5)
    a, b, c = vertices[triangles[0]]
    surface = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=0)
    assert torch.allclose(found, surface, atol=1e-6)
    assert float(found[1]) < -0.9


@pytest.mark.parametrize("renderer", RENDERERS)
def test_constant_matter_faces_nowhere(renderer: str) -> None:
    """Nor does it in some cells only; derivatives stay finite, 0 by the direction that is not there."""
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    density = torch.full((mesh.num_vertices,), 2.0, dtype=torch.float64, requires_grad=True)
    vertices = mesh.vertices.clone().requires_grad_()
    found = one(render_normals(mesh.with_vertices(vertices), densities(density), CAMERA, renderer))
    assert not found.any()
    assert not any(gradient.any() for gradient in torch.autograd.grad(found.sum(), (density, vertices)))
    with torch.no_grad():
        density[0] = 3.0
    found = one(render_normals(mesh.with_vertices(vertices), densities(density), CAMERA, renderer))
    assert found.any()
    assert all(bool(g.isfinite().all()) for g in torch.autograd.grad(found.sum(), (density, vertices)))


def test_thin_cells_have_the_normals_of_their_neighbours() -> None:
    """On a linear field, down to cells a hundred million times as long as thin."""
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    slope = torch.tensor([0.3, 1.0, -0.2], dtype=torch.float64)
    for flatness in (1.0, 1e-4, 1e-8):
        thin = mesh.with_vertices(mesh.vertices * torch.tensor([1.0, 1.0, flatness], dtype=torch.float64))
        scaled = slope / torch.tensor([1.0, 1.0, flatness], dtype=torch.float64)
        normals = cell_normals(thin, (mesh.vertices * slope).sum(1))
        assert torch.allclose(normals, -(scaled / scaled.norm()).expand(len(normals), 3), atol=1e-9)


def test_options_and_several_cameras() -> None:
    mesh = TetMesh.grid((3, 3, 3))
    field = densities(4.0 * torch.rand(mesh.num_vertices, generator=torch.Generator().manual_seed(2)))
    options: dict[str, Any] = {"transmittance_threshold": 0.3, "clip_plane": (0.0, 1.0, 0.0, -0.4)}
    single = one(render_normals(mesh, field, CAMERA, **options))
    normals = cell_normals(mesh, field.density).float()
    assert torch.equal(single, render(mesh, CellFeatures(normals, field), CAMERA, **options).color)
    assert not torch.equal(single, one(render_normals(mesh, field, CAMERA)))
    both = one(render_normals(mesh, field, [CAMERA, CAMERA], **options))
    assert both.shape == (2, 5, 7, 3) and torch.allclose(both[1], single, atol=1e-5)
    uneven = render_normals(mesh, field, [CAMERA, CAMERA.with_size(3, 4)])
    assert isinstance(uneven, tuple) and uneven[1].shape == (4, 3, 3)


def test_fields_that_are_constant_in_cells_are_refused() -> None:
    mesh = TetMesh.grid((2, 2, 2))
    scalars = ScalarField(torch.rand(mesh.num_cells), TransferFunction.default())
    for field in (densities(torch.rand(mesh.num_cells)), scalars, CellFeatures(torch.rand(48, 1), scalars)):
        with pytest.raises(MeshError, match="constant in each cell, so nothing says where it faces") as error:
            render_normals(mesh, field, CAMERA)
        assert_sentence(error.value)
