"""Volumes, altitudes and quality: known cells, invariances, gradients."""

import math

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st

from difftetvr.mesh import TetMesh, quality

REGULAR = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64)


def test_regular_tetrahedron():
    mesh = TetMesh(REGULAR, [[0, 1, 2, 3]])
    edge = math.sqrt(8)
    assert mesh.volumes()[0].item() == pytest.approx(edge**3 / (6 * math.sqrt(2)))
    assert mesh.quality()[0].item() == pytest.approx(1.0)
    assert mesh.altitudes()[0].tolist() == pytest.approx([edge * math.sqrt(2 / 3)] * 4)


def test_corner_cell():
    mesh = TetMesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    assert mesh.volumes()[0].item() == pytest.approx(1 / 6)
    assert mesh.altitudes()[0].tolist() == pytest.approx([1 / math.sqrt(3), 1, 1, 1])
    assert mesh.quality()[0].item() == pytest.approx(6 * math.sqrt(2) / 6 / 1.5**1.5)


@examples(15)
@given(seed=st.integers(0, 2**32 - 1), exponent=st.integers(-12, 12))
def test_invariant_under_motion_and_scale(seed, exponent):
    rng = np.random.default_rng(seed)
    mesh = TetMesh.delaunay(rng.random((20, 3)))
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    scale = 10.0**exponent
    moved = mesh.with_vertices(scale * (mesh.vertices @ torch.from_numpy(rotation) + 3.0))
    assert torch.allclose(moved.quality(), mesh.quality(), rtol=1e-6, atol=1e-10)
    assert torch.allclose(moved.volumes() / scale**3, mesh.volumes(), rtol=1e-6, atol=1e-12)
    assert torch.allclose(moved.altitudes() / scale, mesh.altitudes(), rtol=1e-6, atol=1e-10)
    assert (mesh.quality() <= 1 + 1e-12).all()


def test_inverted_cells_are_negative():
    inverted = torch.tensor([[0, 1, 2, 3], [0, 1, 3, 2]], dtype=torch.int32)
    signs = [-1.0, 1.0]
    for measure in (quality.volumes, quality.quality):
        assert torch.sign(measure(REGULAR, inverted)).tolist() == signs
    assert torch.sign(quality.altitudes(REGULAR, inverted)).amin(1).tolist() == signs


@pytest.mark.parametrize("name", ["volumes", "altitudes", "quality", "vertex_altitudes"])
def test_gradients(name):
    points = torch.from_numpy(np.random.default_rng(3).random((12, 3)))
    mesh = TetMesh.delaunay(points)
    torch.autograd.gradcheck(lambda v: getattr(mesh.with_vertices(v), name)(), points.clone().requires_grad_())


@pytest.mark.parametrize("name", ["volumes", "altitudes", "quality"])
def test_same_values_with_and_without_graph(name):
    mesh = TetMesh.grid((13, 14, 15))
    plain = getattr(mesh, name)()
    with_graph = getattr(mesh.with_vertices(mesh.vertices.clone().requires_grad_()), name)()
    assert plain.dtype == torch.float32
    assert not plain.requires_grad
    assert with_graph.requires_grad
    assert torch.allclose(plain, with_graph.detach(), rtol=1e-6, atol=0)


def test_vertex_altitudes_are_the_smallest_around():
    mesh = TetMesh(
        torch.cat((REGULAR, torch.tensor([[9.0, 9, 9], [-1, -1, -1.01]], dtype=torch.float64))),
        [[0, 1, 2, 3], [1, 2, 3, 5]],
    )
    per_cell = mesh.altitudes().amin(1)
    expected = [per_cell[0], *[per_cell.min()] * 3, math.inf, per_cell[1]]
    assert mesh.vertex_altitudes().tolist() == pytest.approx([float(x) for x in expected])
