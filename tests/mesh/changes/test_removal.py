"""Removal of cells and Delaunay insertion, and every change after every other."""

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import example, given
from mesh.changes.checks import SEEDS, cells_of, check_change, random_mesh

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.changes.bisection import bisect_edges, independent_edges, long_edges
from difftetvr.mesh.changes.collapse import collapse_edges
from difftetvr.mesh.changes.insertion import insert_delaunay
from difftetvr.mesh.changes.removal import remove_cells
from difftetvr.mesh.changes.star import star_subdivision
from difftetvr.mesh.locate import locate, search


@examples(15)
@given(seed=SEEDS)
def test_removal_keeps_the_rest_as_it_is(seed):
    mesh = random_mesh(seed)
    mesh.topology.cell_adjacency  # noqa: B018
    removed = torch.rand(mesh.num_cells, generator=torch.Generator().manual_seed(seed)) < (0.1, 0.9)[seed % 2]
    removed[seed % mesh.num_cells] = False
    change = remove_cells(mesh, removed)
    new = change.mesh
    rebuilt = TetMesh(new.vertices, new.tets)
    assert torch.equal(rebuilt.tets, new.tets)
    assert torch.equal(rebuilt.topology.cell_adjacency, new.topology.cell_adjacency)
    assert new.tets.unique().numel() == new.num_vertices and not change.is_new.any()
    assert torch.equal(change.parents[:, 0][new.tets.long()], mesh.tets[~removed])
    assert torch.equal(change.carry_cells(mesh.volumes()), new.volumes())
    assert torch.equal(change.carry(mesh.vertices), new.vertices)
    assert (change.parents[:, 0].diff() > 0).all()


def test_removal_refuses_other_masks_and_to_leave_nothing():
    mesh = TetMesh.grid((1, 1, 1))
    with pytest.raises(MeshError, match="All cells would be removed"):
        remove_cells(mesh, torch.ones(6, dtype=torch.bool))
    for mask in (torch.zeros(6), torch.zeros(5, dtype=torch.bool)):
        with pytest.raises(MeshError, match="one bool for each of the 6 cells"):
            remove_cells(mesh, mask)


def random_change(mesh, generator):
    """One change of a random kind."""
    kind = int(torch.randint(0, 4, (), generator=generator))
    count = len(mesh.topology.edges)
    scores = torch.rand(count, generator=generator)
    if kind == 0:
        return bisect_edges(mesh, independent_edges(mesh, scores, long_edges(mesh), budget=mesh.num_cells // 3))
    if kind == 1:
        ends = torch.randint(0, 2, (count,), generator=generator)
        return collapse_edges(mesh, torch.arange(count), ends, scores, limit=mesh.num_cells // 5)
    if kind == 2:
        return star_subdivision(mesh, torch.randint(0, mesh.num_vertices, (2,), generator=generator))
    removed = torch.rand(mesh.num_cells, generator=generator) < 0.05
    removed[0] = False
    return remove_cells(mesh, removed)


@examples(13)
@given(seed=SEEDS)
def test_any_changes_in_a_row(seed):
    mesh = random_mesh(seed, torch.float64 if seed % 2 else torch.float32)
    generator = torch.Generator().manual_seed(seed)
    origin = mesh.vertices.double()
    matrix = torch.tensor([[1.0, 2.0], [-3.0, 0.5], [0.25, 4.0]], dtype=torch.float64)
    values = origin @ matrix
    for _ in range(5):
        change = random_change(mesh, generator)
        if change.mesh.num_cells >= mesh.num_cells:
            check_change(mesh, change)
        rebuilt = TetMesh(change.mesh.vertices, change.mesh.tets)
        assert torch.equal(rebuilt.tets, change.mesh.tets)
        values, mesh = change.carry(values), change.mesh
    exact = mesh.vertices.double() @ matrix
    assert (values - exact).abs().max() <= 1e-5 * origin.abs().max() * 10


@examples(8)
@given(seed=SEEDS)
@example(seed=217081)  # a point that lies beside a face by less than points are located to
def test_insertion_is_the_delaunay_mesh_with_values_of_the_old_one(seed):
    mesh = random_mesh(seed)
    rng = np.random.default_rng(seed)
    weights = torch.from_numpy(rng.dirichlet(np.ones(4), 12))
    cells = torch.from_numpy(rng.integers(0, mesh.num_cells, 12))
    points = (mesh.vertices[mesh.tets[cells].long()] * weights[:, :, None]).sum(1)
    change = insert_delaunay(mesh, points)
    new = change.mesh
    assert cells_of(new) == cells_of(TetMesh.delaunay(torch.cat((mesh.vertices, points))))
    assert torch.equal(new.vertices, torch.cat((mesh.vertices, points)))
    assert change.is_new.tolist() == [False] * mesh.num_vertices + [True] * 12
    matrix = torch.tensor([[1.0, 2.0], [-3.0, 0.5], [0.25, 4.0]], dtype=torch.float64)
    values = mesh.vertices @ matrix
    carried = change.carry(values)
    assert torch.equal(carried[: mesh.num_vertices], values)
    assert torch.allclose(carried, new.vertices @ matrix, rtol=1e-9, atol=1e-9 * float(values.abs().max()))
    assert torch.equal(change.corners.sort(1).values, mesh.tets[cells].sort(1).values)
    heaviest = change.corners.gather(1, change.corner_weights.argmax(1, keepdim=True))[:, 0]
    assert torch.equal(change.parents[mesh.num_vertices :, 0], heaviest)


def test_insertion_at_vertices_faces_and_outside():
    mesh = TetMesh.grid((2, 2, 2))
    points = [[0.5, 0.5, 0.5], [0.3, 0.0, 0.1], [0.3, 0.0, 0.1], [0.0, 0.25, 0.0]]
    change = insert_delaunay(mesh, points)
    assert change.mesh.num_vertices == mesh.num_vertices + 2
    assert torch.allclose(change.carry(mesh.vertices), change.mesh.vertices, atol=1e-6)
    assert (change.corner_weights >= 0).all()
    with pytest.raises(MeshError, match=r"Point 1 at \(0.5, 0.5, 1.01\) lies outside"):
        insert_delaunay(mesh, [[0.3, 0.3, 0.3], [0.5, 0.5, 1.01]])
    with pytest.raises(MeshError, match="Point 0 is at"):
        insert_delaunay(mesh, [[0.3, float("nan"), 0.3]])
    hollow = remove_cells(mesh, torch.arange(mesh.num_cells) < 6).mesh
    with pytest.raises(MeshError, match="outside the mesh"):
        insert_delaunay(hollow, [[0.1, 0.2, 0.3]])


@examples(8)
@given(seed=SEEDS)
def test_points_are_found_in_their_cells_also_where_the_mesh_is_not_convex(seed):
    mesh = random_mesh(seed)
    generator = torch.Generator().manual_seed(seed)
    if seed % 2:
        removed = torch.rand(mesh.num_cells, generator=generator) < 0.3
        removed[0] = False
        mesh = remove_cells(mesh, removed).mesh
    centroids = mesh.vertices[mesh.tets.long()].mean(1)
    cells, weights, found = locate(mesh, centroids)
    expected = torch.arange(mesh.num_cells)
    assert torch.equal(cells[found], expected[found]) and torch.allclose(weights[found], torch.tensor(0.25).double())
    assert found.all() or seed % 2
    for i in range(0, mesh.num_cells, max(mesh.num_cells // 5, 1)):
        cell, weights_there = search(mesh, centroids[i])
        assert cell == i and torch.allclose(weights_there, torch.tensor(0.25).double())
