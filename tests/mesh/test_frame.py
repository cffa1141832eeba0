"""Meshes far from the origin: what single precision keeps of them, and that the world does not notice."""

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st

import difftetvr as dtv
from difftetvr.mesh import bisect_edges, remove_cells
from difftetvr.mesh.frame import WORLD, origin_for

UTM, ECEF = (693_000.0, 5_336_000.0, 520.0), (4.2e6, 1.7e5, 4.78e6)


def far_mesh(offset=UTM, scale=1.0, shape=(3, 3, 3)):
    """The same mesh at the origin, and far from it; both float64."""
    near = dtv.TetMesh.grid(shape, dtype=torch.float64)
    near = near.with_vertices(near.vertices * scale)
    return near, near.with_vertices(near.vertices + torch.tensor(offset, dtype=torch.float64))


@pytest.mark.parametrize(
    ("offset", "scale"), [(UTM, 10.0), (UTM, 100.0), (ECEF, 1.0), (ECEF, 1e-3), ((0, 0, -1e9), 5.0)]
)
def test_rounding_keeps_the_shape_and_knows_where_it_is(offset, scale):
    near, far = far_mesh(offset, scale)
    single = far.to(dtype=torch.float32)
    assert single.vertices.dtype == torch.float32 and single.origin != WORLD
    assert single.vertices.abs().max() <= 2 * scale
    error = (single.positions - far.vertices).abs().max()
    assert float(error) <= 1e-6 * scale + np.spacing(max(map(abs, offset)))
    assert torch.allclose(single.volumes().double(), near.volumes(), rtol=1e-3)
    assert torch.equal(single.bounds(), torch.stack((single.positions.amin(0), single.positions.amax(0))))


def test_near_meshes_and_float64_ones_count_from_the_world():
    near, far = far_mesh()
    assert near.to(dtype=torch.float32).origin == WORLD and far.origin == WORLD
    assert torch.equal(near.bounds()[1], near.vertices.amax(0)) and near.bounds().dtype == torch.float64
    assert far.with_origin() is far
    assert origin_for(torch.zeros(0, 3)) == WORLD and origin_for(torch.ones(5, 3)) == WORLD


@given(
    st.lists(st.floats(-1e7, 1e7, width=32), min_size=3, max_size=3),
    st.floats(2**-10, 1e5, width=32),
    st.integers(0, 2**31),
)
@examples(60)
def test_positions_that_were_single_already_lose_no_digit(offset, size, seed):
    points = np.random.default_rng(seed).uniform(0, size, (20, 3)) + np.array(offset)
    vertices = torch.from_numpy(points.astype(np.float32))
    origin = origin_for(vertices)
    moved = (vertices.double() - torch.tensor(origin, dtype=torch.float64)).float()
    assert torch.equal((moved.double() + torch.tensor(origin, dtype=torch.float64)).float(), vertices)


def test_an_origin_can_be_left_again_unless_that_flattens_cells():
    _, far = far_mesh(ECEF, 1.0)
    single = far.to(dtype=torch.float32)
    closer = single.with_origin((4.2e6, 1.7e5, 4.78e6 + 2.0))
    assert (closer.positions - single.positions).abs().max() < 3e-7
    with pytest.raises(dtv.MeshError, match=r"volume is zero|inside out"):
        single.with_origin(WORLD)
    with pytest.raises(dtv.MeshError, match="volume is zero"):
        dtv.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1e-60]], [[0, 1, 2, 3]])


def test_lists_are_rounded_only_after_they_have_an_origin():
    _, far = far_mesh(UTM, 0.5)
    assert torch.equal(dtv.TetMesh(far.vertices.tolist(), far.tets).vertices, far.to(dtype=torch.float32).vertices)


def test_changes_of_the_mesh_stay_where_it_is():
    _, far = far_mesh(ECEF, 1.0)
    single = far.to(dtype=torch.float32)
    removed = torch.zeros(single.num_cells, dtype=torch.bool)
    removed[:7] = True
    for change in (remove_cells(single, removed), bisect_edges(single, torch.tensor([0, 5]))):
        assert change.mesh.origin == single.origin
        assert (change.mesh.bounds() - single.bounds()).abs().max() < 1e-6
    assert single.with_vertices(single.vertices.clone()).origin == single.origin
    assert single.to(dtype=torch.float64).origin == single.origin
