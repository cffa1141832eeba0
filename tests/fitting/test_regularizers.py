import math

import pytest
import torch

from difftetvr import TetMesh
from difftetvr.errors import FitError
from difftetvr.fitting.regularizers import shape_barrier, softplus_regularizer

REGULAR = [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]


def jittered(seed=0, inverted=False):
    mesh = TetMesh.grid((2, 2, 1), dtype=torch.float64)
    noise = torch.rand(mesh.vertices.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return mesh.with_vertices(mesh.vertices + (1.5 if inverted else 0.2) * (noise - 0.5))


@pytest.mark.parametrize("term", [softplus_regularizer, lambda mesh: softplus_regularizer(mesh, 3.0), shape_barrier])
def test_gradient(term):
    mesh = jittered()
    vertices = mesh.vertices.requires_grad_()
    assert torch.autograd.gradcheck(lambda v: term(mesh.with_vertices(v)), vertices)


def test_gradient_with_inverted_cells():
    mesh = jittered(1, inverted=True)
    assert (mesh.volumes() < 0).any()
    vertices = mesh.vertices.requires_grad_()
    assert torch.autograd.gradcheck(lambda v: softplus_regularizer(mesh.with_vertices(v), 10.0), vertices)


def test_values_follow_the_article():
    """A regular tetrahedron has Q = 1, so the 1/6 is there; well shaped costs little, so the minus sign is."""
    mesh = TetMesh(torch.tensor(REGULAR, dtype=torch.float64), [[0, 1, 2, 3]])
    assert softplus_regularizer(mesh, 10.0).item() == pytest.approx(math.log1p(math.exp(-10)) / 10, rel=1e-9)
    assert shape_barrier(mesh).item() == pytest.approx(0.0, abs=1e-12)
    mirrored = mesh.with_vertices(mesh.vertices * torch.tensor([1.0, 1.0, -1.0]))
    assert softplus_regularizer(mirrored, 10.0).item() == pytest.approx(math.log1p(math.exp(10)) / 10, rel=1e-9)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_no_unit_of_length(scale):
    mesh = jittered()
    scaled = mesh.with_vertices(mesh.vertices * scale)
    assert softplus_regularizer(scaled).item() == pytest.approx(softplus_regularizer(mesh).item(), rel=1e-9)
    assert shape_barrier(scaled).item() == pytest.approx(shape_barrier(mesh).item(), rel=1e-9)


def test_mean_over_cells():
    one = TetMesh.grid((1, 1, 1))
    many = TetMesh.grid((3, 3, 3))
    assert softplus_regularizer(many, 5.0).item() == pytest.approx(softplus_regularizer(one, 5.0).item(), rel=1e-5)


def test_steep_softplus_stays_finite():
    mesh = TetMesh.grid((1, 1, 1))
    mirrored = mesh.with_vertices((mesh.vertices * torch.tensor([1.0, 1.0, -1.0])).requires_grad_())
    value = softplus_regularizer(mirrored, 1e4)
    value.backward()
    assert value.item() == pytest.approx(-mirrored.quality().mean().item(), rel=1e-5)
    assert torch.isfinite(mirrored.vertices.grad).all()


def test_descent_rounds_a_thin_tetrahedron():
    """The article's Fig. 2: without images, a tetrahedron approaches the regular one."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 0.1]], dtype=torch.float64).requires_grad_()
    mesh = TetMesh(vertices, [[0, 1, 2, 3]])
    assert mesh.quality().item() < 0.25
    optimizer = torch.optim.Adam([vertices], lr=0.01)
    for _ in range(300):
        optimizer.zero_grad()
        softplus_regularizer(mesh.with_vertices(vertices), 10.0).backward()
        optimizer.step()
    assert mesh.with_vertices(vertices).quality().item() > 0.9


@pytest.mark.parametrize("beta", [0.0, -1.0, math.inf, math.nan])
def test_refuses_senseless_beta(beta):
    with pytest.raises(FitError, match="beta"):
        softplus_regularizer(TetMesh.grid((1, 1, 1)), beta)
