"""Transmittance at distances and distances at transmittances: the reference's values, and derivatives."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st
from oracle.oracle import optical_depths_oracle
from oracle.scenes import EXTREME_SCENES, SCENES, Scene, relative_error, total_error
from rendering.helpers import in_double
from torch import Tensor

from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, Rays, ScalarField, depth_at, render, transmittance_at

CASES = [
    *((name, "marching") for name in ("delaunay", "porous", "inside-cells", "in-hole", "slabs", "dense-1e2")),
    *((name, "linked-list") for name in ("porous-cells", "inside", "half-empty")),
    ("delaunay", "projected"),
]
VALUES = (0.97, 0.5, 0.8, 0.1)


def small(name: str) -> Scene:
    scene = (SCENES | EXTREME_SCENES)[name]()
    return Scene(
        scene.vertices.double(),
        scene.tets,
        scene.color.double(),
        scene.density.double(),
        in_double(scene.camera.with_size(11, 9)),
        scene.per_cell,
    )


def field_of(scene: Scene, density: Tensor) -> Field:
    return Field(density[:, None], density, "cell" if scene.per_cell else "vertex")


def some_distances(scene: Scene, count: int = 5) -> Tensor:
    """(H, W, K) distances of no order, before, in and behind the mesh."""
    camera = scene.camera
    reach = float((scene.vertices - camera.position.detach()).norm(dim=1).max())
    shape = (camera.height, camera.width, count)
    return 1.2 * reach * torch.rand(shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 0.1


# ------------------------------------------------------------------------------------------- as the reference has it


@pytest.mark.filterwarnings("ignore::difftetvr.rendering.OrderWarning")
@pytest.mark.parametrize(("name", "renderer"), CASES)
def test_transmittances_and_derivatives_are_those_of_the_reference(name: str, renderer: str) -> None:
    scene = small(name)
    leaves = [scene.vertices, scene.density, scene.camera.world_to_camera, some_distances(scene)]
    vertices, density, pose, distances = leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    camera, mesh = scene.camera.with_pose(pose), TetMesh(vertices, scene.tets)
    found = transmittance_at(mesh, field_of(scene, density), camera, distances, renderer)
    assert isinstance(found, Tensor)
    truth = torch.exp(-optical_depths_oracle(vertices, scene.tets, density, camera, distances, scene.per_cell))
    assert found.shape == (9, 11, 5)
    assert total_error(found.detach(), truth.detach()) < 1e-10
    weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ours, theirs = (torch.autograd.grad((weights * values).sum(), leaves) for values in (found, truth))
    for one, other in zip(ours, theirs, strict=True):
        assert relative_error(one, other) < 1e-7


@pytest.mark.filterwarnings("ignore::difftetvr.rendering.OrderWarning")
@pytest.mark.parametrize(("name", "renderer"), [*CASES, ("dense-1e6", "marching"), ("empty", "marching")])
def test_light_has_fallen_to_its_values_at_the_depths_found(name: str, renderer: str) -> None:
    """By the reference; and never before, since what it falls to there it has not reached a bit earlier."""
    scene = small(name)
    mesh, field = TetMesh(scene.vertices, scene.tets), field_of(scene, scene.density)
    found = depth_at(mesh, field, scene.camera, VALUES, renderer)
    assert isinstance(found, Tensor) and found.shape == (9, 11, 4)
    end = torch.full((1,), math.inf, dtype=torch.float64)
    at = torch.where(torch.isfinite(found), found, 0.0)
    before, there, whole = (
        optical_depths_oracle(scene.vertices, scene.tets, scene.density, scene.camera, distances, scene.per_cell)
        for distances in (at * (1.0 - 1e-9), at, end)
    )
    wanted = -torch.log(torch.tensor(VALUES, dtype=torch.float64)).expand_as(found)
    is_found = torch.isfinite(found)
    assert torch.equal(is_found, wanted <= whole)
    assert bool(is_found.any()) == (name != "empty")
    # Where the density is huge, the last bits of a distance are much optical depth.
    slack = 1e-10 + 1e-14 * float(scene.density.max())
    assert float((there - wanted)[is_found].abs().sum()) < slack * found.numel()
    assert float((before - wanted).max()) < slack


def test_single_precision() -> None:
    scene = SCENES["jittered"]()
    mesh, field = TetMesh(scene.vertices, scene.tets), Field(scene.color, scene.density)
    distances = torch.linspace(0.5, 2.0, 9)
    found = transmittance_at(mesh, field, scene.camera, distances)
    truth = torch.exp(-optical_depths_oracle(scene.vertices, scene.tets, scene.density, scene.camera, distances))
    assert isinstance(found, Tensor) and found.dtype == torch.float32
    assert total_error(found, truth) < 1e-5
    exact = depth_at(mesh.to(dtype=torch.float64), field.to(dtype=torch.float64), scene.camera)
    median = depth_at(mesh, field, scene.camera)
    assert isinstance(exact, Tensor) and isinstance(median, Tensor) and median.dtype == torch.float32
    both = torch.isfinite(median) & torch.isfinite(exact)
    assert int(both.sum()) > 100
    # Where next to no density is left at the median, what rounding does to the light moves it far.
    assert float((median - exact)[both].abs().median()) < 1e-6 and float((median - exact)[both].abs().max()) < 1e-3


# ------------------------------------------------------------------------------------------------ by differences


def probes() -> tuple[TetMesh, Tensor, Tensor]:
    """A small mesh, and rays through it: half from outside, half from inside."""
    generator = torch.Generator().manual_seed(8)
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    origins = torch.rand(6, 3, generator=generator, dtype=torch.float64)
    targets = 0.3 + 0.4 * torch.rand(6, 3, generator=generator, dtype=torch.float64)
    origins[:3, 0] -= 1.5
    origins[3:] = 0.2 + 0.6 * origins[3:]
    return mesh, origins, targets - origins


def content_of(name: str, mesh: TetMesh) -> Tensor:
    count = mesh.num_cells if name == "cell" else mesh.num_vertices
    return torch.rand(count, generator=torch.Generator().manual_seed(9), dtype=torch.float64)


def medium(name: str, values: Tensor, opacity: Tensor) -> Field | ScalarField:
    """A dense field, or a scalar seen through a transfer function that jumps."""
    if name != "scalar":
        return Field(values[:, None], 2.0 + 8.0 * values, name)  # type: ignore[arg-type]
    function = TransferFunction([0.0, 0.3, 0.6, 0.6, 1.0], opacity, torch.rand(5, 3))
    return ScalarField(values, function, 14.0, (0.0, 1.0), "vertex")


@pytest.mark.parametrize("function", [depth_at, transmittance_at])
@pytest.mark.parametrize("content", ["vertex", "cell", "scalar"])
def test_derivatives_by_finite_differences(content: str, function: Any) -> None:
    """By all there is: positions, values, knots, rays and their ends, a plane, and what is asked for."""
    mesh, origins, directions = probes()
    near = torch.tensor([0.1, 1.6, 0.0, 0.05, 0.0, -0.1], dtype=torch.float64)
    far = torch.tensor([9.0, 2.6, 2.0, 9.0, 0.4, 0.5], dtype=torch.float64)
    asked = torch.tensor([0.8, 0.6] if function is depth_at else [1.7, 0.3, 0.3], dtype=torch.float64)
    opacity = torch.tensor([0.4, 0.9, 0.7, 0.3, 0.6], dtype=torch.float64)

    def found(
        vertices: Tensor, values: Tensor, opacity: Tensor, origins: Tensor, directions: Tensor, *ends: Tensor
    ) -> Tensor:
        near, far, plane, asked = ends
        field, rays = medium(content, values, opacity), Rays(origins, directions, near, far)
        answers = function(mesh.with_vertices(vertices), field, rays, asked, clip_plane=plane)
        return torch.where(torch.isfinite(answers), answers, 0.0)

    plane = torch.tensor([0.3, -1.0, 0.2, 0.6], dtype=torch.float64)
    values = content_of(content, mesh)
    answers = function(mesh, medium(content, values, opacity), Rays(origins, directions, near, far), asked)
    assert int((torch.isfinite(answers) & (answers < 1.0 if function is transmittance_at else answers > 0)).sum()) > 5
    leaves = [mesh.vertices, values, opacity, origins, directions, near, far, plane, asked]
    leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    assert torch.autograd.gradcheck(found, leaves, eps=1e-6, atol=1e-5, rtol=1e-4, nondet_tol=1e-12, fast_mode=True)


def test_equal_distances_have_derivatives_of_their_own() -> None:
    """Also on faces of the mesh, where other integrals that end there are cut."""
    mesh = TetMesh.grid((4, 4, 4), dtype=torch.float64)
    field = Field(torch.zeros(mesh.num_vertices, 0, dtype=torch.float64), 1.0 + mesh.vertices[:, 2])
    rays = Rays([[0.4, 0.37, 0.0]], torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
    distances = torch.tensor([0.5, 0.75, 0.5, 0.6, 0.5], dtype=torch.float64, requires_grad=True)
    found = transmittance_at(mesh, field, rays, distances)
    assert isinstance(found, Tensor)
    weights = torch.tensor([1.0, -2.0, 3.0, 5.0, 0.0], dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weights * found[0]).sum(), distances)
    z = distances.detach()
    light = torch.exp(-z - 0.5 * z * z)
    assert torch.allclose(found.detach()[0], light)
    assert torch.allclose(gradient, -weights * light * (1.0 + z))


@pytest.mark.parametrize("renderer", ["marching", "projected"])
def test_several_views_have_values_of_their_own(renderer: str) -> None:
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    field = Field(torch.zeros(mesh.num_vertices, 0, dtype=torch.float64), 1.0 + mesh.vertices[:, 2])
    eyes = ((2.0, 1.7, 1.4), (-1.0, 0.3, 0.2))
    cameras = [Camera.look_at(eye, (0.5, 0.5, 0.5), width=4, height=3) for eye in eyes]
    for shape in ((2, 3, 4, 5), (3, 4, 5), (5,), (1, 3, 4, 5)):
        values = 3.0 * torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        found = transmittance_at(mesh, field, cameras, values, renderer=renderer)
        assert isinstance(found, Tensor) and found.shape == (2, 3, 4, 5)
        for k, camera in enumerate(cameras):
            own = values[min(k, len(values) - 1)] if len(shape) == 4 else values
            assert torch.allclose(found[k], transmittance_at(mesh, field, camera, own), atol=1e-12)


# --------------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("least", "greatest"), [(3.0, 3.0), (0.0, 6.0), (6.0, 0.0), (1e-3, 2e3), (2e3, 1e-3)])
def test_a_ramp_of_density(least: float, greatest: float, dtype: torch.dtype) -> None:
    """In one layer of cells: a t + (b - a) t^2 / 2 is minus the logarithm of the light."""
    mesh = TetMesh.grid((1, 1, 1), dtype=dtype)
    density = least + (greatest - least) * mesh.vertices[:, 2]
    rays = Rays([[0.41, 0.37, -2.0]], torch.tensor([[0.0, 0.0, 3.0]], dtype=dtype))
    values = torch.tensor([0.999999, 0.99, 0.5, 0.3], dtype=torch.float64)
    found = depth_at(mesh, Field(density[:, None], density), rays, values)
    depth = -torch.log(values)
    root = torch.sqrt(least**2 + 2.0 * (greatest - least) * depth)
    expected = 2.0 + 2.0 * depth / (least + root)
    assert isinstance(found, Tensor)
    assert total_error(found[0], expected) < (1e-12 if dtype == torch.float64 else 2e-6)


@given(seed=st.integers(0, 2**31), value=st.floats(0.001, 0.999))
@examples(20)
def test_one_is_the_inverse_of_the_other(seed: int, value: float) -> None:
    scene = small("delaunay")
    mesh = TetMesh(scene.vertices, scene.tets)
    generator = torch.Generator().manual_seed(seed)
    origins = torch.rand(30, 3, generator=generator, dtype=torch.float64) * 2.0 - 1.0
    rays = Rays(origins, 0.6 * torch.rand(30, 3, generator=generator, dtype=torch.float64) - 0.3 - origins)
    field = field_of(scene, scene.density)
    depth = depth_at(mesh, field, rays, value)
    assert isinstance(depth, Tensor) and depth.shape == (30,)
    light = transmittance_at(mesh, field, rays, depth[:, None])
    assert isinstance(light, Tensor)
    reached = torch.isfinite(depth)
    assert torch.allclose(light[reached], torch.tensor(value, dtype=torch.float64), atol=1e-11)
    assert bool((light[~reached] > value).all())
    assert torch.allclose(light[~reached, 0], 1.0 - render(mesh, field, rays).alpha[~reached], atol=1e-12)
