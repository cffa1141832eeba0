"""Unusual callers: several threads, extreme units of length, values that are not finite, arguments of wrong types."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from difftetvr.backend import dr
from difftetvr.errors import CameraError, DiffTetError, MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, Rays, autograd, render
from difftetvr.rendering.kernels.adjoint import render_adjoint


def scene(unit: float = 1.0, dtype: torch.dtype = torch.float32) -> tuple[TetMesh, Field, Camera]:
    generator = torch.Generator().manual_seed(3)
    mesh = TetMesh.grid((4, 3, 5), (0, 0, 0), (unit, unit, unit), dtype=dtype)
    color = torch.rand(mesh.num_vertices, 3, generator=generator, dtype=dtype)
    density = 4.0 / unit * torch.rand(mesh.num_vertices, generator=generator, dtype=dtype)
    eye, target = (2.0 * unit, 1.7 * unit, 1.3 * unit), (0.5 * unit, 0.5 * unit, 0.5 * unit)
    return mesh, Field(color, density), Camera.look_at(eye, target, fov_y=0.8, width=30, height=20)


@pytest.mark.usefixtures("kernel_threads")
def test_threads_take_turns() -> None:
    mesh, field, camera = scene()
    expected = render(mesh, field, camera).color
    threads_before, wrong = dr.thread_count(), []

    def work(deterministic: bool) -> None:
        for _ in range(8):
            color = field.color.clone().requires_grad_()
            image = render(mesh, Field(color, field.density), camera, deterministic=deterministic).color
            image.sum().backward()
            if not torch.equal(image.detach(), expected) or color.grad is None:
                wrong.append(deterministic)

    threads = [threading.Thread(target=work, args=(k % 2 == 0,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert dr.thread_count() == threads_before


def test_another_thread_may_go_backward_time_and_again() -> None:
    """As autograd's own does on GPUs: it uses what kernels of the forward pass have left, evaluated or not."""
    mesh, field, _ = scene()
    directions = torch.tensor([0.5, 0.5, 0.5]) - torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 1.0
    with ThreadPoolExecutor(1) as other:
        for _ in range(3):
            density = field.density.clone().requires_grad_()
            rays = Rays(mesh.vertices.mean(0) - 2.0 * directions, directions)
            loss = render(mesh, Field(field.color, density), rays).color.sum()
            other.submit(loss.backward).result()
            assert density.grad is not None and float(density.grad.abs().sum()) > 0


def test_flags_of_the_caller_hold_in_the_thread_that_goes_backward(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dr.Jit has them for each thread, and autograd one of its own for each GPU."""
    mesh, field, camera = scene()
    density = field.density.clone().requires_grad_()
    held = []

    def recorded(*args):
        held.append(dr.flag(dr.JitFlag.KernelHistory))
        return render_adjoint(*args)

    monkeypatch.setattr(autograd, "render_adjoint", recorded)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        loss = render(mesh, Field(field.color, density), camera).color.sum()
        dr.kernel_history()  # empties it
    with ThreadPoolExecutor(1) as other:
        other.submit(loss.backward).result()
        assert held == [True] and not other.submit(dr.flag, dr.JitFlag.KernelHistory).result()
    assert density.grad is not None


@pytest.mark.parametrize("unit", [1e-20, 1e-17, 1e-9, 1e9, 1e19])
def test_any_unit_of_length(unit: float) -> None:
    results = []
    for length in (1.0, unit):
        mesh, field, camera = scene(length)
        vertices = mesh.vertices.clone().requires_grad_()
        density = field.density.clone().requires_grad_()
        image = render(mesh.with_vertices(vertices), Field(field.color, density), camera)
        (image.color.sum() + image.depth.sum() / length).backward()
        assert vertices.grad is not None and density.grad is not None
        results.append((image.color, image.depth / length, vertices.grad.double() * length, density.grad / length))
    for here, there in zip(*results, strict=True):
        assert (here - there).norm() < 2e-4 * here.norm()


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_vertex_that_is_not_finite(bad: float) -> None:
    mesh, field, camera = scene()
    vertices = mesh.vertices.clone()
    vertices[17:20] = bad
    with pytest.raises(MeshError, match="Vertex 17"):
        render(mesh.with_vertices(vertices), field, camera)


def test_field_that_overflows_at_the_meshs_precision() -> None:
    mesh, field, camera = scene()
    with pytest.raises(MeshError, match="density"):
        render(mesh, Field(field.color, torch.full((mesh.num_vertices,), 1e300, dtype=torch.float64)), camera)


@pytest.mark.parametrize("background", [(float("nan"), 0, 0), "white", (0.0, 1.0), None])
def test_background(background: object) -> None:
    if background is None:
        assert render(*scene(), background=None).color.isfinite().all()
        return
    with pytest.raises(DiffTetError, match="background"):
        render(*scene(), background=background)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "change",
    [{"width": 16.5}, {"height": "16"}, {"width": 0}, {"width": 100_000, "height": 65_000}, {"fov_y": "wide"}],
    ids=str,
)
def test_camera_of_wrong_size_or_type(change: dict[str, object]) -> None:
    options = {"width": 16, "height": 16, "fov_y": 0.8} | change
    with pytest.raises(CameraError):
        Camera.look_at((1, 1, 1), (0, 0, 0), **options)  # type: ignore[arg-type]


def test_eye_that_is_not_finite() -> None:
    with pytest.raises(CameraError, match="finite"):
        Camera.look_at((float("nan"), 0, 0), (0, 0, 1))


def test_thin_medium_keeps_its_digits() -> None:
    """1 - T would be 0 here; alpha and the expected depth come from the optical depth instead."""
    mesh, field, camera = scene()
    thick = render(mesh, field, camera)
    thin = render(mesh, Field(field.color, 1e-9 * field.density), camera)
    seen = thick.optical_depth > 1e-3
    assert torch.allclose(thin.optical_depth[seen], 1e-9 * thick.optical_depth[seen], rtol=1e-4)
    assert torch.allclose(thin.alpha[seen], thin.optical_depth[seen], rtol=1e-4)
    assert thin.depth[seen].min() > 0.5


def test_optical_depth_is_linear_in_density() -> None:
    mesh, field, camera = scene(dtype=torch.float64)
    density = field.density.clone().requires_grad_()
    image = render(mesh, Field(field.color, density), camera)
    image.optical_depth.sum().backward()
    assert density.grad is not None
    assert torch.allclose((density.grad * density).sum(), image.optical_depth.sum())
    assert torch.allclose(image.alpha, 1.0 - torch.exp(-image.optical_depth))
