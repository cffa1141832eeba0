"""The quadratic models by hats of a scalar behind a transfer function, against autograd and real refinements."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import difftetvr as dtv
from difftetvr.mesh import TetMesh, bisect_edges
from difftetvr.rendering import Camera, ScalarField, render
from difftetvr.rendering.gauss_newton import HatChoice, model_image

BACKGROUND = (0.3, 0.6, 0.1)
CAMERAS = [
    Camera.look_at((0.4, -1.5, 0.9), (0.5, 0.5, 0.5), (0, 0, 1), width=40, height=40),
    Camera.look_at((0.41, 0.33, 0.57), (0.9, 0.8, 0.4), (0, 0, 1), width=40, height=40),  # within the mesh
]
SMOOTH = dtv.TransferFunction(
    torch.linspace(0, 1, 5),
    torch.tensor([0.1, 0.5, 0.3, 0.8, 0.6]),
    torch.rand(5, 3, generator=torch.Generator().manual_seed(1)),
)


def scene() -> tuple[TetMesh, Tensor, Tensor]:
    """A jittered grid with random scalars, and a random image to compare with."""
    random = torch.Generator().manual_seed(0)
    mesh = TetMesh.grid((3, 3, 3), dtype=torch.float64)
    mesh = mesh.with_vertices(mesh.vertices + 0.03 * torch.rand(mesh.vertices.shape, generator=random).double())
    scalar = torch.rand(mesh.num_vertices, generator=random).double()
    return mesh, scalar, torch.rand(40, 40, 3, generator=random).double()


def seen(scalar: Tensor, function: dtv.TransferFunction = SMOOTH, attenuation: float = 3.0) -> ScalarField:
    return ScalarField(scalar, function, attenuation, (0.0, 1.0))


def derivatives(mesh: TetMesh, scalar: Tensor, row: Tensor | int, camera: Camera, truth: Tensor) -> tuple[float, float]:
    """First derivative, and second one of Gauss and Newton, of the squared error by one vertex's scalar."""
    raised = torch.zeros_like(scalar)
    raised[row] = 1.0

    def image_of(step: Tensor | float) -> Tensor:
        return render(mesh, seen(scalar + step * raised), camera, BACKGROUND).color

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad((image_of(step) - truth).square().mean(), step)
    with torch.no_grad():
        column = (image_of(1e-5) - image_of(-1e-5)) / 2e-5
    return float(gradient), 2.0 * float(column.square().mean())


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(("attenuation", "tolerance"), [(0.05, 0.04), (3.0, 0.06)])
def test_gradients_of_vertices_are_those_of_autograd(camera: Camera, attenuation: float, tolerance: float) -> None:
    mesh, scalar, truth = scene()
    leaf = scalar.clone().requires_grad_()
    image = render(mesh, seen(leaf, attenuation=attenuation), camera, BACKGROUND).color
    (expected,) = torch.autograd.grad((image - truth).square().mean(), leaf)
    model = model_image(mesh, seen(scalar, attenuation=attenuation), camera, truth, BACKGROUND, 0.0)
    assert model.error == pytest.approx(float((image.detach() - truth).square().mean()), rel=1e-9)
    assert (model.vertices.gradient[:, 3] - expected).norm() <= tolerance * expected.norm()
    assert not bool(model.vertices.gradient[:, :3].any())


@pytest.mark.parametrize("camera", CAMERAS)
def test_models_predict_what_scalars_of_old_and_new_vertices_do(camera: Camera) -> None:
    mesh, scalar, truth = scene()
    model = model_image(mesh, seen(scalar), camera, truth, BACKGROUND, 0.0)
    for vertex in (21, 42, 58):
        gradient, curvature = derivatives(mesh, scalar, vertex, camera, truth)
        scale = float(model.vertices.gradient[:, 3].abs().max())
        assert float(model.vertices.gradient[vertex, 3]) == pytest.approx(gradient, abs=0.1 * scale)
        assert float(model.vertices.absorption[vertex]) == pytest.approx(curvature, rel=0.15)
    strongest = model.edges.absorption.argsort(descending=True)[:40:8]
    scale = float(model.edges.gradient[strongest, 3].abs().max())
    for edge in strongest.tolist():
        change = bisect_edges(mesh, torch.tensor([edge]))
        gradient, curvature = derivatives(change.mesh, change.carry(scalar), change.is_new, camera, truth)
        assert float(model.edges.gradient[edge, 3]) == pytest.approx(gradient, abs=0.12 * scale)
        assert float(model.edges.absorption[edge]) == pytest.approx(curvature, rel=0.2)


def test_steps_of_faces_are_those_of_all() -> None:
    mesh, scalar, truth = scene()
    step = torch.linspace(-0.2, 0.2, mesh.topology.faces.shape[0]).double()
    steps = torch.nn.functional.pad(step[:, None], (3, 0))
    whole = model_image(mesh, seen(scalar), CAMERAS[0], truth, BACKGROUND)
    asked = model_image(mesh, seen(scalar), CAMERAS[0], truth, BACKGROUND, hats=HatChoice(face_steps=steps))
    assert whole.faces is not None and asked.face_steps is not None
    torch.testing.assert_close(asked.face_steps.slope, step * whole.faces.gradient[:, 3], rtol=1e-4, atol=1e-12)
    expected = step.square() * whole.faces.absorption
    torch.testing.assert_close(asked.face_steps.curvature, expected, rtol=1e-4, atol=1e-12)


def test_jumps_are_slopes_of_a_piece() -> None:
    """A step function teaches nothing by its derivatives almost everywhere; what the model says must be finite."""
    mesh, scalar, truth = scene()
    function = dtv.TransferFunction(
        torch.tensor([0.0, 0.5, 0.5, 1.0]), torch.tensor([0.0, 0.0, 1.0, 1.0]), torch.ones(4, 3)
    )
    model = model_image(mesh, seen(scalar, function), CAMERAS[0], truth)
    gradient = model.vertices.gradient[:, 3]
    assert bool(torch.isfinite(gradient).all()) and float(gradient.abs().max()) > 0


def test_scalars_of_cells_are_refused() -> None:
    mesh, _, truth = scene()
    cells = torch.rand(mesh.num_cells).double()
    with pytest.raises(dtv.MeshError, match="on vertices"):
        model_image(mesh, seen(cells), CAMERAS[0], truth)
