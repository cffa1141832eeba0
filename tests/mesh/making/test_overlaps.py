"""Cells that overlap without being neighbours: found wherever they are, and only there."""

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

import difftetvr as dtv
from difftetvr.mesh.making.overlaps import overlapping_cells, sampled_overlap


def pushed_together(shift, cells=4):
    """Two boxes of tetrahedra, the second moved along x."""
    one = dtv.TetMesh.grid((cells,) * 3)
    other = one.vertices + torch.tensor([shift, 0.013, 0.017])
    return dtv.TetMesh(torch.cat((one.vertices, other)), torch.cat((one.tets, one.tets + one.num_vertices)))


@pytest.mark.parametrize(("shift", "found"), [(0.5, True), (0.98, True), (1.0, False), (1.2, False), (0.0, True)])
def test_boxes_overlap_or_only_touch(shift, found):
    mesh = pushed_together(shift)
    overlap = sampled_overlap(mesh)
    assert (overlap is not None) == found and bool(overlapping_cells(mesh).any()) == found
    if overlap is not None:
        lower, upper = (shift, 0.0, 0.0), (1.0, 1.013, 1.017)
        assert all(low <= x <= high for low, x, high in zip(lower, overlap.place, upper, strict=True))
        assert 0 < overlap.share <= 1


@pytest.mark.parametrize("unit", [1e-150, 1e150, 1e307])
def test_the_unit_of_length_does_not_matter(unit):
    mesh = pushed_together(0.5)
    scaled = dtv.TetMesh(mesh.vertices.double() * unit, mesh.tets)
    assert overlapping_cells(scaled).equal(overlapping_cells(mesh))
    assert sampled_overlap(scaled).share == sampled_overlap(mesh).share


def test_cells_deep_inside_count_too():
    mesh = pushed_together(0.5, 8)
    found = overlapping_cells(mesh)
    middles = mesh.vertices[mesh.tets.long()].mean(1)
    assert bool(found[(middles[:, 0] > 0.6) & (middles[:, 0] < 0.9)].float().mean() > 0.9)
    assert not found[(middles[:, 0] < 0.35) | (middles[:, 0] > 1.15)].any()


def test_a_mesh_that_lies_twice_in_one_place():
    one = dtv.TetMesh.delaunay(torch.rand(60, 3, generator=torch.Generator().manual_seed(0)))
    twice = dtv.TetMesh(torch.cat((one.vertices,) * 2), torch.cat((one.tets, one.tets + one.num_vertices)))
    assert sampled_overlap(twice).share == 1.0
    found = overlapping_cells(twice)
    assert found.all()


@pytest.mark.parametrize(
    "mesh",
    [dtv.TetMesh.grid((5, 4, 3)), dtv.TetMesh.delaunay(np.random.default_rng(0).random((300, 3)))],
    ids=["grid", "delaunay"],
)
def test_sound_meshes_have_none(mesh):
    assert sampled_overlap(mesh) is None and not overlapping_cells(mesh).any()


def interiors_meet(one, other):
    """Whether a point has all weights of at least 1e-4 in both cells: a linear program."""
    systems = [np.linalg.inv(np.vstack((cell.T, np.ones(4)))) for cell in (one, other)]
    rows = np.concatenate([-system[:, :3] for system in systems])
    limits = np.concatenate([system[:, 3] for system in systems]) - 1e-4
    return linprog(np.zeros(3), rows, limits, bounds=(None, None)).status == 0


@given(st.integers(0, 2**31), st.integers(0, 3))
@examples(120)
def test_pairs_of_cells_as_a_linear_program_sees_them(seed, shared):
    points = np.random.default_rng(seed).integers(0, 7, (8, 3)).astype(float)
    tets = np.array([[0, 1, 2, 3], [*range(shared), *range(4, 8 - shared)]])
    volumes = [np.linalg.det(points[t[1:]] - points[t[0]]) for t in tets]
    if min(map(abs, volumes)) < 0.5:
        return
    mesh = dtv.TetMesh(torch.from_numpy(points), tets, conforming=False)
    assert bool(overlapping_cells(mesh).all()) == interiors_meet(points[tets[0]], points[tets[1]])
