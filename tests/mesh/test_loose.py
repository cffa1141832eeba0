"""Loose cells: what still works, and that nothing answers as if they had neighbours."""

import pytest
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh, Topology, bisect_edges, star_subdivision
from difftetvr.mesh.topology.incidence import boundary_vertices, cell_edges, cell_faces

LOOSE = "This mesh is made of loose cells"


def soup():
    """Three cells at one face, a duplicate, one that pierces them, one that hangs, and two unused vertices."""
    vertices = torch.tensor(
        [
            [9, 9, 9],
            [0, 0, 0],
            [1, 0, 0],
            [0, 1, 0],
            [0, 0, 1],
            [0.2, 0.2, -1],
            [0.2, 0.2, 2],
            [0.3, 0.3, 0.1],
            [8.0] * 3,
        ]
    )
    tets = [[1, 2, 3, 4], [1, 2, 3, 5], [1, 2, 3, 6], [1, 2, 3, 4], [7, 2, 4, 5], [1, 2, 7, 5]]
    return vertices, tets


def loose_mesh():
    return TetMesh(*soup(), conforming=False)


def test_only_loose_cells_may_overlap():
    with pytest.raises(MeshError, match="shared by"):
        TetMesh(*soup())
    mesh = loose_mesh()
    assert not mesh.is_conforming
    assert (mesh.num_cells, mesh.num_vertices) == (6, 9)
    assert (mesh.volumes() > 0).all()
    mesh.validate()
    assert TetMesh(mesh.vertices[1:5], [[0, 1, 2, 3]]).is_conforming
    assert TetMesh.grid((1, 1, 1)).is_conforming


@pytest.mark.parametrize(
    ("vertex", "tet", "message"),
    [
        ([0, 0, 0], [1, 2, 3, 99], r"Cell 6: its vertex index 99 is out of range"),
        ([0, float("nan"), 0], [1, 2, 3, 9], r"Cell 6: its vertex 9 is at \(0, nan, 0\)"),
        ([0.5, 0.5, 0], [1, 2, 3, 9], r"Cell 6: its volume is zero"),
        ([0, 0, 0], [1, 2, 3, 3], r"Cell 6: it uses vertex 3 twice"),
    ],
)
def test_each_cell_must_be_one(vertex, tet, message):
    vertices, tets = soup()
    with pytest.raises(MeshError, match=message):
        TetMesh(torch.cat((vertices, torch.tensor([vertex]))), [*tets, tet], conforming=False)


def test_cells_are_oriented_and_measured_one_by_one():
    vertices, tets = soup()
    mesh = TetMesh(vertices, [[b, a, c, d] for a, b, c, d in tets], conforming=False)
    for measure in (TetMesh.volumes, TetMesh.quality, TetMesh.altitudes):
        alone = torch.cat([measure(TetMesh(vertices, [tet])).sort().values for tet in tets])
        assert torch.allclose(measure(mesh).sort(-1).values if measure is TetMesh.altitudes else measure(mesh), alone)
    assert torch.equal(mesh.vertex_altitudes().isinf(), torch.tensor([True, *[False] * 7, True]))
    assert mesh.bounds().tolist() == [[0, 0, -1], [9, 9, 9]]


@pytest.mark.parametrize(
    "ask",
    [
        lambda mesh: mesh.topology.cell_adjacency,
        lambda mesh: mesh.topology.faces,
        lambda mesh: mesh.topology.face_cells,
        lambda mesh: mesh.topology.boundary_faces,
        lambda mesh: mesh.topology.boundary_cells,
        lambda mesh: cell_faces(mesh.topology),
        lambda mesh: boundary_vertices(mesh.topology),
    ],
)
def test_whoever_asks_for_neighbours_is_told_every_time(ask):
    mesh = loose_mesh()
    for _ in range(2):
        with pytest.raises(MeshError, match=LOOSE):
            ask(mesh)


def test_edges_and_stars_need_no_neighbours():
    topology = loose_mesh().topology
    offsets, cells = topology.vertex_cells
    assert cells[offsets[7] : offsets[8]].tolist() == [4, 5]
    assert [7, 8] not in topology.edges.tolist()
    assert cell_edges(topology).shape == (6, 6)


def test_all_that_is_made_from_it_is_loose_too():
    mesh = loose_mesh()
    clean, kept = mesh.without_unused_vertices()
    assert kept.tolist() == list(range(1, 8))
    assert torch.equal(clean.vertices[clean.tets], mesh.vertices[mesh.tets])
    again, _ = clean.without_unused_vertices()
    topology = Topology(mesh.tets, mesh.num_vertices, is_conforming=False)
    made = [
        clean,
        again,
        mesh.with_vertices(2 * mesh.vertices),
        mesh.to(dtype=torch.float64),
        mesh.to(device="cpu"),
        TetMesh.from_valid(mesh.vertices, mesh.topology),
        TetMesh.from_valid(mesh.vertices, topology),
    ]
    for other in made:
        assert not other.is_conforming
        with pytest.raises(MeshError, match=LOOSE):
            other.topology.cell_adjacency  # noqa: B018
    assert not mesh.topology.to("meta").is_conforming


def test_positions_keep_their_graph():
    leaf = soup()[0].requires_grad_()
    TetMesh(leaf, soup()[1], conforming=False).volumes().sum().backward()
    assert leaf.grad.abs().sum() > 0


@pytest.mark.gpu
def test_on_a_gpu():
    mesh = loose_mesh().to("cuda")
    assert not mesh.is_conforming
    with pytest.raises(MeshError, match=LOOSE):
        mesh.topology.cell_adjacency  # noqa: B018


def test_refining_loose_cells_leaves_them_loose():
    mesh = TetMesh.grid((2, 2, 2))
    loose = TetMesh(mesh.vertices, mesh.tets, conforming=False)
    edges = loose.topology.edges[:1]
    assert not bisect_edges(loose, edges).mesh.is_conforming
    assert not star_subdivision(loose, torch.tensor([0])).mesh.is_conforming
