"""Topology tables against brute force and against what holds for every mesh."""

from collections import defaultdict
from itertools import combinations

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st

from difftetvr.mesh import TetMesh, Topology
from difftetvr.mesh.topology import faces
from difftetvr.mesh.topology.incidence import cell_edges, cell_faces, find_edges
from difftetvr.mesh.topology.lookup import are_faces
from difftetvr.mesh.topology.topology import LOCAL_EDGES, LOCAL_FACES


def random_mesh(seed, count=40):
    """A Delaunay mesh with cells knocked out and vertices renumbered: non-convex, with holes and several components."""
    rng = np.random.default_rng(seed)
    full = TetMesh.delaunay(rng.random((count, 3)))
    kept = rng.random(full.num_cells) < 0.7
    kept[0] = True
    order = rng.permutation(count)
    vertices = torch.empty_like(full.vertices)
    vertices[order] = full.vertices
    return TetMesh(vertices, order[full.tets.numpy()[kept]])


meshes = st.integers(0, 2**32 - 1).map(random_mesh)
properties = examples(13)


def half_faces_by_vertices(mesh):
    table = defaultdict(list)
    for cell, corners in enumerate(mesh.tets.tolist()):
        for k, local in enumerate(LOCAL_FACES):
            table[tuple(sorted(corners[i] for i in local))].append((cell, k))
    return table


@properties
@given(mesh=meshes)
def test_tables_match_brute_force(mesh):
    table = half_faces_by_vertices(mesh)
    adjacency = -np.ones((mesh.num_cells, 4), dtype=int)
    for sides in table.values():
        if len(sides) == 2:
            (cell, k), (other, j) = sides
            adjacency[cell, k], adjacency[other, j] = other, cell
    topology = mesh.topology
    assert np.array_equal(topology.cell_adjacency.numpy(), adjacency)

    found = {tuple(sorted(f)): c for f, c in zip(topology.faces.tolist(), topology.face_cells.tolist())}
    assert len(found) == len(topology.faces) == len(table)
    assert found == {f: [s[0][0], s[1][0] if len(s) == 2 else -1] for f, s in table.items()}

    edges = sorted({e for t in mesh.tets.tolist() for e in combinations(sorted(t), 2)})
    assert [tuple(e) for e in topology.edges.tolist()] == edges

    offsets, cells = topology.vertex_cells
    for v in range(mesh.num_vertices):
        around = np.flatnonzero((mesh.tets.numpy() == v).any(1)).tolist()
        assert cells[offsets[v] : offsets[v + 1]].tolist() == around
    for array in (topology.cell_adjacency, topology.faces, topology.face_cells, topology.edges, offsets, cells):
        assert array.dtype == torch.int32


@properties
@given(mesh=meshes, seed=st.integers(0, 2**32 - 1))
def test_lookups_match_brute_force(mesh, seed):
    topology, tets = mesh.topology, mesh.tets.tolist()
    rows = {tuple(edge): row for row, edge in enumerate(topology.edges.tolist())}
    expected = [[rows[tuple(sorted((corners[i], corners[j])))] for i, j in LOCAL_EDGES] for corners in tets]
    assert cell_edges(topology).tolist() == expected

    rows_of_faces = {frozenset(face): row for row, face in enumerate(topology.faces.tolist())}
    expected = [[rows_of_faces[frozenset(corners[i] for i in local)] for local in LOCAL_FACES] for corners in tets]
    assert cell_faces(topology).tolist() == expected

    pairs = torch.randint(mesh.num_vertices, (200, 2), generator=torch.Generator().manual_seed(seed))
    pairs = torch.cat((pairs, topology.edges.flip(1)))
    assert find_edges(topology, pairs).tolist() == [rows.get(tuple(sorted(pair)), -1) for pair in pairs.tolist()]

    triples = torch.rand((200, mesh.num_vertices), generator=torch.Generator().manual_seed(seed)).argsort(1)[:, :3]
    triples = torch.cat((triples.int(), topology.faces.roll(1, 1)))
    assert are_faces(topology, triples).tolist() == [frozenset(t) in rows_of_faces for t in triples.tolist()]


def test_lookups_around_a_vertex_of_many_loose_cells():
    none = torch.empty((0, 3), dtype=torch.int32)
    fan = Topology(torch.tensor([[0, 1 + k, 2 + k, 3 + k] for k in range(300)], dtype=torch.int32), 310)
    found = find_edges(fan, torch.tensor([[302, 0], [0, 303], [7, 5], [309, 0]])) >= 0
    assert found.tolist() == [True, False, True, False]
    assert fan.edges[find_edges(fan, fan.edges.flip(1))].equal(fan.edges)
    assert not find_edges(fan, none[:, :2]).numel() and not are_faces(fan, none).numel()


@properties
@given(mesh=meshes)
def test_adjacency_is_symmetric_across_the_same_face(mesh):
    adjacency = mesh.topology.cell_adjacency
    for cell, k in torch.nonzero(adjacency >= 0).tolist():
        other = int(adjacency[cell, k])
        back = adjacency[other].tolist().index(cell)
        face = mesh.tets[cell][list(LOCAL_FACES[k])]
        assert set(face.tolist()) == set(mesh.tets[other][list(LOCAL_FACES[back])].tolist())


@properties
@given(mesh=meshes)
def test_boundary_is_closed_and_faces_outwards(mesh):
    topology = mesh.topology
    boundary = topology.boundary_faces
    # Every directed edge is met by as many faces in the one direction as in the other: the surface has no rim.
    balance = defaultdict(int)
    for a, b, c in boundary.tolist():
        for p, q in ((a, b), (b, c), (c, a)):
            balance[min(p, q), max(p, q)] += 1 if p < q else -1
    assert not any(balance.values())
    # Divergence theorem for the field x / 3: the flux outwards is the volume.
    a, b, c = mesh.vertices.double()[boundary.long()].unbind(1)
    flux = (a * torch.linalg.cross(b, c)).sum() / 6
    assert flux == pytest.approx(mesh.volumes().sum().item(), rel=1e-9)
    for face, cell in zip(boundary.tolist(), topology.boundary_cells.tolist()):
        apex = next(v for v in mesh.tets[cell].tolist() if v not in face)
        p, q, r, d = (mesh.vertices[v].double() for v in (*face, apex))
        assert torch.dot(torch.linalg.cross(q - p, r - p), d - p) < 0


@properties
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(5, 60))
def test_convex_meshes_are_balls_with_spheres_around(seed, count):
    mesh = TetMesh.delaunay(np.random.default_rng(seed).random((count, 3)))
    topology = mesh.topology
    assert count - len(topology.edges) + len(topology.faces) - mesh.num_cells == 1
    boundary = topology.boundary_faces
    uses = defaultdict(int)
    for face in boundary.tolist():
        for edge in combinations(sorted(face), 2):
            uses[edge] += 1
    assert set(uses.values()) == {2}
    assert len(torch.unique(boundary)) - len(uses) + len(boundary) == 2


@pytest.mark.parametrize("chunk", [1, 2, 3, 7])
def test_chunk_borders_do_not_matter(monkeypatch, chunk):
    mesh = random_mesh(3)
    expected = mesh.topology.cell_adjacency

    def tiny_chunks(count, device, width=1):
        return (slice(i, min(i + chunk, count)) for i in range(0, count, chunk))

    monkeypatch.setattr(faces, "chunks", tiny_chunks)
    assert torch.equal(faces.match_faces(mesh.tets, mesh.num_vertices).cell_adjacency, expected)


@pytest.mark.parametrize("bits_left", [1, 3])
def test_exact_when_hashes_collide(monkeypatch, bits_left):
    """A mesh so large that almost no bits are left for the hash is matched by comparing vertices alone."""
    mesh = random_mesh(4, count=60)
    id_bits = (4 * mesh.num_cells - 1).bit_length()
    vertex_bits = (mesh.num_vertices - 1).bit_length()
    monkeypatch.setattr(faces, "_KEY_BITS", id_bits + vertex_bits + bits_left)
    matching = faces.match_faces(mesh.tets, mesh.num_vertices)
    assert torch.equal(matching.cell_adjacency, mesh.topology.cell_adjacency)
    assert not matching.crowded.numel()
    assert not matching.folded.numel()


def test_tables_are_built_once_and_cached_by_name():
    topology = TetMesh.grid((1, 1, 1)).topology
    assert topology.cell_adjacency is topology.cell_adjacency
    calls = []
    for _ in range(2):
        assert topology.cached("tests.value", lambda: calls.append(1) or 42) == 42
    assert len(calls) == 1
    assert topology.to("cpu") is topology


def test_single_cell_faces_are_counter_clockwise_from_outside():
    topology = Topology(torch.tensor([[0, 1, 2, 3]], dtype=torch.int32), 4)
    assert topology.cell_adjacency.tolist() == [[-1] * 4]
    assert topology.boundary_faces.tolist() == [list(f) for f in LOCAL_FACES]
    assert topology.boundary_cells.tolist() == [0] * 4
