"""Rendering amid what else happens in a process: autocast, torch.compile, copies of the process, missing devices."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from typing import Any

import pytest
import torch

from difftetvr.backend import get_backend
from difftetvr.errors import BackendError, DiffTetError
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, ScalarField, render
from difftetvr.rendering.gauss_newton import model_image
from difftetvr.rendering.inspection import inspect_rays

CAMERA = Camera.look_at((2.2, -1.7, 1.9), (0.5, 0.5, 0.5), width=24, height=24)


def scene() -> tuple[TetMesh, Field]:
    mesh = TetMesh.grid((4, 4, 4))
    generator = torch.Generator().manual_seed(0)
    color = torch.rand(mesh.num_vertices, 3, generator=generator)
    harmonics = 0.1 * torch.randn(mesh.num_vertices, 3, 3, generator=generator)
    return mesh, Field(color, 3.0 * torch.rand(mesh.num_vertices, generator=generator), harmonics=harmonics)


def image_and_gradients() -> list[torch.Tensor]:
    """Everything that a view is made of: a pose, a plane, colours that depend on the direction."""
    mesh, field = scene()
    vertices, pose = mesh.vertices.clone().requires_grad_(), CAMERA.world_to_camera.clone().requires_grad_()
    plane = torch.tensor([0.3, -0.5, 0.8, 0.05], requires_grad=True)
    image = render(mesh.with_vertices(vertices), field, CAMERA.with_pose(pose), clip_plane=plane)
    loss = image.color.square().sum() + image.depth.sum()
    return [image.color.detach(), image.depth.detach(), *torch.autograd.grad(loss, (vertices, pose, plane))]


def test_autocast_does_not_reach_geometry() -> None:
    """Positions in bfloat16 would be off by more than a hundredth; its backward pass is under autocast here, too."""
    expected = image_and_gradients()
    with torch.autocast("cpu"):
        found = image_and_gradients()
    for one, other in zip(expected, found, strict=True):
        assert torch.allclose(one, other, rtol=1e-4, atol=1e-5 * float(one.abs().max()))


def test_transformed_points_have_second_derivatives() -> None:
    points = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    pose = CAMERA.world_to_camera.double().requires_grad_()
    camera = lambda pose: torch.tanh(points @ pose[:3, :3].T + pose[:3, 3])  # noqa: E731
    (expected,) = torch.autograd.grad(camera(pose).square().sum(), points, create_graph=True)
    found = torch.tanh(CAMERA.with_pose(pose).to_camera_space(points))
    (gradient,) = torch.autograd.grad(found.square().sum(), points, create_graph=True)
    for one, other in zip(
        torch.autograd.grad(expected.sum(), (points, pose)),
        torch.autograd.grad(gradient.sum(), (points, pose)),
        strict=True,
    ):
        assert torch.allclose(one, other)


def _rendered(mesh: TetMesh, field: Field, color: torch.Tensor) -> torch.Tensor:
    return render(mesh, Field(color.sigmoid(), field.density), CAMERA).color.square().mean()


def _rendered_from_a_new_camera(mesh: TetMesh, field: Field, color: torch.Tensor) -> torch.Tensor:
    camera = Camera.look_at((2.0, -2.0, 2.0), (0.5, 0.5, 0.5), width=16, height=16).with_size(12, 12)
    moved = mesh.with_vertices(mesh.vertices + 0.01 * color)
    return render(moved, Field(color.sigmoid(), field.density), camera).depth.sum() + moved.quality().sum()


def _rendered_scalars(mesh: TetMesh, field: Field, color: torch.Tensor) -> torch.Tensor:
    scalar = ScalarField(color[:, 0].sigmoid(), TransferFunction.default(), 3.0, (0.0, 1.0))
    return render(mesh, scalar, CAMERA).color.sum()


def _modelled(mesh: TetMesh, field: Field, color: torch.Tensor) -> torch.Tensor:
    crossed = inspect_rays(mesh, CAMERA).depth_complexity.sum()
    truth = torch.zeros(CAMERA.height, CAMERA.width, 3)
    return color.sum() * crossed * model_image(mesh, Field(field.color, field.density), CAMERA, truth).error


@pytest.mark.filterwarnings("ignore")  # the compiler's own, about what it does not follow
@pytest.mark.parametrize(
    "function",
    [
        _rendered,
        *(pytest.param(f, marks=pytest.mark.slow) for f in (_rendered_from_a_new_camera, _rendered_scalars, _modelled)),
    ],
)
def test_a_compiled_function_may_render(function: Callable[[TetMesh, Field, torch.Tensor], torch.Tensor]) -> None:
    mesh, field = scene()
    gradients = []
    for call in (function, torch.compile(function, backend="eager")):
        color = field.color.clone().requires_grad_()
        gradients += torch.autograd.grad(call(mesh, field, color), color)
    assert gradients[0].any() and torch.allclose(*gradients, rtol=1e-4, atol=1e-6)


def _try_to(work: Callable[[], object], said: Any) -> None:
    try:
        work()
        said.put("done")
    except Exception as error:
        said.put(f"{type(error).__name__}: {error}")


def _render_once() -> None:
    render(*scene(), CAMERA)


def _inspect_once() -> None:
    inspect_rays(scene()[0], CAMERA)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not copied here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("work", [_render_once, _inspect_once, get_backend])
def test_a_copy_of_a_process_that_has_rendered(work: Callable[[], object]) -> None:
    """It would wait for ever for threads that were not copied."""
    _render_once()
    context = multiprocessing.get_context("fork")
    said = context.SimpleQueue()
    child = context.Process(target=_try_to, args=(work, said))
    child.start()
    child.join(60)
    if child.is_alive():
        child.kill()
        pytest.fail("the copy hangs")
    answer = said.get()
    assert answer.startswith("BackendError: ") and "'spawn'" in answer, answer


def test_a_device_that_pytorch_does_not_know() -> None:
    with pytest.raises(BackendError, match=r"no device 'quantum'; use .*cpu"):
        get_backend("quantum")


@pytest.mark.parametrize("device", ["quantum", "hip", "cuda:77"])
def test_moving_to_a_device_that_is_not_there(device: str) -> None:
    """PyTorch's own answer is thousands of characters long."""
    mesh, field = scene()
    for thing in (mesh, field, ScalarField(field.density, TransferFunction.default())):
        with pytest.raises(DiffTetError, match=f"'{device}' on this machine") as error:
            thing.to(device)
        assert len(str(error.value)) < 200
