"""Edge bisection, choosing independent edges, and the record that every change returns."""

import pytest
import torch
from hypotheses import examples
from hypothesis import given
from mesh.changes.checks import SEEDS, cells_of, check_change, random_mesh

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.changes.bisection import bisect_edges, independent_edges, long_edges
from difftetvr.mesh.changes.independent import best_first
from difftetvr.mesh.topology.incidence import cell_edges
from difftetvr.mesh.topology.topology import LOCAL_EDGES


def edge_cells(mesh):
    """The set of cells around each edge, the slow way."""
    cells = [set() for _ in range(len(mesh.topology.edges))]
    index = {tuple(edge): i for i, edge in enumerate(mesh.topology.edges.tolist())}
    for cell, corners in enumerate(mesh.tets.tolist()):
        for i, j in LOCAL_EDGES:
            cells[index[tuple(sorted((corners[i], corners[j])))]].add(cell)
    return cells


def greedy(mesh, order, budget=None):
    """One by one, best first: what must come out."""
    cells, used, chosen, added = edge_cells(mesh), set(), [], 0
    for edge in order:
        if cells[edge] & used:
            continue
        if budget is not None and added + len(cells[edge]) > budget:
            break
        added += len(cells[edge])
        used |= cells[edge]
        chosen.append(edge)
    return chosen


@examples(20)
@given(seed=SEEDS)
def test_bisection_of_random_edges_in_a_row(seed):
    mesh = random_mesh(seed, torch.float64 if seed % 2 else torch.float32)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(3):
        priority = torch.rand(len(mesh.topology.edges), generator=generator)
        edges = independent_edges(mesh, priority, budget=mesh.num_cells // 2)
        change = bisect_edges(mesh, edges)
        check_change(mesh, change)
        assert change.mesh.num_vertices == mesh.num_vertices + len(edges)
        mesh = change.mesh


def test_what_bisection_does_to_one_edge():
    mesh = TetMesh.grid((2, 2, 2))
    edge = 20
    ends = mesh.topology.edges[edge].tolist()
    around = [cell for cell in mesh.tets.tolist() if set(ends) <= set(cell)]
    change = bisect_edges(mesh, torch.tensor([edge]))
    new = mesh.num_vertices
    halves = {tuple(sorted(new if v == end else v for v in cell)) for cell in around for end in ends}
    untouched = {tuple(sorted(cell)) for cell in mesh.tets.tolist() if cell not in around}
    assert cells_of(change.mesh) == halves | untouched and len(halves) == 2 * len(around)
    assert change.parents[new].tolist() == ends and change.weight[new] == 0.5 and change.is_new.nonzero().item() == new
    halved = change.mesh.volumes() / change.carry_cells(mesh.volumes())
    assert sorted(halved.tolist()) == [0.5] * len(halves) + [1.0] * len(untouched)
    values = torch.rand(mesh.num_vertices, 2, 3, dtype=torch.float64, requires_grad=True)
    carried = change.carry(values)
    assert torch.equal(carried[:new], values) and torch.allclose(carried[new], values[ends].mean(0))
    carried[new].sum().backward()
    assert (values.grad[ends] == 0.5).all() and values.grad.sum() == 6.0


@examples(13)
@given(seed=SEEDS)
def test_independent_edges_are_those_of_the_greedy_loop(seed):
    mesh = random_mesh(seed)
    generator = torch.Generator().manual_seed(seed)
    count = len(mesh.topology.edges)
    priority = torch.randint(0, 5 if seed % 3 == 0 else 10**6, (count,), generator=generator).double()
    allowed = torch.rand(count, generator=generator) < 0.7
    candidates = allowed.nonzero()[:, 0]
    order = candidates[best_first(priority[candidates])].tolist()
    assert independent_edges(mesh, priority, allowed).tolist() == greedy(mesh, order)
    for budget in (0, 7, mesh.num_cells // 3):
        assert independent_edges(mesh, priority, allowed, budget).tolist() == greedy(mesh, order, budget)
    assert (priority[order].diff() <= 0).all()
    # bisect_edges sorts out conflicts by the same rule.
    change = bisect_edges(mesh, candidates, priority[candidates])
    assert torch.equal(change.parents[change.is_new], mesh.topology.edges[sorted(greedy(mesh, order))])


def test_a_budget_larger_than_one_batch_gives_the_head_of_the_full_choice(monkeypatch):
    monkeypatch.setattr("difftetvr.mesh.changes.bisection._SMALLEST_BATCH", 16)
    mesh = TetMesh.grid((6, 5, 4))
    priority = torch.rand(len(mesh.topology.edges), generator=torch.Generator().manual_seed(0))
    full = independent_edges(mesh, priority)
    degrees = torch.tensor([len(cells) for cells in edge_cells(mesh)])[full].cumsum(0)
    for budget in (16, 100, 333, 10**6):
        assert torch.equal(independent_edges(mesh, priority, budget=budget), full[degrees <= budget])


def test_edges_may_be_indices_or_pairs_in_any_order_and_repeated():
    mesh = TetMesh.grid((2, 2, 2))
    edges = independent_edges(mesh, torch.arange(len(mesh.topology.edges)).float())
    by_index = bisect_edges(mesh, edges)
    pairs = torch.cat((mesh.topology.edges[edges].flip(1), mesh.topology.edges[edges[:2]])).flip(0)
    assert torch.equal(bisect_edges(mesh, pairs).mesh.tets, by_index.mesh.tets)
    nothing = bisect_edges(mesh, edges[:0])
    assert torch.equal(nothing.mesh.tets, mesh.tets) and not nothing.is_new.any()


def test_long_edges_are_long_in_each_of_their_cells():
    mesh = random_mesh(5)
    ends = mesh.vertices[mesh.topology.edges.long()]
    lengths = torch.linalg.vector_norm(ends[:, 0] - ends[:, 1], dim=1)
    longest = torch.stack([lengths[row].max() for row in cell_edges(mesh.topology).long()])
    for ratio in (0.6, 1.0):
        expected = [all(lengths[e] >= ratio * longest[c] for c in cells) for e, cells in enumerate(edge_cells(mesh))]
        assert long_edges(mesh, ratio).tolist() == expected
    assert 0 < sum(expected) < len(expected) and long_edges(mesh, 0.0).all()


def test_the_longer_the_edges_the_better_the_shapes():
    poor = []
    for ratio in (0.0, 0.6, 0.95):
        mesh = TetMesh.grid((3, 3, 3))
        while mesh.num_cells < 2000:
            allowed = long_edges(mesh, ratio)
            priority = torch.rand(len(allowed), generator=torch.Generator().manual_seed(0))
            mesh = bisect_edges(mesh, independent_edges(mesh, priority, allowed)).mesh
        poor.append(float((mesh.quality() < 0.25).float().mean()))
    assert poor[0] > 2 * poor[1] > 2 * poor[2], poor


def test_cells_have_the_edges_that_join_their_corners():
    mesh = random_mesh(3)
    table = cell_edges(mesh.topology)
    ends = mesh.tets[:, torch.tensor(LOCAL_EDGES)].sort(2).values
    assert torch.equal(mesh.topology.edges[table.long()], ends)


def test_an_edge_whose_midpoint_cannot_be_stored_is_left_alone():
    one = 1.0
    step = 2.0**-23  # to the next float32
    thin = torch.tensor([[one, 0, 0], [one + step, 0, 0], [one, 1, 0], [one, 0, 1], [one + 1, 1, 1]])
    mesh = TetMesh(thin, [[0, 1, 2, 3], [1, 2, 3, 4]])
    ends = torch.tensor([[0, 1], [1, 4]])
    for pair, halves in ((ends[:1], 0), (ends[1:], 1)):
        change = bisect_edges(mesh, pair)
        assert change.mesh.num_cells == 2 + halves
        check_change(mesh, change)
    edges = torch.tensor([[0, 1], [3, 4]])
    assert bisect_edges(mesh, edges).parents[-1].tolist() == [3, 4]


def test_what_is_refused():
    mesh = TetMesh.grid((1, 1, 1))
    count = len(mesh.topology.edges)
    for edges, message in (
        (torch.tensor([count]), f"edge index {count} is out of range.*0 to {count - 1}"),
        (torch.tensor([-1]), "edge index -1"),
        (torch.tensor([0.0]), "pass integers"),
        (torch.tensor([[1, 6]]), "vertices 1 and 6 share no edge"),
        (torch.tensor([[1, 8]]), "vertex index 8 is out of range"),
        (torch.zeros(2, 3, dtype=torch.int64), "shape"),
    ):
        with pytest.raises(MeshError, match=message):
            bisect_edges(mesh, edges)
    with pytest.raises(MeshError, match=f"each of the {count} edges"):
        independent_edges(mesh, torch.zeros(3))
    with pytest.raises(MeshError, match="NaN"):
        independent_edges(mesh, torch.full((count,), torch.nan))
    with pytest.raises(MeshError, match="`allowed` has shape"):
        independent_edges(mesh, torch.zeros(count), torch.ones(1, dtype=torch.bool))
    change = bisect_edges(mesh, torch.tensor([0]))
    with pytest.raises(MeshError, match="each of the 8 old vertices"):
        change.carry(torch.zeros(9))
    with pytest.raises(MeshError, match="each of the 6 old cells"):
        change.carry_cells(torch.zeros(8))
