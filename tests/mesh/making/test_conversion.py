"""Splitting of cells: pieces fill the same volume and fit together, however cells and vertices are numbered."""

import itertools

import numpy as np
import pytest
import torch

from difftetvr.mesh import TetMesh
from difftetvr.mesh.making.conversion import FACES, is_convertible, is_curved, num_nodes, to_tetrahedra

HEX_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
WEDGE_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
PYRAMID_FACES = ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0))
PIECES = {"hexahedron": 6, "wedge": 3, "pyramid": 2}


def orders(kind):
    """All numberings of a cell's corners that keep its faces, mirrored ones included."""
    if kind == "hexahedron":
        places = {tuple(c): i for i, c in enumerate(HEX_CORNERS)}
        return [
            [places[tuple(np.where(flips, 1 - c[list(axes)], c[list(axes)]))] for c in HEX_CORNERS]
            for axes in itertools.permutations(range(3))
            for flips in itertools.product((False, True), repeat=3)
        ]
    if kind == "wedge":
        ends = [(p, [i + 3 for i in p]) for p in map(list, itertools.permutations(range(3)))]
        return [low + high for low, high in ends] + [high + low for low, high in ends]
    turns = [[(i + k) % 4 for i in range(4)] for k in range(4)]
    return [[*turn, 4] for turn in turns] + [[*turn[::-1], 4] for turn in turns]


def column_grid(rng, shape, kinds):
    """Vertices and cells by kind: every column of cubes along z is made of one kind of cells, chosen at random."""
    nx, ny, nz = shape
    grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in shape), indexing="ij"), -1)
    number = np.arange(grid.size // 3).reshape(grid.shape[:3])
    points = list(grid.reshape(-1, 3).astype(float))
    cells = {kind: [] for kind in PIECES}
    for x, y in itertools.product(range(nx), range(ny)):
        kind = kinds[rng.integers(len(kinds))]
        for z in range(nz):
            cube = np.array([number[x + a, y + b, z + c] for a, b, c in HEX_CORNERS])
            if kind == "hexahedron":
                cells[kind].append(cube)
            elif kind == "wedge":
                cells[kind] += [cube[[0, 1, 2, 4, 5, 6]], cube[[0, 2, 3, 4, 6, 7]]]
            else:
                points.append(np.mean([points[i] for i in cube], 0))
                cells[kind] += [np.append(cube[list(face)], len(points) - 1) for face in PYRAMID_FACES]
    return np.array(points), {kind: np.array(nodes) for kind, nodes in cells.items() if nodes}


def shuffled(rng, points, cells):
    """The same cells with vertices, cells and corners numbered at random, and inner vertices moved."""
    inside = ((points > 0) & (points < points.max(0))).all(1)
    points = points + 0.08 * rng.uniform(-1, 1, points.shape) * inside[:, None]
    renumbered = rng.permutation(len(points))
    moved = np.empty_like(points)
    moved[renumbered] = points
    numbered = {}
    for kind, nodes in cells.items():
        choices = np.array(orders(kind))[rng.integers(len(orders(kind)), size=len(nodes))]
        numbered[kind] = rng.permutation(renumbered[np.take_along_axis(nodes, choices, 1)])
    return moved, numbered


@pytest.mark.parametrize("kinds", [["hexahedron"], ["wedge"], ["pyramid"], ["hexahedron", "wedge", "pyramid"]])
@pytest.mark.parametrize("seed", range(8))
def test_pieces_fill_the_volume_and_fit_together(kinds, seed):
    rng = np.random.default_rng(seed)
    shape = (3, 4, 2)
    points, cells = shuffled(rng, *column_grid(rng, shape, kinds))
    tets = []
    for kind, nodes in cells.items():
        pieces, parents = to_tetrahedra(kind, nodes)
        assert (np.bincount(parents) == PIECES[kind]).all() and (np.diff(parents) >= 0).all()
        assert (np.isin(pieces, nodes[parents]) == (pieces[:, :, None] == nodes[parents][:, None]).any(2)).all()
        tets.append(pieces)
    mesh = TetMesh(torch.from_numpy(points), np.concatenate(tets))  # refuses whatever does not fit together
    assert float(mesh.volumes().sum()) == pytest.approx(np.prod(shape))
    faces = mesh.vertices[mesh.topology.boundary_faces.long()]
    areas = torch.linalg.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]).norm(dim=1) / 2
    assert float(areas.sum()) == pytest.approx(2 * (3 * 4 + 3 * 2 + 4 * 2))
    assert len(faces) == 4 * (3 * 4 + 3 * 2 + 4 * 2)


def test_a_hexahedron_that_stands_for_a_wedge():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], float)
    for order in orders("hexahedron"):
        tets, _ = to_tetrahedra("hexahedron", np.array([[0, 1, 2, 2, 3, 4, 5, 5]])[:, order])
        proper = tets[[len(set(tet)) == 4 for tet in tets.tolist()]]
        assert float(TetMesh(points, proper).volumes().sum()) == pytest.approx(0.5)


def test_cells_of_higher_order_keep_their_corners():
    tets, parents = to_tetrahedra("tetra10", np.arange(20).reshape(2, 10))
    assert tets.tolist() == [[0, 1, 2, 3], [10, 11, 12, 13]] and parents.tolist() == [0, 1]
    for kind in FACES:
        assert is_convertible(kind) and not is_curved(kind)
        size = num_nodes(kind)
        high = f"{kind}{size + 7}"
        assert is_curved(high) and num_nodes(high) == size + 7
        nodes = np.arange(size + 7)[None]
        assert np.array_equal(to_tetrahedra(high, nodes)[0], to_tetrahedra(kind, nodes[:, :size])[0])
    assert not is_convertible("VTK cell type 41") and not is_convertible("polyhedron8") and not is_convertible("tetra3")


def test_no_cells_give_no_tetrahedra():
    for kind in FACES:
        tets, parents = to_tetrahedra(kind, np.empty((0, num_nodes(kind)), np.int64))
        assert tets.shape == (0, 4) and parents.shape == (0,)
