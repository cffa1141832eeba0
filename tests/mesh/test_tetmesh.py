"""Construction of TetMesh: orientation, every error, and what later steps rely on."""

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh, Topology

CORNERS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def grid_arrays():
    mesh = TetMesh.grid((2, 3, 2))
    return mesh.vertices.clone(), mesh.tets.clone()


def determinants(vertices, tets):
    corners = vertices.detach().double()[tets]
    return torch.linalg.det(corners[:, 1:] - corners[:, :1])


@examples(15)
@given(seed=st.integers(0, 2**32 - 1))
def test_any_vertex_order_becomes_positive_and_keeps_cells_and_neighbours(seed):
    rng = np.random.default_rng(seed)
    vertices, tets = grid_arrays()
    shuffled = torch.from_numpy(rng.permuted(tets.numpy(), axis=1))
    mesh = TetMesh(vertices, shuffled)
    assert (determinants(mesh.vertices, mesh.tets) > 0).all()
    assert torch.equal(mesh.tets.sort(1).values, tets.sort(1).values)
    reference = TetMesh(vertices, tets).topology.cell_adjacency
    assert torch.equal(mesh.topology.cell_adjacency.sort(1).values, reference.sort(1).values)


def test_positive_cells_stay_as_they_are_and_input_is_not_changed():
    vertices, tets = grid_arrays()
    assert torch.equal(TetMesh(vertices, tets).tets, tets)
    flipped = tets[:, [1, 0, 2, 3]]
    before = flipped.clone()
    TetMesh(vertices, flipped)
    assert torch.equal(flipped, before)
    mesh = TetMesh(vertices, tets)
    tets[0, 0] = 10**6
    assert mesh.tets.max() < mesh.num_vertices


def test_array_likes_and_dtypes():
    mesh = TetMesh(CORNERS, [[0, 1, 2, 3]])
    assert mesh.vertices.dtype == torch.float32
    assert mesh.tets.dtype == torch.int32
    for dtype in (np.uint8, np.uint64, np.int64, ">i4"):
        assert torch.equal(TetMesh(np.array(CORNERS), np.array([[0, 1, 2, 3]], dtype=dtype)).tets, mesh.tets)
    assert TetMesh(np.array(CORNERS), [[0, 1, 2, 3]]).vertices.dtype == torch.float64
    assert TetMesh(np.array(CORNERS, dtype=np.float16), [[0, 1, 2, 3]]).vertices.dtype == torch.float32
    assert repr(mesh) == "TetMesh(4 vertices, 1 cells, torch.float32, cpu)"


def test_vertices_keep_their_graph():
    leaf = torch.tensor(CORNERS, requires_grad=True)
    assert TetMesh(leaf, [[0, 1, 2, 3]]).vertices is leaf
    mesh = TetMesh(2.0 * leaf, [[0, 2, 1, 3]])
    mesh.volumes().sum().backward()
    # dV/dv_k is a third of the opposite face's inward area vector; doubled lengths give four times the area, twice.
    assert torch.allclose(leaf.grad[3], torch.tensor([0.0, 0.0, 8.0 / 6.0]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda v, t: t.__setitem__((7, 2), 999),
            r"Cell 7: its vertex index 999 is out of range.*36 vertices.*0 to 35",
        ),
        (lambda v, t: t.__setitem__((7, 2), -1), r"Cell 7: its vertex index -1"),
        (lambda v, t: v.__setitem__((0, 1), float("nan")), r"Cell 0: its vertex 0 is at \(0, nan, 0\)"),
        (lambda v, t: v.__setitem__((35, 1), float("-inf")), r"Cell 66: its vertex 35 is at \(1, -inf, 1\)"),
        (lambda v, t: t.__setitem__((7, 2), t[7, 1].item()), r"Cell 7: it uses vertex \d+ twice"),
        (lambda v, t: v.__setitem__(35, v[34]), r"Cell 69: its volume is zero, as its vertices \(19, 22, 34, 35\)"),
        (lambda v, t: v.__setitem__((slice(None), 2), 0), r"Cell 0: its volume is zero"),
        (lambda v, t: t.__setitem__(9, t[30].clone()), r"Cell 9: .* shared by 3 cells \(9, 30, \d+\)"),
        (lambda v, t: v.__setitem__(13, v[13] + 5), r"Cell \d+: it overlaps its neighbour, cell \d+"),
    ],
)
def test_errors_name_the_first_offending_cell(change, message):
    vertices, tets = grid_arrays()
    change(vertices, tets)
    with pytest.raises(MeshError, match=message):
        TetMesh(vertices, tets)


def test_unused_vertex_that_is_not_finite():
    with pytest.raises(MeshError, match="Vertex 4, which no cell uses"):
        TetMesh([*CORNERS, [np.nan, 0, 0]], [[0, 1, 2, 3]])


def test_fold_over_and_duplicates():
    fold = [*CORNERS, [0.2, 0.2, 2.0]]
    with pytest.raises(MeshError, match=r"Cell 0: it overlaps its neighbour, cell 1, .* face \(0, 2, 1\)"):
        TetMesh(fold, [[0, 1, 2, 3], [0, 1, 2, 4]])
    with pytest.raises(MeshError, match="Cell 0: it overlaps its neighbour, cell 1"):
        TetMesh(CORNERS, [[0, 1, 2, 3], [3, 1, 0, 2]])
    fan = [*CORNERS, [0.2, 0.2, -1.0], [0.2, 0.2, -2.0]]
    with pytest.raises(MeshError, match=r"Cell 0: its face .* is shared by 3 cells \(0, 1, 2\)"):
        TetMesh(fan, [[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]])


@pytest.mark.parametrize(
    ("vertices", "tets", "message"),
    [
        (np.zeros((4, 2)), [[0, 1, 2, 3]], r"shape \(4, 2\)"),
        (CORNERS, [0, 1, 2, 3], r"shape \(4,\)"),
        (CORNERS, [[0, 1, 2]], r"shape \(1, 3\)"),
        (CORNERS, np.zeros((0, 4), dtype=int), "0 cells"),
        (CORNERS, [[0.0, 1.0, 2.0, 3.0]], "pass integers"),
        (CORNERS, [[True, False, True, False]], "pass integers"),
        (np.array(CORNERS, dtype=complex), [[0, 1, 2, 3]], "complex"),
        ([["a", "b", "c"]], [[0, 1, 2, 3]], "array of numbers"),
        ([[0, 0, 0], [1, 0]], [[0, 1, 2, 3]], "array of numbers"),
        (CORNERS, [[0, 1, 2, 2**40]], "out of range"),
    ],
)
def test_wrong_shapes_and_types(vertices, tets, message):
    with pytest.raises(MeshError, match=message):
        TetMesh(vertices, tets)


@pytest.mark.parametrize("unit", [1e-300, 1e-30, 1e-12, 1.0, 1e12, 1e30, 1e300])
def test_no_unit_of_length(unit):
    dtype = torch.float64 if not 1e-35 < unit < 1e35 else torch.float32
    vertices, tets = grid_arrays()
    mesh = TetMesh((vertices.double() * unit).to(dtype), tets)
    assert torch.equal(mesh.topology.cell_adjacency, TetMesh(vertices, tets).topology.cell_adjacency)
    assert torch.allclose(mesh.quality().float(), TetMesh(vertices, tets).quality(), rtol=1e-5)
    flat = (vertices.double() * unit).to(dtype)
    flat[:, 2] = 0
    with pytest.raises(MeshError, match="Cell 0: its volume is zero"):
        TetMesh(flat, tets)


@pytest.mark.parametrize("height", [1e-3, 1e-7, 1e-12, 1e-20, 1e-38])
def test_thin_cells_pass_and_are_oriented(height):
    for sign in (1, -1):
        mesh = TetMesh([*CORNERS[:3], [0.3, 0.3, sign * height]], [[0, 1, 2, 3]])
        assert mesh.volumes()[0] == pytest.approx(height / 6, rel=1e-6)


def test_needle_far_from_its_tip_passes():
    tip, size = [1.0, 1.0, 1.0], 1e-15
    mesh = TetMesh([tip, [size, 0, 0], [0, size, 0], [0, 0, size]], [[0, 1, 2, 3]])
    assert mesh.num_cells == 1


def test_one_ulp_above_a_plane_passes_and_on_it_does_not():
    plane = np.float32([[1.1, 2.3, 0.7], [3.1, 0.3, 0.7], [0.2, 0.4, 0.7], [1.2, 1.3, 0.7]])
    with pytest.raises(MeshError, match="volume is zero"):
        TetMesh(plane, [[0, 1, 2, 3]])
    plane[3, 2] = np.nextafter(plane[3, 2], np.float32(1))
    assert TetMesh(plane, [[0, 1, 2, 3]]).volumes()[0] > 0


def test_with_vertices_shares_topology_and_validate_finds_inversion():
    mesh = TetMesh(*grid_arrays())
    moved = mesh.with_vertices(mesh.vertices * 2)
    assert moved.topology is mesh.topology
    assert moved.tets is mesh.tets
    moved.validate()
    with pytest.raises(MeshError, match="shape"):
        mesh.with_vertices(mesh.vertices[:-1])
    with pytest.raises(MeshError, match="float16"):
        mesh.with_vertices(mesh.vertices.half())
    inverted = mesh.vertices.clone()
    inverted[13] += 5
    cell = int(torch.nonzero(determinants(inverted, mesh.tets) < 0)[0])
    with pytest.raises(MeshError, match=f"Cell {cell}: the vertex positions turn it inside out"):
        mesh.with_vertices(inverted).validate()


def test_to_another_precision():
    mesh = TetMesh(*grid_arrays())
    double = mesh.to(dtype=torch.float64)
    assert double.vertices.dtype == torch.float64
    assert double.topology is mesh.topology
    assert mesh.to(dtype=torch.float32, device="cpu") is mesh
    with pytest.raises(MeshError, match="float16"):
        mesh.to(dtype=torch.float16)
    thin = double.with_vertices(double.vertices * torch.tensor([1.0, 1.0, 1e-9]) + 0.5)
    thin.validate()
    with pytest.raises(MeshError, match="Cell 0: its volume is zero"):
        thin.to(dtype=torch.float32)


def test_without_unused_vertices():
    mesh = TetMesh([[9.0, 9.0, 9.0], *CORNERS, [7.0, 7.0, 7.0]], [[1, 2, 3, 4]])
    clean, kept = mesh.without_unused_vertices()
    assert kept.tolist() == [1, 2, 3, 4]
    assert clean.tets.tolist() == [[0, 1, 2, 3]]
    assert torch.equal(clean.vertices, torch.tensor(CORNERS))
    assert torch.equal(clean.topology.cell_adjacency, TetMesh(clean.vertices, clean.tets).topology.cell_adjacency)
    again, kept = clean.without_unused_vertices()
    assert again is clean
    assert kept.tolist() == [0, 1, 2, 3]


def test_bounds_and_from_valid():
    mesh = TetMesh.from_valid(torch.tensor(CORNERS), Topology(torch.tensor([[0, 1, 2, 3]], dtype=torch.int32), 4))
    assert mesh.bounds().tolist() == [[0, 0, 0], [1, 1, 1]]


@pytest.mark.gpu
def test_builds_on_a_gpu():
    vertices, tets = grid_arrays()
    mesh = TetMesh(vertices.cuda(), tets)
    reference = TetMesh(vertices, tets)
    for name in ("cell_adjacency", "faces", "face_cells", "boundary_faces", "boundary_cells", "edges"):
        table = getattr(mesh.topology, name)
        assert table.is_cuda
        assert torch.equal(table.cpu(), getattr(reference.topology, name))
    for ours, theirs in zip(mesh.topology.vertex_cells, reference.topology.vertex_cells):
        assert torch.equal(ours.cpu(), theirs)
    assert torch.allclose(mesh.quality().cpu(), reference.quality())
