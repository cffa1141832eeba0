"""Features of cells over densities that are not constant in them: the reference's values, and derivatives."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import pytest
import torch
from oracle.oracle import render_oracle
from oracle.scenes import SCENES, Scene, relative_error, total_error
from rendering.helpers import assert_sentence, in_double
from torch import Tensor

from difftetvr.errors import DiffTetError, MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, CellFeatures, RenderedImage, ScalarField, render

RENDERERS = ("marching", "linked-list", "projected")
CAMERA = Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5), width=4, height=3)


def features_of(scene: Scene) -> Tensor:
    """Three features a cell, of either sign."""
    return torch.randn(len(scene.tets), 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def bare(density: Tensor) -> Field:
    """A density whose colours would show if they were looked at."""
    return Field(torch.full((len(density), 3), 1e6, dtype=density.dtype), density)


def seen(image: Any) -> Tensor:
    return torch.cat([part.reshape(-1) for part in (image.color, image.alpha, image.depth)])


@pytest.mark.parametrize(
    ("name", "renderer"),
    [*itertools.product(("delaunay", "porous", "inside", "half-empty"), RENDERERS[:2]), ("delaunay", "projected")],
)
def test_values_and_derivatives_are_those_of_the_reference(name: str, renderer: str) -> None:
    scene = SCENES[name]()
    camera = in_double(scene.camera.with_size(12, 9))
    pose = camera.world_to_camera
    leaves = [scene.vertices.double(), features_of(scene), scene.density.double(), pose]
    vertices, features, density, pose = leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    mesh = TetMesh(vertices, scene.tets)
    image = render(mesh, CellFeatures(features, bare(density)), camera.with_pose(pose), renderer=renderer)
    truth = render_oracle(vertices, scene.tets, features, density, camera.with_pose(pose), color_per_cell=True)
    assert total_error(seen(image).detach(), seen(truth).detach()) < 1e-9
    # Expected depth is a quotient of two roundings where next to nothing is absorbed.
    weights = torch.randn(len(seen(truth)), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights[-truth.depth.numel() :] *= (truth.alpha.detach() > 0.05).reshape(-1)
    ours, theirs = (torch.autograd.grad((weights * seen(i)).sum(), leaves) for i in (image, truth))
    for one, other in zip(ours, theirs, strict=True):
        assert relative_error(one, other) < 1e-6


def test_single_precision_is_as_good_as_for_colours() -> None:
    scene = SCENES["jittered"]()
    field = CellFeatures(features_of(scene).float(), bare(scene.density))
    image = render(TetMesh(scene.vertices, scene.tets), field, scene.camera)
    truth = render_oracle(
        scene.vertices, scene.tets, features_of(scene), scene.density, scene.camera, color_per_cell=True
    )
    assert image.color.dtype == torch.float32
    assert total_error(image.color, truth.color) < 2e-5


@pytest.mark.parametrize("content", ["density", "scalar"])
@pytest.mark.parametrize("channels", [1, 5])
def test_derivatives_by_finite_differences(content: str, channels: int) -> None:
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    scalar = torch.rand(mesh.num_vertices, generator=generator, dtype=torch.float64)
    features = torch.randn(mesh.num_cells, channels, generator=generator, dtype=torch.float64)
    opacity = torch.tensor([0.1, 0.9, 0.2, 0.6], dtype=torch.float64)
    mix = torch.randn(6, 12 * (channels + 1), generator=generator, dtype=torch.float64)

    def image(vertices: Tensor, features: Tensor, scalar: Tensor, opacity: Tensor) -> Tensor:
        function = TransferFunction([0.0, 0.3, 0.6, 1.0], opacity, torch.rand(4, 3))
        medium = bare(3.0 * scalar) if content == "density" else ScalarField(scalar, function, 5.0, (0.0, 1.0))
        view = render(
            mesh.with_vertices(vertices), CellFeatures(features, medium), CAMERA, clip_plane=(0.3, -1.0, 0.2, 0.4)
        )
        return mix @ torch.cat([view.color.reshape(-1), view.depth.reshape(-1)])

    leaves = [part.clone().requires_grad_() for part in (mesh.vertices, features, scalar, opacity)]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, nondet_tol=1e-12)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_transfer_function_gives_only_the_density(renderer: str) -> None:
    """Features that are the same everywhere show as often as light is absorbed, whatever its colours are."""
    mesh = TetMesh.grid((3, 3, 3))
    scalar = torch.rand(mesh.num_vertices, generator=torch.Generator().manual_seed(4))
    medium = ScalarField(scalar, TransferFunction.default(), 20.0, location="vertex")
    image = render(
        mesh, CellFeatures(torch.tensor([[2.0, -1.0]]).expand(mesh.num_cells, 2), medium), CAMERA, renderer=renderer
    )
    plain = render(mesh, medium, CAMERA)
    assert torch.allclose(image.optical_depth, plain.optical_depth, atol=1e-5)
    assert torch.allclose(image.color, plain.alpha[..., None] * torch.tensor([2.0, -1.0]), atol=1e-5)
    assert float(plain.alpha.max()) > 0.3


def test_a_medium_on_cells_is_a_field_on_cells() -> None:
    mesh = TetMesh.grid((3, 3, 3))
    features, density = torch.randn(mesh.num_cells, 4), torch.rand(mesh.num_cells)
    plain = render(mesh, Field(features, density), CAMERA)
    assert torch.equal(render(mesh, CellFeatures(features, bare(density)), CAMERA).color, plain.color)
    scalars = ScalarField(density, TransferFunction.default(), 3.0)
    seen_through = render(mesh, CellFeatures(features, scalars), CAMERA)
    assert torch.equal(seen_through.optical_depth, render(mesh, scalars, CAMERA).optical_depth)


def test_no_features_leave_the_opacity() -> None:
    mesh = TetMesh.grid((3, 3, 3))
    density = torch.rand(mesh.num_vertices, requires_grad=True)
    scalars = ScalarField(density, TransferFunction.default(), 3.0)
    for medium in (bare(density), scalars):
        features = torch.zeros(mesh.num_cells, 0, requires_grad=True)
        image = render(mesh, CellFeatures(features, medium), CAMERA)
        plain = render(mesh, medium, CAMERA)
        assert image.color.shape == (3, 4, 0)
        assert torch.allclose(image.optical_depth, plain.optical_depth, rtol=1e-6)
        ours, theirs = (torch.autograd.grad(i.optical_depth.sum(), density)[0] for i in (image, plain))
        assert torch.allclose(ours, theirs, atol=1e-6)


def test_several_cameras_and_other_precision() -> None:
    mesh = TetMesh.grid((2, 2, 2))
    field = CellFeatures(torch.randn(mesh.num_cells, 2), bare(torch.rand(mesh.num_vertices)))
    both = render(mesh, field, [CAMERA, CAMERA])
    assert isinstance(both, RenderedImage) and both.color.shape == (2, 3, 4, 2)
    double = render(mesh.to(dtype=torch.float64), field.to(dtype=torch.float64), CAMERA)
    assert double.color.dtype == torch.float64
    assert torch.allclose(both[1].color, double.color.float(), atol=1e-5)


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (torch.zeros(8), r"features have shape \(8,\)"),
        (torch.zeros(48, 65), "up to 64 channels for each cell"),
        (torch.full((48, 2), torch.nan), r"features of cell 0 are \[nan, nan\]"),
        ("white", "The features is 'white'"),
        (torch.zeros(7, 3), "features of 7 cells, but this mesh has 48"),
    ],
)
def test_mistakes_get_one_sentence(features: Any, message: str) -> None:
    mesh = TetMesh.grid((2, 2, 2))
    with pytest.raises(MeshError, match=message) as error:
        render(mesh, CellFeatures(features, bare(torch.rand(mesh.num_vertices))), CAMERA)
    assert_sentence(error.value)


def test_media_are_fields_of_the_mesh() -> None:
    mesh = TetMesh.grid((2, 2, 2))
    features = torch.zeros(mesh.num_cells, 2)
    with pytest.raises(MeshError, match=r"The medium is a tensor .*pass a difftetvr.Field"):
        CellFeatures(features, features)  # type: ignore[arg-type]
    field = CellFeatures(features, bare(torch.rand(5)))
    with pytest.raises(MeshError, match="The field has 5 values"):
        render(mesh, field, CAMERA)
    with pytest.raises(MeshError, match="density of vertex 0 is -1"):
        render(mesh, dataclasses.replace(field, medium=bare(torch.full((mesh.num_vertices,), -1.0))), CAMERA)
    with pytest.raises(DiffTetError, match=r"pass one difftetvr.Field, ScalarField or CellFeatures"):
        render(mesh, features, CAMERA)  # type: ignore[call-overload]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
def test_features_that_are_not_finite_are_named(value: float) -> None:
    mesh, density = TetMesh.grid((2, 2, 2)), torch.ones(27)
    features = torch.ones(mesh.num_cells, 2, dtype=torch.float64)
    features[7, 1] = value
    camera = Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5), width=5, height=4)
    for medium in (Field(torch.ones(27, 3), density), Field(torch.ones(mesh.num_cells, 3), torch.ones(mesh.num_cells))):
        with pytest.raises(MeshError, match=r"features of cell 7 are \[1.0, (nan|inf)\]; make every feature finite"):
            render(mesh, CellFeatures(features, medium), camera)
