"""Convex and Delaunay, or not: against meshes that are so by construction, and the same with one thing spoilt."""

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st

from difftetvr.mesh import TetMesh
from difftetvr.mesh.making.delaunay_check import is_convex, is_delaunay

seeds = st.integers(0, 2**32 - 1)
properties = examples(5)

CORNERS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def point_sets(seed):
    rng = np.random.default_rng(seed)
    sphere = rng.normal(size=(150, 3))
    clusters = rng.random((8, 1, 3)) + 10.0 ** -rng.uniform(0, 4, (8, 1, 1)) * rng.normal(size=(8, 20, 3))
    lattice = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), -1).reshape(-1, 3)
    return {
        "uniform": rng.random((150, 3)),
        "clusters": clusters.reshape(-1, 3),
        "sphere": sphere / np.linalg.norm(sphere, axis=1, keepdims=True),
        "shell": np.concatenate((sphere / np.linalg.norm(sphere, axis=1, keepdims=True), [[0.1, 0.2, 0.3]])),
        "lattice": lattice,
        "noisy lattice": lattice + 1e-3 * rng.normal(size=lattice.shape),
        "boxes": lattice * [1.0, 0.1, 7.0],
        "few": rng.random((5, 3)),
    }


def rotation(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return torch.from_numpy(q * np.sign(np.linalg.det(q)))


def moved(mesh, matrix):
    return mesh.with_vertices((mesh.vertices.double() @ matrix.T).to(mesh.vertices.dtype))


def both(mesh):
    return is_convex(mesh.vertices, mesh.topology), is_delaunay(mesh.vertices, mesh.topology)


@properties
@given(seed=seeds, dtype=st.sampled_from([np.float32, np.float64]))
def test_delaunay_meshes_pass(seed, dtype):
    for name, points in point_sets(seed).items():
        assert both(TetMesh.delaunay(points.astype(dtype))) == (True, True), name


@properties
@given(seed=seeds, unit=st.sampled_from([1e-30, 1e-3, 1.0, 1e6, 1e30]))
def test_neither_frame_nor_unit_of_length_matters(seed, unit):
    mesh = TetMesh.delaunay(np.random.default_rng(seed).random((40, 3)))
    assert both(moved(mesh, rotation(seed) * unit)) == (True, True)
    assert both(mesh.with_vertices(mesh.vertices + 1e6)) == (True, True)
    stretched = moved(mesh, rotation(seed) @ torch.diag(torch.tensor([1.0, 1.0, 8.0])).double() * unit)
    assert both(stretched) == (True, False)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 3, 4), (20, 1, 1)])
def test_grids_are_delaunay_at_any_aspect_and_angle(dtype, shape):
    for upper in ((1.0, 1.0, 1.0), (1.0, 0.01, 30.0)):
        mesh = TetMesh.grid(shape, upper=upper, dtype=dtype)
        assert both(mesh) == (True, True)
        for seed in range(5):
            assert both(moved(mesh, rotation(seed))) == (True, True)


def test_grids_squeezed_along_the_diagonal_of_their_cubes_are_delaunay_and_stretched_are_not():
    mesh = TetMesh.grid((4, 4, 4))
    along = torch.full((3, 3), 1.0 / 3.0, dtype=torch.float64)
    for factor, expected in ((0.5, True), (0.9, True), (1.1, False), (2.0, False)):
        assert both(moved(mesh, torch.eye(3).double() + (factor - 1.0) * along)) == (True, expected)
    shear = torch.tensor([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]).double()
    assert both(moved(mesh, shear)) == (True, False)


@properties
@given(seed=seeds)
def test_a_vertex_pushed_into_a_sphere_is_found(seed):
    """The far vertex of a neighbour lies just inside or just outside the sphere, below the face that they share."""
    # So near the corner the two cells together are convex.
    below = np.array([*np.random.default_rng(seed).uniform(0.1, 0.22, 2), 0.0])
    center = np.array([0.5, 0.5, 0.5])
    outwards = (below - center) / np.linalg.norm(below - center)
    for depth, expected in ((1e-4, False), (-1e-4, True)):
        tip = center + (1.0 - depth) * np.sqrt(0.75) * outwards
        assert both(TetMesh(np.array([*CORNERS, tip]), [[0, 1, 2, 3], [0, 1, 2, 4]])) == (True, expected)


@properties
@given(seed=seeds)
def test_perturbed_vertices_fail(seed):
    rng = np.random.default_rng(seed)
    mesh = TetMesh.delaunay(rng.random((200, 3)))
    inner = torch.ones(mesh.num_vertices, dtype=torch.bool)
    inner[mesh.topology.boundary_faces.view(-1).long()] = False
    step = mesh.vertex_altitudes()[:, None] * torch.from_numpy(rng.uniform(-0.5, 0.5, (mesh.num_vertices, 3)))
    perturbed = mesh.with_vertices(torch.where(inner[:, None], mesh.vertices + step, mesh.vertices))
    assert both(perturbed) == (True, False)


@properties
@given(seed=seeds)
def test_dents_and_hollows_fail(seed):
    rng = np.random.default_rng(seed)
    mesh = TetMesh.delaunay(rng.random((60, 3)))
    outer_faces = (mesh.topology.cell_adjacency < 0).sum(1)
    for count in (1, 0):
        candidates = torch.nonzero((outer_faces == count) & (mesh.quality() > 0.05)).squeeze(1)
        kept = np.arange(mesh.num_cells) != rng.choice(candidates)
        assert both(TetMesh(mesh.vertices, mesh.tets[kept])) == (False, False)


def test_components_that_are_convex_each_fail():
    one = TetMesh.grid((2, 2, 2))
    for offset in ((5.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1.0, 1.0, 0.0)):
        other = one.vertices + torch.tensor(offset)
        vertices, indices = torch.unique(torch.cat((one.vertices, other)), dim=0, return_inverse=True)
        tets = indices[torch.cat((one.tets, one.tets + one.num_vertices)).long()]
        assert both(TetMesh(vertices, tets)) == (False, False)


def test_a_single_cell_and_vertices_that_no_cell_uses():
    assert both(TetMesh(CORNERS, [[0, 1, 2, 3]])) == (True, True)
    assert both(TetMesh([*CORNERS, [0.2, 0.2, 0.2], [9e9, 0, 0]], [[0, 1, 2, 3]])) == (True, True)


@pytest.mark.gpu
def test_on_a_gpu():
    mesh = TetMesh.delaunay(np.random.default_rng(0).random((500, 3))).to("cuda")
    assert both(mesh) == (True, True)
    assert both(moved(mesh, torch.diag(torch.tensor([1.0, 1.0, 8.0])).double().cuda())) == (True, False)
