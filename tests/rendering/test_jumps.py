"""Derivatives by the knots of a transfer function's jumps, and by scalars that lie on one, against differences.

Where two knots meet, the earlier one can only move down and the later one only up. Scalars are moved up, since at a
jump the later knot counts.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from oracle.scenes import SCENES

from difftetvr.mesh import TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, ScalarField, render

RENDERERS = ("marching", "linked-list", "projected")
STEP = 1e-6
ABOVE = Camera.look_at((0.4, 0.6, 3.0), (0.5, 0.45, 0.5), (0.0, 1.0, 0.0), 0.3, 6, 6)
Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def loss_of(mesh: TetMesh, camera: Camera, opacity: list[float], renderer: str = "marching") -> Loss:
    """A random linear function of the image, of scalars and knots."""
    generator = torch.Generator().manual_seed(5)
    color = torch.rand(len(opacity), 3, generator=generator, dtype=torch.float64)
    weights = torch.randn(camera.height, camera.width, 4, generator=generator, dtype=torch.float64)
    heights = torch.tensor(opacity, dtype=torch.float64)

    def loss(scalar: torch.Tensor, knots: torch.Tensor) -> torch.Tensor:
        field = ScalarField(scalar, TransferFunction(knots, heights, color), 3.0, (0.0, 1.0), "vertex")
        image = render(mesh, field, camera, renderer=renderer)
        return (torch.cat((image.color, image.optical_depth[..., None]), 2) * weights).sum()

    return loss


def layers(values: list[float]) -> tuple[TetMesh, torch.Tensor]:
    """A grid with one scalar a layer of vertices, so that rays pass whole faces on which it is constant."""
    count = len(values) - 1
    mesh = TetMesh.grid((2, 2, count), dtype=torch.float64)
    return mesh, torch.tensor(values, dtype=torch.float64)[(mesh.vertices[:, 2] * count).round().long()]


def one_sided(loss: Loss, scalar: torch.Tensor, knots: torch.Tensor, move: torch.Tensor) -> float:
    return float(loss(scalar, knots + STEP * move) - loss(scalar, knots)) / STEP


def assert_knots(loss: Loss, scalar: torch.Tensor, knots: list[float], moves: dict[int, int]) -> None:
    """Compare the derivatives by some knots, each of which moves down (-1) or up (1)."""
    places = torch.tensor(knots, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(scalar, places), places)
    for knot, sign in moves.items():
        move = torch.zeros_like(places)
        move[knot] = sign
        expected = sign * one_sided(loss, scalar, places.detach(), move)
        assert float(gradient[knot]) == pytest.approx(expected, rel=1e-4, abs=1e-4), knot


@pytest.mark.parametrize("renderer", RENDERERS)
def test_two_knots_at_one_scalar(renderer: str) -> None:
    scene = SCENES["delaunay"]()
    mesh = TetMesh(scene.vertices.double(), scene.tets)
    scalar = torch.rand(mesh.num_vertices, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    loss = loss_of(mesh, scene.camera.with_size(12, 12), [0.2, 0.3, 0.9, 0.6], renderer)
    assert_knots(loss, scalar, [0.0, 0.5, 0.5, 1.0], {1: -1, 2: 1})


def test_three_knots_at_one_scalar() -> None:
    mesh, scalar = layers([0.1, 0.7, 0.3, 0.9])
    loss = loss_of(mesh, ABOVE, [0.2, 0.1, 0.9, 0.4, 0.6])
    knots = torch.tensor([0.0, 0.5, 0.5, 0.5, 1.0], dtype=torch.float64, requires_grad=True)
    assert_knots(loss, scalar, knots.tolist(), {1: -1, 3: 1})
    (gradient,) = torch.autograd.grad(loss(scalar, knots), knots)
    for pair, sign in (((1, 2), -1.0), ((2, 3), 1.0), ((1, 2, 3), 1.0)):
        move = torch.zeros_like(gradient)
        move[list(pair)] = sign
        expected = sign * one_sided(loss, scalar, knots.detach(), move)
        assert float(gradient[list(pair)].sum()) == pytest.approx(expected, rel=1e-4), pair


@pytest.mark.parametrize(
    "values", [[0.1, 0.2, 0.5, 0.9], [0.95, 0.5, 0.2, 0.0], [0.3, 0.5, 0.1, 0.5], [0.9, 0.5, 0.7, 0.5]]
)
def test_a_jump_on_faces_of_the_mesh(values: list[float]) -> None:
    """Cells end or begin exactly at the jump; each of its knots moves into the cells on one side only."""
    mesh, scalar = layers(values)
    assert_knots(loss_of(mesh, ABOVE, [0.2, 0.3, 0.9, 0.6]), scalar, [0.0, 0.5, 0.5, 1.0], {1: -1, 2: 1})


def test_a_single_knot_on_faces_of_the_mesh() -> None:
    mesh, scalar = layers([0.1, 0.5, 0.6, 0.5, 0.2])
    loss = loss_of(mesh, ABOVE, [0.2, 0.9, 0.4])
    for sign in (-1, 1):
        assert_knots(loss, scalar, [0.0, 0.5, 1.0], {1: sign})


def test_a_region_at_a_jump_stays_with_the_later_knot() -> None:
    """Its image does not change as the earlier knot moves down; the cells below it do."""
    mesh, scalar = layers([0.1, 0.5, 0.5, 0.0])
    assert_knots(loss_of(mesh, ABOVE, [0.2, 0.3, 0.9, 0.6]), scalar, [0.0, 0.5, 0.5, 1.0], {1: -1})


def test_jumps_at_the_ends_of_the_range() -> None:
    mesh, scalar = layers([1.0, 0.0, 0.4, 1.0, 0.7])
    loss = loss_of(mesh, ABOVE, [0.1, 0.8, 0.3, 0.9])
    assert_knots(loss, scalar, [0.0, 0.0, 1.0, 1.0], {1: 1, 2: -1})


def test_scalars_at_a_jump_move_up() -> None:
    mesh, scalar = layers([0.1, 0.5, 0.8, 0.5, 0.2])
    loss = loss_of(mesh, ABOVE, [0.2, 0.3, 0.9, 0.6])
    knots = torch.tensor([0.0, 0.5, 0.5, 1.0], dtype=torch.float64)
    leaf = scalar.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(leaf, knots), leaf)
    for vertices in (scalar == 0.5, torch.arange(len(scalar)) == 13):
        assert vertices.any() and float(scalar[vertices].min()) == 0.5
        expected = float(loss(scalar + STEP * vertices, knots) - loss(scalar, knots)) / STEP
        assert float(gradient[vertices].sum()) == pytest.approx(expected, rel=1e-4)


def test_a_function_of_one_knot_does_not_depend_on_its_place() -> None:
    mesh, scalar = layers([0.1, 0.5, 0.9])
    knot = torch.tensor([0.5], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss_of(mesh, ABOVE, [0.7])(scalar, knot), knot)
    assert abs(float(gradient)) < 1e-12
