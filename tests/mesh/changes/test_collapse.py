"""Half-edge collapse and the link condition, held against slow loops over sets."""

import itertools
from unittest import mock

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from mesh.changes.checks import SEEDS, check_change, random_mesh
from scipy.spatial import ConvexHull

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh, Topology
from difftetvr.mesh.changes import collapse
from difftetvr.mesh.changes.bisection import bisect_edges, independent_edges
from difftetvr.mesh.changes.collapse import collapse_edges
from difftetvr.mesh.changes.independent import BestFirst, best_first
from difftetvr.mesh.topology.link import link_condition


def links(topology):
    """The link of a set of vertices as a set of frozensets, the boundary closed by a vertex outside."""
    cells = [frozenset(cell) for cell in topology.tets.tolist()]
    cells += [frozenset([*face, -1]) for face in topology.boundary_faces.tolist()]
    around = {}
    for cell in cells:
        for vertex in cell:
            around.setdefault(vertex, []).append(cell)

    def link(*simplex):
        simplex = frozenset(simplex)
        opposite = [cell - simplex for cell in around[next(iter(simplex))] if simplex <= cell]
        return {frozenset(f) for cell in opposite for k in (1, 2, 3) for f in itertools.combinations(cell, k)}

    return link


def sphere(seed):
    """A triangulated 3-sphere: the hull of points in four dimensions, most of whose edges cannot be contracted."""
    points = np.random.default_rng(seed).normal(size=(5 + seed % 9, 4))
    hull = ConvexHull(points)
    cells = hull.simplices.copy()
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    inverted = np.linalg.det(np.concatenate((edges, hull.equations[:, None, :4]), 1)) < 0
    cells[inverted] = cells[inverted][:, [0, 1, 3, 2]]
    return Topology(torch.from_numpy(cells).int(), len(points))


@examples(20)
@given(seed=SEEDS)
def test_link_condition_of_spheres_and_meshes(seed):
    topology = sphere(seed) if seed % 3 else random_mesh(seed).topology
    if seed % 3 == 0:  # a mesh with cells missing touches itself in edges and vertices
        kept = torch.rand(topology.num_cells, generator=torch.Generator().manual_seed(seed)) < 0.8
        kept[0] = True
        topology = Topology(topology.tets[kept], topology.num_vertices)
    link = links(topology)
    pairs = topology.edges.long()
    expected = [link(u) & link(v) == link(u, v) for u, v in pairs.tolist()]
    assert link_condition(topology, pairs).tolist() == expected
    assert link_condition(topology, pairs.flip(1)).tolist() == expected


@pytest.mark.parametrize("around", [3, 4, 5, 16, 17, 40])
def test_link_condition_of_many_vertices_around_an_edge(around):
    """Two circles joined to a 3-sphere: all vertices of the one are around each edge of the other."""
    for size in (3, 4):
        cells = [(i, (i + 1) % size, size + j, size + (j + 1) % around) for i in range(size) for j in range(around)]
        topology = Topology(torch.tensor(cells).int(), size + around)
        link, pairs = links(topology), topology.edges.long()
        expected = [link(u) & link(v) == link(u, v) for u, v in pairs.tolist()]
        assert link_condition(topology, pairs).tolist() == expected
        assert pairs[0].tolist() == [0, 1] and expected[0] == (size > 3)


def test_spheres_fail_in_every_dimension():
    failures = set()
    for seed in range(40):
        topology = sphere(seed)
        link = links(topology)
        for u, v in topology.edges.tolist():
            failures.add(min((len(f) for f in (link(u) & link(v)) - link(u, v)), default=0))
    assert failures == {0, 1, 2, 3}


def test_an_inner_edge_between_boundary_vertices_is_refused():
    mesh = TetMesh.grid((1, 1, 1))
    diagonal = torch.tensor([[0, 7]])
    assert not link_condition(mesh.topology, diagonal).item()
    assert link_condition(mesh.topology, torch.zeros(0, 2, dtype=torch.int64)).shape == (0,)


def quality_of(points):
    edges = [points[j] - points[i] for i, j in itertools.combinations(range(4), 2)]
    volume = np.linalg.det(points[1:] - points[0]) / 6
    return 6 * 2**0.5 * volume / np.mean([e @ e for e in edges]) ** 1.5


def greedy(mesh, half_edges, limit, min_quality):
    """One collapse after the other, best first: what must come out."""
    link, boundary = links(mesh.topology), set(mesh.topology.boundary_faces.view(-1).tolist())
    positions, cells = mesh.vertices.double().numpy(), mesh.tets.tolist()
    blocked, chosen, vanished = set(), [], 0
    for v, u in half_edges:
        if v in blocked or v in boundary:
            continue
        star = [cell for cell in cells if v in cell]
        remaining = [[u if w == v else w for w in cell] for cell in star if u not in cell]
        before = min(quality_of(positions[cell]) for cell in star)
        after = min(quality_of(positions[cell]) for cell in remaining)
        good = after > 0 and after >= min(min_quality, before)
        if not good or link(u) & link(v) != link(u, v):
            continue
        vanished += len(star) - len(remaining)
        if limit is not None and vanished > limit:
            break
        blocked |= {w for cell in star for w in cell}
        chosen.append((v, u))
    return chosen


def all_half_edges(mesh, seed, distinct=True):
    """Both directions of every edge at random cost."""
    count = len(mesh.topology.edges)
    generator = torch.Generator().manual_seed(seed)
    cost = torch.rand(2 * count, generator=generator) if distinct else torch.zeros(2 * count)
    return torch.arange(count).repeat(2), torch.arange(2).repeat_interleave(count), cost


def interior_mesh(seed):
    """A mesh with enough vertices inside to collapse."""
    mesh = random_mesh(seed)
    while mesh.num_cells < 400:
        priority = torch.rand(len(mesh.topology.edges), generator=torch.Generator().manual_seed(seed))
        mesh = bisect_edges(mesh, independent_edges(mesh, priority, budget=150)).mesh
    return mesh


@examples(4)
@given(seed=SEEDS)
def test_collapses_are_those_of_the_greedy_loop(seed):
    mesh = interior_mesh(seed)
    edges, target, cost = all_half_edges(mesh, seed, distinct=seed % 3 != 0)
    boundary = mesh.topology.boundary_faces.unique()
    ends = mesh.topology.edges[edges]
    removed = ends.gather(1, 1 - target[:, None])[:, 0]
    order = best_first(-cost)
    order = order[~torch.isin(removed[order], boundary)]
    queue = [(int(ends[i, 1 - target[i]]), int(ends[i, target[i]])) for i in order]
    for limit, floor in ((None, 0.1), (mesh.num_cells // 20, 0.02)):
        change = collapse_edges(mesh, edges, target, cost, limit=limit, min_quality=floor)
        chosen = dict(greedy(mesh, queue, limit, floor))
        gone = set(range(mesh.num_vertices)) - set(change.parents[:, 0].tolist())
        assert gone == set(chosen)
        merged = [[chosen.get(v, v) for v in cell] for cell in mesh.tets.tolist()]
        remaining = [cell for cell in merged if len(set(cell)) == 4]
        assert change.parents[:, 0][change.mesh.tets.long()].tolist() == remaining
        assert [merged[i] for i in change.cell_parents] == remaining
        assert limit is None or mesh.num_cells - len(remaining) <= limit


@examples(3)
@given(seed=SEEDS)
def test_it_makes_no_difference_how_many_candidates_are_looked_at_together(seed):
    mesh = interior_mesh(seed)
    for limit in (10, mesh.num_cells // 4, mesh.num_cells):
        halves = all_half_edges(mesh, seed, distinct=seed % 2 == 0)
        change = collapse_edges(mesh, *halves, limit=limit, boundary="slide")
        with mock.patch.multiple(collapse, _SMALLEST_BATCH=20, _CELLS_PER_COLLAPSE=1000):
            in_parts = collapse_edges(mesh, *halves, limit=limit, boundary="slide")
        assert torch.equal(in_parts.mesh.tets, change.mesh.tets)
        assert torch.equal(in_parts.parents, change.parents)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64])
def test_best_first_part_by_part(dtype):
    generator = torch.Generator().manual_seed(0)
    for count in (0, 1, 2, 1000):
        priority = torch.randn(count, generator=generator).mul(3).round().to(dtype)
        queue, parts = BestFirst(priority), [torch.zeros(0, dtype=torch.int64)]
        while left := len(queue):
            parts.append(queue.take(100))
            assert len(parts[-1]) >= min(left, 100) and len(queue) == left - len(parts[-1])
        together = torch.cat(parts)
        assert torch.equal(together, best_first(priority))
        assert torch.equal(priority[together], priority.sort(descending=True).values)


@examples(5)
@given(seed=SEEDS)
def test_collapsing_in_a_row(seed):
    mesh = interior_mesh(seed).to(dtype=torch.float64 if seed % 2 else torch.float32)
    for k in range(3):
        floor = min(0.1, float(mesh.quality().min()))
        change = collapse_edges(mesh, *all_half_edges(mesh, seed + k))
        check_change(mesh, change, keeps_cells=False)
        assert not change.is_new.any()
        old_faces = {frozenset(face) for face in mesh.topology.boundary_faces.tolist()}
        new_faces = change.parents[:, 0][change.mesh.topology.boundary_faces.long()]
        assert {frozenset(face) for face in new_faces.tolist()} == old_faces
        assert change.mesh.quality().min() >= floor * (1 - 1e-6)
        mesh = change.mesh


def test_collapse_prefers_the_cheapest_and_carries_data():
    mesh = TetMesh.grid((3, 3, 3))
    edges, target, cost = all_half_edges(mesh, 0)
    change = collapse_edges(mesh, edges, target, cost, limit=20)
    values = torch.rand(mesh.num_vertices, 3)
    assert torch.equal(change.carry(values), values[change.parents[:, 0].long()])
    assert torch.equal(change.carry_cells(torch.arange(mesh.num_cells)).int(), change.cell_parents)
    assert (change.cell_parents.diff() > 0).all() and 0 < mesh.num_cells - change.mesh.num_cells <= 20
    nothing = collapse_edges(mesh, edges[:0], target[:0], cost[:0])
    assert torch.equal(nothing.mesh.tets, mesh.tets)


def test_a_quality_floor_of_one_allows_only_what_makes_the_worst_cell_better():
    mesh = interior_mesh(1)
    before = mesh.quality()
    change = collapse_edges(mesh, *all_half_edges(mesh, 0), min_quality=1.0)
    assert change.mesh.num_cells < mesh.num_cells and change.mesh.quality().min() >= before.min()


def test_what_is_refused():
    mesh = TetMesh.grid((2, 2, 2))
    one = torch.tensor([0])
    with pytest.raises(MeshError, match="shapes"):
        collapse_edges(mesh, one, one, torch.zeros(2))
    with pytest.raises(MeshError, match="NaN"):
        collapse_edges(mesh, one, one, torch.tensor([torch.nan]))
    with pytest.raises(MeshError, match="edge index 9999 is out of range"):
        collapse_edges(mesh, one + 9999, one, torch.zeros(1))
    with pytest.raises(MeshError, match="target index 2 is out of range"):
        collapse_edges(mesh, one, one + 2, torch.zeros(1))
