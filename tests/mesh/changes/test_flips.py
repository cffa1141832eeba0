"""Bistellar flips, held against slow loops over sets of cells that know nothing of orientations."""

import itertools

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from mesh.changes.checks import SEEDS, cells_of, check_change, random_mesh

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.changes.flip_search import find_flips
from difftetvr.mesh.changes.flips import FOUR_TO_FOUR, THREE_TO_TWO, TWO_TO_THREE, apply_flips, independent_flips
from difftetvr.mesh.changes.independent import best_first
from difftetvr.mesh.topology.rings import closed_rings
from difftetvr.mesh.validation import orientations

KINDS = (TWO_TO_THREE, THREE_TO_TWO, FOUR_TO_FOUR)


def around(mesh, size):
    """The cells around each face or edge, a set of `size` vertices."""
    cells = {}
    for cell, corners in enumerate(mesh.tets.tolist()):
        for part in itertools.combinations(sorted(corners), size):
            cells.setdefault(part, []).append(cell)
    return cells


def link_cycle(mesh, edge, cells):
    """The vertices around an inner edge in order, None for one on the boundary."""
    links = [set(mesh.tets[cell].tolist()) - set(edge) for cell in cells]
    ring = [min(links[0])]
    while links:
        following = next((link for link in links if ring[-1] in link), None)
        if following is None:
            return None
        links.remove(following)
        ring += following - {ring[-1]}
    return ring[:-1] if ring[0] == ring[-1] else None


def retriangulations(mesh):
    """All that the topology admits: (cells that vanish, new cells), as tuples and sets of vertices."""
    for face, cells in around(mesh, 3).items():
        if len(cells) == 2:
            apexes = [next(v for v in mesh.tets[cell].tolist() if v not in face) for cell in cells]
            yield cells, [{*apexes, *pair} for pair in itertools.combinations(face, 2)]
    for edge, cells in around(mesh, 2).items():
        ring = link_cycle(mesh, edge, cells) if len(cells) in (3, 4) else None
        if ring and len(ring) == 3:
            yield cells, [{*ring, end} for end in edge]
        elif ring:
            for k in (0, 1):
                diagonal, others = (ring[k], ring[k + 2]), (ring[1 - k], ring[3 - k])
                yield cells, [{*diagonal, end, other} for end in edge for other in others]


def size_and_quality(mesh, corners):
    """Volume, never negative, and quality of a tetrahedron."""
    points = mesh.vertices.double().numpy()[sorted(corners)]
    volume = abs(np.linalg.det(points[1:] - points[0])) / 6
    squares = [np.sum((points[j] - points[i]) ** 2) for i, j in itertools.combinations(range(4), 2)]
    return volume, 6 * 2**0.5 * volume / np.mean(squares) ** 1.5


def possible_flips(mesh, min_quality):
    """{(cells that vanish, new cells): (worst quality before, after)}; new cells that overlap have too much volume."""
    flips = {}
    for cells, new in retriangulations(mesh):
        old_volumes, before = zip(*(size_and_quality(mesh, mesh.tets[cell].tolist()) for cell in cells))
        volumes, after = zip(*(size_and_quality(mesh, corners) for corners in new))
        if sum(volumes) <= sum(old_volumes) * (1 + 1e-9) and min(after) >= max(min(min_quality, min(before)), 1e-11):
            flips[frozenset(cells), frozenset(map(frozenset, new))] = min(before), min(after)
    return flips


def new_cells(flips, row):
    """The cells that a flip makes, told from its edge and ring alone."""
    edge, ring = flips.edge[row].tolist(), [v for v in flips.ring[row].tolist() if v >= 0]
    if flips.kind[row] == THREE_TO_TWO:
        return frozenset(frozenset({*ring, end}) for end in edge)
    return frozenset(frozenset({*edge, v, w}) for v, w in zip(ring, ring[1:] + ring[:1]))


def old_cells(flips, row):
    return [cell for cell in flips.cells[row].tolist() if cell >= 0]


def interpolate(mesh, values, points):
    """Values (P, C) at points (P, 3), from the cell that holds each best."""
    corners = mesh.vertices.double()[mesh.tets.long()]
    homogeneous = torch.cat((corners, torch.ones_like(corners[..., :1])), 2)
    targets = torch.cat((points, torch.ones_like(points[:, :1])), 1)
    weights = torch.linalg.solve(homogeneous.mT[None], targets[:, None, :, None])[..., 0]
    cells = weights.amin(2).argmax(1)
    rows = torch.arange(len(points))
    return torch.einsum("pk,pkc->pc", weights[rows, cells], values[mesh.tets[cells].long()])


@examples(5)
@given(seed=SEEDS)
def test_every_possible_flip_is_found_and_no_other(seed):
    mesh = random_mesh(seed, torch.float64 if seed % 2 else torch.float32)
    floor = (0.0, 0.1, 0.3, 1.0)[seed % 4]
    flips = find_flips(mesh, min_quality=floor)
    found = {}
    for row in range(len(flips)):
        cells = old_cells(flips, row)
        assert len(cells) == flips.kind[row]
        found[frozenset(cells), new_cells(flips, row)] = flips.quality_before[row], flips.quality_after[row]
    expected = possible_flips(mesh, floor)
    assert found.keys() == expected.keys() and len(found) == len(flips)
    for key, qualities in expected.items():
        assert found[key] == pytest.approx(qualities, rel=1e-6, abs=1e-9)


def test_no_flip_makes_a_flat_cell_whatever_the_floor():
    """A lattice is full of coplanar points; turned, rounding gives the flat cells between them some volume."""
    mesh = TetMesh.grid((2, 2, 1), dtype=torch.float64)
    turn = torch.linalg.qr(torch.rand((3, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)).Q
    turn *= torch.linalg.det(turn).sign()
    for lattice in (mesh, mesh.with_vertices(mesh.vertices @ turn.T + 0.3)):
        flips = find_flips(lattice, min_quality=-1.0)
        found = {(frozenset(old_cells(flips, row)), new_cells(flips, row)) for row in range(len(flips))}
        assert found == possible_flips(lattice, -1.0).keys() and found


@examples(6)
@given(seed=SEEDS)
def test_flips_of_random_priority_in_a_row(seed):
    mesh = random_mesh(seed, torch.float64 if seed % 2 else torch.float32)
    generator = torch.Generator().manual_seed(seed)
    for kinds in [(kind,) for kind in KINDS] + [KINDS]:
        flips = find_flips(mesh, min_quality=0.05)
        flips = flips.select(torch.isin(flips.kind, torch.tensor(kinds)))
        priority = torch.rand(len(flips), generator=generator)
        chosen = independent_flips(flips, priority)
        change = apply_flips(flips, priority)
        check_change(mesh, change, keeps_cells=False)
        new, parents = change.mesh, change.cell_parents.long()
        assert torch.equal(new.vertices, mesh.vertices) and not change.is_new.any()
        assert set(map(frozenset, new.topology.boundary_faces.tolist())) == set(
            map(frozenset, mesh.topology.boundary_faces.tolist())
        )
        counts = [int((chosen.kind == kind).sum()) for kind in KINDS]
        assert new.num_cells == mesh.num_cells + counts[0] - counts[1]

        vanished = torch.isin(torch.arange(mesh.num_cells), chosen.cells)
        assert (parents.diff() >= 0).all()
        kept = ~vanished[parents]
        assert torch.equal(parents[kept], (~vanished).nonzero()[:, 0])
        assert torch.equal(new.tets[kept], mesh.tets[~vanished])
        shared = (new.tets[:, :, None] == mesh.tets[parents][:, None, :]).any(2).sum(1)
        assert (shared[~kept] == 3).all()
        if len(chosen):
            floor = chosen.quality_before.clamp_max(0.05).min()
            worst = new.quality()[~kept].min()
            assert worst >= floor * (1 - 1e-6)
            assert worst == pytest.approx(float(chosen.quality_after.min()), rel=1e-5)
        mesh = new


@examples(8)
@given(seed=SEEDS)
def test_flips_are_those_of_the_greedy_loop(seed):
    mesh = random_mesh(seed)
    flips = find_flips(mesh)
    generator = torch.Generator().manual_seed(seed)
    priority = torch.randint(0, 4 if seed % 3 == 0 else 10**6, (len(flips),), generator=generator).double()
    used, cells = set(), cells_of(mesh)
    for row in best_first(priority).tolist():
        old = old_cells(flips, row)
        if not used & set(old):
            used |= set(old)
            cells -= {tuple(sorted(mesh.tets[cell].tolist())) for cell in old}
            cells |= {tuple(sorted(corners)) for corners in new_cells(flips, row)}
    assert cells_of(apply_flips(flips, priority).mesh) == cells
    assert set(independent_flips(flips, priority).cells.unique().tolist()) - {-1} == used


@examples(3)
@given(seed=SEEDS)
def test_every_flip_can_be_taken_back(seed):
    mesh = random_mesh(seed)
    flips = find_flips(mesh, min_quality=0.0)
    generator = torch.Generator().manual_seed(seed)
    for row in torch.randperm(len(flips), generator=generator)[:12].tolist():
        one = flips.select(torch.tensor([row]))
        flipped = apply_flips(one, torch.zeros(1)).mesh
        back = find_flips(flipped, min_quality=0.0)
        back_to = frozenset(frozenset(mesh.tets[cell].tolist()) for cell in old_cells(one, 0))
        undo = [i for i in range(len(back)) if new_cells(back, i) == back_to]
        assert len(undo) == 1
        undone = back.select(torch.tensor(undo))
        assert int(undone.kind) == {2: 3, 3: 2, 4: 4}[int(one.kind)]
        assert cells_of(apply_flips(undone, torch.zeros(1)).mesh) == cells_of(mesh)
        if one.kind != FOUR_TO_FOUR:
            values = torch.rand(mesh.num_vertices, generator=generator, dtype=torch.float64)
            assert torch.allclose(one.surplus(values), -undone.surplus(values), atol=1e-9)


@examples(6)
@given(seed=SEEDS)
def test_the_surplus_is_the_change_of_the_interpolated_value(seed):
    mesh = random_mesh(seed, torch.float64 if seed % 2 else torch.float32)
    flips = find_flips(mesh, min_quality=0.02)
    positions = mesh.vertices.double()
    at_edge = torch.lerp(*positions[flips.edge.long()].unbind(1), flips.weight[:, None])
    at_face = torch.einsum("nk,nkc->nc", flips.face_weights, positions[flips.ring[:, :3].long()])
    extent = mesh.bounds().diff(dim=0).max()
    assert ((at_edge - at_face).abs() <= 1e-9 * extent).all()
    assert (flips.weight >= 0).all() and (flips.weight <= 1).all() and (flips.face_weights >= 0).all()

    linear = positions @ torch.tensor([[1.0, 2.0], [-3.0, 0.5], [0.25, 4.0]], dtype=torch.float64) + extent
    assert (flips.surplus(linear).abs() <= 1e-9 * linear.abs().max()).all()
    generator = torch.Generator().manual_seed(seed)
    values = torch.rand((mesh.num_vertices, 2), generator=generator, dtype=torch.float64)
    surplus = flips.surplus(values)
    for kind in KINDS:
        rows = (flips.kind == kind).nonzero()[:, 0]
        for row in rows[torch.randperm(len(rows), generator=generator)[:4]].tolist():
            changed = apply_flips(flips.select(torch.tensor([row])), torch.zeros(1)).mesh
            points, share = at_edge[row, None], torch.ones(1, 1, dtype=torch.float64)
            if kind != FOUR_TO_FOUR:  # half way to each vertex of the cells half of it is left
                vertices = torch.cat((flips.edge[row], flips.ring[row, :3])).long()
                points = torch.cat((points, (points + positions[vertices]) / 2))
                share = torch.tensor([[1.0], *[[0.5]] * 5], dtype=torch.float64)
            difference = interpolate(changed, values, points) - interpolate(mesh, values, points)
            torch.testing.assert_close(difference, share * surplus[row], rtol=0.0, atol=1e-7)


def octahedron(tilt=0.0):
    """Four cells around the edge from below to above; the ring is 2, 4, 3, 5, and 2 and 3 are lifted by `tilt`."""
    points = [[0, 0, -1], [0, 0, 1], [1, 0, tilt], [-1, 0, tilt], [0, 1, 0], [0, -1, 0]]
    ring = [2, 4, 3, 5, 2]
    return TetMesh(torch.tensor(points).double(), [[a, b, 0, 1] for a, b in itertools.pairwise(ring)])


def test_both_diagonals_of_an_octahedron():
    for tilt in (0.0, 0.3, -0.3):
        flips = find_flips(octahedron(tilt))
        assert flips.kind.tolist() == [FOUR_TO_FOUR] * 2
        assert [set(edge) for edge in flips.edge.tolist()] == [{2, 3}, {4, 5}]
        assert [set(ring[::2]) for ring in flips.ring.tolist()] == [{0, 1}, {0, 1}]
        assert flips.weight.tolist() == pytest.approx([0.5, 0.5])
        values = torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
        assert flips.surplus(values).dtype == torch.float32
        old = 1.5 + 0.5 * tilt  # the value on the old edge at the height of 2 and 3
        assert flips.surplus(values).tolist() == pytest.approx([6.0 - old, 24.0 - 1.5], rel=1e-6)
    values = values.double().requires_grad_()
    flips.surplus(values)[1].backward()
    assert values.grad.tolist() == [-0.5, -0.5, 0.0, 0.0, 0.5, 0.5]
    assert flips.surplus(torch.rand(6, 2, 3)).shape == (2, 2, 3)


def test_what_is_there_already_is_not_made_again():
    """Cells that overlap, having but vertices in common, are accepted as a mesh."""
    positions = [[0, 0, -1], [0, 0, 1], [1, 0, 0], [-1, 1, 0], [-1, -1, 0]]
    two = [[2, 3, 4, 1], [2, 4, 3, 0]]
    three = [[2, 3, 0, 1], [3, 4, 0, 1], [4, 2, 0, 1]]
    far = [[3, 0, 0.0], [3, 1, 0], [3, 0, 1]]
    vertices = torch.tensor(positions + far).double()
    for cells, kind in ((two, TWO_TO_THREE), (three, THREE_TO_TWO)):
        assert find_flips(TetMesh(vertices, cells)).kind.tolist() == [kind]
    edge_is_there, face_is_there = [*two, [0, 1, 5, 6]], [*three, [2, 3, 4, 5]]
    assert not len(find_flips(TetMesh(vertices, edge_is_there), min_quality=0.0))
    assert not len(find_flips(TetMesh(vertices + 0.1 * (torch.arange(8) == 5)[:, None], face_is_there)))

    again = torch.cat((vertices[:5], vertices[2:5] * 0.9))
    twice = two + [[v + 3 if v > 1 else v for v in cell] for cell in two]
    flips = find_flips(TetMesh(again, twice))
    assert flips.kind.tolist() == [TWO_TO_THREE] * 2
    for first in (0, 1):
        change = apply_flips(flips, torch.arange(2.0) * (1 - 2 * first))
        assert change.mesh.num_cells == 5 and change.cell_parents.tolist() == ([0, 1, 2, 2, 3], [0, 0, 1, 2, 3])[first]
        check_change(flips.mesh, change, keeps_cells=False)


@examples(5)
@given(seed=SEEDS)
def test_closed_rings_are_the_cells_in_order(seed):
    mesh = random_mesh(seed)
    for size in (3, 4, 5, 6):
        found = closed_rings(mesh.topology, size)
        edges, rings, cells = found.edge, found.vertices, found.cells
        assert torch.equal(mesh.topology.edges[found.rows.long()], edges)
        expected = {}
        for edge, of_edge in around(mesh, 2).items():
            if len(of_edge) == size and link_cycle(mesh, edge, of_edge):
                expected[edge] = set(of_edge)
        assert {tuple(edge): set(row) for edge, row in zip(edges.tolist(), cells.tolist())} == expected
        corners = torch.stack((rings, rings.roll(-1, 1), *edges[:, :, None].expand(-1, -1, size).unbind(1)), 2)
        assert torch.equal(corners.sort(2).values, mesh.tets[cells.long()].sort(2).values)
        assert (orientations(mesh.vertices, corners.reshape(-1, 4)) == 1).all()


def test_an_edge_where_cells_only_touch_has_no_ring():
    points = [[0, 0, -1], [0, 0, 1], [1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 0, 0], [-1, -1, 0], [0, -1, 0.0]]
    cells = [[2, 3, 0, 1], [3, 4, 0, 1], [5, 6, 0, 1], [6, 7, 0, 1]]
    mesh = TetMesh(torch.tensor(points), cells)
    assert closed_rings(mesh.topology, 4).edge.shape == (0, 2)
    assert find_flips(mesh).kind.tolist() == [TWO_TO_THREE] * 2


def test_flipping_for_the_better_shape():
    mesh = TetMesh.delaunay(torch.from_numpy(np.random.default_rng(0).random((300, 3))))
    worst, poor = mesh.quality().min(), (mesh.quality() < 0.2).sum()
    for _ in range(10):
        flips = find_flips(mesh)
        better = flips.select(flips.quality_after > flips.quality_before)
        mesh = apply_flips(better, better.quality_after - better.quality_before).mesh
    assert mesh.quality().min() >= worst and (mesh.quality() < 0.2).sum() < 0.75 * poor


def test_what_is_refused_and_what_is_nothing():
    mesh = random_mesh(1)
    flips = find_flips(mesh)
    with pytest.raises(MeshError, match=f"each of the {len(flips)} flips"):
        apply_flips(flips, torch.zeros(len(flips) + 1))
    with pytest.raises(MeshError, match="NaN"):
        independent_flips(flips, torch.full((len(flips),), torch.nan))
    with pytest.raises(MeshError, match=f"each of the {mesh.num_vertices} old vertices"):
        flips.surplus(torch.zeros(3))
    none = flips.select(torch.zeros(len(flips), dtype=torch.bool))
    assert torch.equal(apply_flips(none, torch.zeros(0)).mesh.tets, mesh.tets)
    assert none.surplus(torch.zeros(mesh.num_vertices, 2)).shape == (0, 2)
    assert len(find_flips(TetMesh(torch.eye(4)[:, :3], [[0, 1, 2, 3]]))) == 0
