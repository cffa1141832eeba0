"""Gradients that are the same in every run to the last bit, on several threads."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from difftetvr.backend import dr
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, Rays, ScalarField, depth_at, render
from difftetvr.rendering.kernels import shares

pytestmark = pytest.mark.usefixtures("kernel_threads")

REPETITIONS = 4
CAMERA = Camera.look_at((2.6, 1.7, 1.2), (0.1, 0.0, 0.05), fov_y=0.9, width=70, height=53)
LARGE = Camera.look_at((2.6, 1.7, 1.2), (0.1, 0.0, 0.05), fov_y=0.9, width=300, height=260)  # of several launches


def uniform(*shape: int, seed: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def mesh() -> TetMesh:
    grid = TetMesh.grid((5, 4, 6), (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    return grid.with_vertices(grid.vertices + 0.1 * (uniform(*grid.vertices.shape, seed=1) - 0.5))


def vertex_field(moved: TetMesh) -> tuple[Any, list[torch.Tensor]]:
    leaves = [
        uniform(moved.num_vertices, 3, seed=2).requires_grad_(),
        uniform(moved.num_vertices, seed=3).requires_grad_(),
    ]
    return Field(*leaves), leaves


def cell_field(moved: TetMesh) -> tuple[Any, list[torch.Tensor]]:
    leaves = [uniform(moved.num_cells, 3, seed=2).requires_grad_(), uniform(moved.num_cells, seed=3).requires_grad_()]
    return Field(*leaves, "cell"), leaves


def scalar_field(moved: TetMesh) -> tuple[Any, list[torch.Tensor]]:
    default = TransferFunction.default()
    parts = [uniform(moved.num_vertices, seed=2), default.scalar, default.opacity, default.color]
    leaves = [part.double().clone().requires_grad_() for part in parts]
    return ScalarField(leaves[0], TransferFunction(*leaves[1:]), 4.0, (0.0, 1.0)), leaves


def ragged_rays() -> Rays:
    return Rays(3.0 * (uniform(1003, 3, seed=4) - 0.5), uniform(1003, 3, seed=5) - 0.5, near=-1.0, far=2.0)


def scene(
    make_field: Callable[[TetMesh], tuple[Any, list[torch.Tensor]]],
) -> tuple[TetMesh, Any, list[torch.Tensor]]:
    """A mesh whose vertices require a gradient, a field on it, and the leaves that it is made of."""
    still = mesh()
    field, leaves = make_field(still)
    return still.with_vertices(still.vertices.clone().requires_grad_()), field, leaves


def image_gradients(
    make_field: Callable[[TetMesh], tuple[Any, list[torch.Tensor]]], view: Any, in_order: bool
) -> list[torch.Tensor]:
    moved, field, leaves = scene(make_field)
    image = render(moved, field, view, deterministic=in_order)
    loss = (image.color.square().sum() + image.optical_depth.sum()) / image.alpha.numel()
    return list(torch.autograd.grad(loss, [moved.vertices, *leaves]))


def depth_gradients(
    make_field: Callable[[TetMesh], tuple[Any, list[torch.Tensor]]], view: Any, in_order: bool
) -> list[torch.Tensor]:
    moved, field, leaves = scene(make_field)
    depths = depth_at(moved, field, view, 0.7, deterministic=in_order)
    return list(torch.autograd.grad(depths[depths.isfinite()].sum(), [moved.vertices, leaves[1]]))


@pytest.mark.parametrize("make_field", [vertex_field, cell_field, scalar_field])
@pytest.mark.parametrize("view", [CAMERA, LARGE, ragged_rays()], ids=["camera", "large", "rays"])
def test_images(make_field: Callable[[TetMesh], tuple[Any, list[torch.Tensor]]], view: Any) -> None:
    assert_in_order(lambda in_order: image_gradients(make_field, view, in_order))


@pytest.mark.parametrize("budget", [1, 90_000])
def test_meshes_too_large_for_so_many_copies(monkeypatch: pytest.MonkeyPatch, budget: int) -> None:
    assert_in_order(lambda in_order: image_gradients(vertex_field, CAMERA, in_order))
    in_copies = image_gradients(vertex_field, CAMERA, True)
    monkeypatch.setattr(shares, "_COPIES_BUDGET", budget)
    assert_in_order(lambda in_order: image_gradients(vertex_field, CAMERA, in_order))
    for one, other in zip(in_copies, image_gradients(vertex_field, CAMERA, True), strict=True):
        assert float((one - other).norm()) <= 1e-12 * float(one.norm())


def test_depths() -> None:
    assert_in_order(lambda in_order: depth_gradients(vertex_field, CAMERA, in_order))


def assert_in_order(gradients: Callable[[bool], list[torch.Tensor]]) -> None:
    """Equal to the bit with any number of threads, and to rounding to sums in any order."""
    first = gradients(True)
    assert all(float(part.norm()) > 0.0 for part in first)
    for _ in range(REPETITIONS):
        assert all(torch.equal(one, other) for one, other in zip(first, gradients(True), strict=True))
    threads = dr.thread_count()
    for count in (1, 2, 3, 4, 7):
        dr.set_thread_count(count)
        assert all(torch.equal(one, other) for one, other in zip(first, gradients(True), strict=True))
    dr.set_thread_count(threads)
    for one, other in zip(first, gradients(False), strict=True):
        assert float((one - other).norm()) <= 1e-12 * float(one.norm())
