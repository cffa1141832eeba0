"""Star subdivision: validity, the article's Table 1, and its constraints on rising and falling diagonals."""

from collections import Counter
from itertools import combinations

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from mesh.changes.checks import SEEDS, cells_of, check_change, random_mesh

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.changes.star import star_subdivision

TABLE_1 = {
    "FRR": ((0, 1, 3, 2), (3, 4, 5, 1), (1, 2, 5, 3)),
    "RFR": ((0, 1, 4, 2), (3, 4, 5, 2), (0, 2, 4, 3)),
    "FFR": ((0, 1, 3, 2), (3, 4, 5, 2), (1, 2, 4, 3)),
    "RRF": ((0, 1, 5, 2), (3, 4, 5, 0), (0, 1, 4, 5)),
    "FRF": ((0, 1, 5, 2), (3, 4, 5, 1), (0, 1, 3, 5)),
    "RFF": ((0, 1, 4, 2), (3, 4, 5, 0), (0, 2, 4, 5)),
}
"""As printed: b, c, d are 0, 1, 2 and b', c', d' above them are 3, 4, 5."""


def prism_diagonals(pattern):
    """Side k goes from corner k to k + 1: a rising diagonal starts below, a falling one above."""
    sides = enumerate(pattern)
    return {frozenset((k, (k + 1) % 3 + 3) if letter == "R" else (k + 3, (k + 1) % 3)) for k, letter in sides}


def signed_volumes(points, tets):
    return np.array([np.linalg.det(points[list(t[1:])] - points[t[0]]) / 6 for t in tets])


@pytest.mark.parametrize("pattern", TABLE_1)
def test_table_1_tessellates_the_prism(pattern):
    bottom = np.array([[0.0, 0, 0], [1, 0.1, 0], [0.2, 1.1, 0.1]])
    apex = np.array([0.3, 0.4, 2.0])
    points = np.concatenate((bottom, (bottom + apex) / 2))
    tets = TABLE_1[pattern]
    whole = abs(signed_volumes(np.concatenate((bottom, apex[None])), [(0, 1, 2, 3)])[0])
    volumes = signed_volumes(points, tets)
    assert np.abs(volumes).sum() == pytest.approx(whole * 7 / 8)
    # Faces: the two triangles and two on each side, cut along the pattern's diagonal, are outside; all others match.
    faces = Counter(frozenset(f) for tet in tets for f in combinations(tet, 3))
    outside = {face for face, uses in faces.items() if uses == 1}
    assert max(faces.values()) == 2 and len(outside) == 8 and {frozenset((0, 1, 2)), frozenset((3, 4, 5))} <= outside
    edges = {frozenset(e) for tet in tets for e in combinations(tet, 2)}
    assert {edge for edge in edges if len({i % 3 for i in edge}) == 2 and len({i // 3 for i in edge}) == 2} == (
        prism_diagonals(pattern)
    )


def test_table_1_is_oriented_alike():
    # b, c, d counter-clockwise seen from the apex: all cells come out negative by our convention, none by mistake.
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    for tets in TABLE_1.values():
        assert (signed_volumes(points, tets) < 0).all()


def letters(mesh, apex, cell, edges, middle):
    """Which way each side of the prism beneath `apex` is cut, going round its base: {side: letter}."""
    base = [v for v in cell if v != apex]
    if cell.index(apex) % 2 == 0:
        base.reverse()  # the same sense of rotation, seen from the apex, for every cell
    found = {}
    for one, other in zip(base, base[1:] + base[:1]):
        rising = frozenset((one, middle[apex, other])) in edges
        falling = frozenset((other, middle[apex, one])) in edges
        assert rising != falling
        found[one, other] = "R" if rising else "F"
    return found


@examples(13)
@given(seed=SEEDS)
def test_rising_and_falling_constraints_of_the_article(seed):
    mesh = random_mesh(seed)
    chosen = torch.randperm(mesh.num_vertices, generator=torch.Generator().manual_seed(seed))[:4].tolist()
    change = star_subdivision(mesh, torch.tensor(chosen))
    edges = {frozenset(edge) for edge in change.mesh.topology.edges.tolist()}
    middle = {}
    for i in change.is_new.nonzero()[:, 0].tolist():
        one, other = change.parents[i].tolist()
        middle[one, other] = middle[other, one] = i
    sides = {}
    for cell in mesh.tets.tolist():
        corners = [v for v in cell if v in chosen]
        if len(corners) != 1:
            continue
        found = letters(mesh, corners[0], cell, edges, middle)
        assert set(found.values()) == {"R", "F"}  # never RRR, never FFF
        for (one, other), letter in found.items():
            lowest = min(one, other)
            assert frozenset((lowest, middle[corners[0], max(one, other)])) in edges  # to the smallest index
            neighbour = sides.get((corners[0], other, one))
            assert neighbour is None or {neighbour, letter} == {"R", "F"}
            assert (corners[0], one, other) not in sides
            sides[corners[0], one, other] = letter


@examples(20)
@given(seed=SEEDS)
def test_stars_of_random_vertices_in_a_row(seed):
    mesh = random_mesh(seed, torch.float64 if seed % 2 else torch.float32)
    generator = torch.Generator().manual_seed(seed)
    for share in (0.5, 0.1):
        chosen = torch.rand(mesh.num_vertices, generator=generator) < share
        vertices = chosen.nonzero()[:, 0]
        change = star_subdivision(mesh, vertices[torch.randperm(len(vertices), generator=generator)])
        check_change(mesh, change)
        split = mesh.topology.edges[chosen[mesh.topology.edges.long()].any(1)]
        assert torch.equal(change.parents[change.is_new], split) and (change.weight[change.is_new] == 0.5).all()
        counts = torch.bincount(change.cell_parents, minlength=mesh.num_cells)
        assert counts.tolist() == [(1, 4, 7, 8, 8)[n] for n in chosen[mesh.tets.long()].sum(1).tolist()]
        mesh = change.mesh


@pytest.mark.parametrize("chosen", [[0], [1], [3], [0, 2], [1, 3], [2, 3], [0, 1, 3], [0, 1, 2, 3]])
def test_one_cell_however_its_corners_are_ordered(chosen):
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.2, 0.9, 0], [0.3, 0.3, 1.1]], dtype=torch.float64)
    pieces = set()
    for order in ([0, 1, 2, 3], [1, 2, 0, 3], [3, 1, 0, 2], [2, 3, 0, 1]):
        mesh = TetMesh(vertices, [order])
        change = star_subdivision(mesh, torch.tensor(chosen))
        check_change(mesh, change)
        pieces.add(frozenset(cells_of(change.mesh)))
        eighths = (change.mesh.volumes() / mesh.volumes() * 8).round(decimals=9)
        assert eighths.unique().tolist() in ([1.0, 2.0, 4.0], [1.0, 2.0], [1.0])
    assert len(pieces) == 1


def test_all_vertices_make_eight_cells_of_each_and_keep_shapes():
    mesh = TetMesh.grid((3, 2, 2))
    change = star_subdivision(mesh, torch.arange(mesh.num_vertices))
    assert change.mesh.num_cells == 8 * mesh.num_cells
    assert change.mesh.quality().min() >= 0.99 * mesh.quality().min()
    nothing = star_subdivision(mesh, torch.zeros(0, dtype=torch.int64))
    assert torch.equal(nothing.mesh.tets, mesh.tets) and not nothing.is_new.any()


def test_a_vertex_whose_star_cannot_be_stored_is_left_alone():
    step = 2.0**-23  # from 1 to the next float32
    thin = torch.tensor([[1.0, 0, 0], [1 + step, 0, 0], [1, 1, 0], [1, 0, 1], [2, 1, 1], [3, 2, 3]])
    mesh = TetMesh(thin, [[0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 5]])
    for chosen, cells in (([0], 3), ([4], 9), ([0, 5], 6)):
        change = star_subdivision(mesh, torch.tensor(chosen))
        check_change(mesh, change)
        assert change.mesh.num_cells == cells


def test_what_is_refused():
    mesh = TetMesh.grid((1, 1, 1))
    with pytest.raises(MeshError, match="vertex index 8 is out of range"):
        star_subdivision(mesh, torch.tensor([8]))
    with pytest.raises(MeshError, match="shape"):
        star_subdivision(mesh, torch.zeros(2, 2, dtype=torch.int64))
