"""Repair: what comes out is valid and fills the same space, and the report says what was done."""

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.making.repair import RepairReport, repair

TETS = [[0, 1, 2, 3]]
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def arrays(shape=(3, 3, 2)):
    mesh = TetMesh.grid(shape, (0, 0, 0), shape, dtype=torch.float64)
    return mesh.vertices.numpy().copy(), mesh.tets.numpy().astype(np.int64)


def volume(repaired):
    return float(repaired.mesh.volumes().double().sum())


def assert_valid(repaired, vertices, tets):
    """Valid, and its maps lead back to the given arrays."""
    mesh = repaired.mesh
    TetMesh(mesh.vertices, mesh.tets)
    assert torch.equal(mesh.without_unused_vertices()[1], torch.arange(mesh.num_vertices))
    origins, cells = repaired.vertex_origins, repaired.cell_origins
    assert torch.equal(repaired.vertex_map[origins], torch.arange(mesh.num_vertices))
    given_cells = repaired.vertex_map[torch.as_tensor(tets)[cells]].sort(1).values
    assert torch.equal(given_cells, mesh.tets.long().sort(1).values)
    stayed = (mesh.vertices == torch.as_tensor(vertices)[origins]).all(1)
    assert int((~stayed).sum()) == repaired.report.moved_vertices
    return stayed


def with_point_on_face(vertices, tets, cell, face, weights):
    """Cuts a cell in four from a point on its face, of which one is flat; the cell on the other side stays whole."""
    corners = np.delete(tets[cell], face)
    vertices = np.concatenate((vertices, (weights @ vertices[corners])[None]))
    new, apex = len(vertices) - 1, tets[cell, face]
    pieces = [
        [new, corners[0], corners[1], apex],
        [new, corners[1], corners[2], apex],
        [new, corners[2], corners[0], apex],
    ]
    pieces.append([new, *corners])
    return vertices, np.concatenate((np.delete(tets, cell, 0), pieces))


@examples(13)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 6), dtype=st.sampled_from([np.float32, np.float64]))
def test_points_on_faces(seed, count, dtype):
    rng = np.random.default_rng(seed)
    vertices, tets = arrays()
    for _ in range(count):
        weights = np.array([0.25, 0.25, 0.5])  # exact, so that the cell is flat to the bit
        corners = vertices[tets]
        whole = np.flatnonzero(np.linalg.det(corners[:, 1:] - corners[:, :1]))
        vertices, tets = with_point_on_face(vertices, tets, rng.choice(whole), rng.integers(4), weights)
    vertices = vertices.astype(dtype)
    repaired = repair(vertices, rng.permuted(tets, axis=1))
    stayed = assert_valid(repaired, vertices, tets)
    report = repaired.report
    assert report.collapsed_cells + report.dropped_cells + report.lifted_cells + report.repeated_cells >= 1
    moved_area = 60 * report.largest_move  # the box's surface, times how far it may have moved
    assert volume(repaired) == pytest.approx(18.0, abs=1e-4 + moved_area)
    linear = torch.as_tensor(vertices).double() @ torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    carried = linear[repaired.vertex_origins]
    exact = repaired.mesh.vertices.double() @ torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    assert torch.equal(carried[stayed], exact[stayed])
    assert repaired.mesh.vertices.dtype == torch.as_tensor(vertices).dtype


@examples(13)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0, 1))
def test_duplicated_vertices_and_cells(seed, share):
    """A soup whose cells have vertices of their own becomes the mesh that it came from."""
    rng = np.random.default_rng(seed)
    vertices, tets = arrays()
    own = rng.random(tets.shape) < share
    soup = np.concatenate((vertices, vertices[tets[own]]))
    cells = tets.copy()
    cells[own] = len(vertices) + np.arange(own.sum())
    copies = rng.integers(0, len(cells), 5)
    cells = np.concatenate((cells, rng.permuted(cells[copies], axis=1)))
    repaired = repair(soup, cells)
    assert_valid(repaired, soup, cells)
    assert repaired.mesh.num_cells == len(tets)
    assert repaired.mesh.num_vertices == len(vertices)
    assert len(repaired.mesh.topology.boundary_faces) == 4 * (9 + 6 + 6)
    assert repaired.report.repeated_cells == 5
    assert volume(repaired) == pytest.approx(18.0)


@examples(13)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_vertex_collapsed_onto_another_closes_up(seed):
    """A column of vertices falls onto its neighbours, as on the axis of a curvilinear grid."""
    vertices, tets = arrays((3, 2, 3))
    rng = np.random.default_rng(seed)
    axis_x = (vertices[:, 0] == 0) & (vertices[:, 1] <= 1)
    vertices[axis_x, 1] = 1.0  # y = 0 and y = 1 meet on the face x = 0
    order = rng.permutation(len(tets))
    repaired = repair(vertices, tets[order])
    assert_valid(repaired, vertices, tets[order])
    assert repaired.report.merged_vertices == 4
    assert repaired.report.collapsed_cells > 0
    assert repaired.report.moved_vertices == 0
    assert volume(repaired) == pytest.approx(18.0 - 1.5)
    assert repaired.report.touching_edges == 0


@pytest.mark.parametrize("count", [3, 4, 6])
def test_lattices_of_qhull(count):
    """Cubes cut by Qhull as it likes: slivers of four points of a square, on the hull and inside."""
    points = np.stack(np.meshgrid(*[np.arange(count)] * 3), -1).reshape(-1, 3).astype(float)
    cells = Delaunay(points).simplices
    repaired = repair(points, cells)
    assert_valid(repaired, points, cells)
    assert repaired.report.dropped_cells > 0
    assert volume(repaired) == pytest.approx((count - 1) ** 3, rel=1e-12)
    assert torch.equal(repaired.mesh.bounds(), torch.tensor([[0.0] * 3, [count - 1.0] * 3]).double())


@pytest.mark.parametrize("unit", [1e-30, 1.0, 1e12])
def test_the_unit_of_length_does_not_matter(unit):
    vertices, tets = with_point_on_face(*arrays(), 40, 2, np.array([0.25, 0.25, 0.5]))
    one, other = repair(vertices, tets), repair(vertices * 2.0 ** round(np.log2(unit)), tets)
    assert torch.equal(one.mesh.tets, other.mesh.tets)
    assert one.report.relative_move == pytest.approx(other.report.relative_move)


def test_a_valid_mesh_stays_as_it_is():
    vertices, tets = arrays()
    repaired = repair(vertices, tets)
    assert torch.equal(repaired.mesh.tets.long(), torch.from_numpy(tets))
    assert np.array_equal(repaired.mesh.vertices.numpy(), vertices)
    assert not repaired.report.changed
    assert str(repaired.report) == "Nothing had to be changed."


def test_a_flat_fin_and_its_vertex_are_dropped():
    vertices = np.concatenate((CORNERS, [[0.25, 0.25, 0.0]]))
    repaired = repair(vertices, [*TETS, [0, 1, 2, 4]])
    assert repaired.report == RepairReport(dropped_cells=1, dropped_vertices=1)
    assert repaired.vertex_map.tolist() == [0, 1, 2, 3, -1]
    assert (
        str(repaired.report) == "1 flat cell on the boundary was dropped and 1 vertex that is unused now was dropped."
    )


def test_crossed_diagonals_are_told():
    """Two cubes whose common face is cut along different diagonals share the face's edges, but no face."""
    mesh = TetMesh.grid((1, 1, 1), dtype=torch.float64)
    cells = torch.cat((mesh.tets, mesh.tets + 8))
    shifted = mesh.vertices + torch.tensor([1.0, 0.0, 0.0])
    assert repair(torch.cat((mesh.vertices, shifted)), cells).report.touching_edges == 0
    mirrored = shifted * torch.tensor([1.0, 1.0, -1.0]) + torch.tensor([0.0, 0.0, 1.0])
    report = repair(torch.cat((mesh.vertices, mirrored)), cells).report
    assert report.touching_edges == 4
    assert "touches itself along 4 edges" in str(report)


@pytest.mark.parametrize(
    ("vertices", "tets", "message"),
    [
        (CORNERS * [1, 1, 0], TETS, "nothing is left"),
        (CORNERS * np.nan, TETS, "finite position"),
        (CORNERS, [[0, 1, 2, 7]], "out of range"),
        (np.concatenate((CORNERS, [[0.2, 0.2, 2.0]])), [*TETS, [0, 1, 2, 4]], "cannot be repaired.*overlaps"),
    ],
)
def test_what_cannot_be_repaired_is_one_sentence(vertices, tets, message):
    with pytest.raises(MeshError, match=message):
        repair(vertices, tets)


def test_flat_cells_that_no_move_can_lift():
    """A square cut along both diagonals between two pyramids: one sliver can be lifted, three on top of it cannot."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1], [0.5, 0.5, -1]])
    cells = [[0, 1, 2, 4], [0, 2, 3, 4], [0, 1, 3, 5], [1, 2, 3, 5], [0, 1, 2, 3]]
    assert repair(corners, cells).report.lifted_cells == 1
    with pytest.raises(MeshError, match="Moving a vertex cannot mend 3 flat cells inside the mesh"):
        repair(np.concatenate((corners, [[0.5, 0.25, 0.0]])), [*cells, [0, 1, 2, 6], [0, 1, 3, 6]])


@pytest.mark.parametrize(("name", "cells", "merged"), [("bluntfin", 187_318, 39), ("oxygen-post", 513_375, 1_444)])
def test_classics(shared_data, name, cells, merged):
    path = shared_data / "meshes" / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"no {path}")
    with np.load(path) as archive:
        vertices, tets = archive["vertices"], archive["tets"]
    repaired = repair(vertices, tets)
    assert repaired.mesh.num_cells == cells
    assert repaired.report.merged_vertices == merged
    assert repaired.report.moved_vertices == 0
    before = torch.from_numpy(vertices).double()[torch.from_numpy(tets).long()]
    total = torch.linalg.det(before[:, 1:] - before[:, :1]).abs().sum() / 6
    assert volume(repaired) == pytest.approx(float(total), rel=1e-6)
