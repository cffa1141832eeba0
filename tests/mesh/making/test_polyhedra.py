"""Cells given by their faces: simple ones are recognised however they are written, others are split soundly."""

import numpy as np
import pytest
import torch
from scipy.spatial import Voronoi

from difftetvr.mesh import TetMesh
from difftetvr.mesh.making.conversion import FACES, to_tetrahedra
from difftetvr.mesh.making.polyhedra import Polyhedra, recognised, split

CORNERS = {
    "tetra": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "pyramid": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]],
    "wedge": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]],
    "hexahedron": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
}
VOLUMES = {"tetra": 1 / 6, "pyramid": 1 / 3, "wedge": 1 / 2, "hexahedron": 1}


def polyhedra(cells):
    """From lists of faces, each a list of vertices."""
    faces = [face for cell in cells for face in cell]
    return Polyhedra(
        np.array([node for face in faces for node in face], np.int64),
        np.cumsum([0, *map(len, faces)]),
        np.cumsum([0, *map(len, cells)]),
    )


def shuffled(rng, faces):
    """The same faces in another order, each begun elsewhere and perhaps turned around."""
    turned = [np.roll(face, rng.integers(len(face)))[:: rng.choice((1, -1))].tolist() for face in faces]
    return [turned[i] for i in rng.permutation(len(turned))]


@pytest.mark.parametrize("seed", range(4))
def test_simple_cells_are_recognised_whatever_their_order(seed):
    rng = np.random.default_rng(seed)
    kinds = rng.permutation(list(CORNERS) * 3).tolist()
    points, cells = [], []
    for kind in kinds:
        numbers = len(points) + rng.permutation(len(CORNERS[kind]))
        where = np.empty((len(numbers), 3))
        where[numbers - len(points)] = CORNERS[kind]
        points += where.tolist()
        cells.append(shuffled(rng, [numbers[list(face)].tolist() for face in FACES[kind]]))
    found, others = recognised(polyhedra(cells))
    assert len(others) == 0
    for kind, (rows, corners) in found.items():
        assert rows.tolist() == [i for i, name in enumerate(kinds) if name == kind]
        pieces, _ = to_tetrahedra(kind, corners)
        mesh = TetMesh(torch.tensor(points, dtype=torch.float64), pieces)
        assert float(mesh.volumes().sum()) == pytest.approx(3 * VOLUMES[kind])


def test_what_only_looks_like_a_simple_cell_is_not_recognised():
    wedge = [list(face) for face in FACES["wedge"]]
    twice = [list(face) for face in FACES["hexahedron"]]
    twice[5] = twice[4]
    cells = [[*wedge[:4], [2, 0, 3, 4]], twice, [[0, 1, 2], [0, 1, 3], [1, 2, 3], [0, 2, 4]]]
    found, others = recognised(polyhedra(cells))
    assert not found and others.tolist() == [0, 1, 2]


def voronoi_cells(rng, count):
    """Points and cells that fill the unit cube, convex and with faces of all sizes."""
    seeds = rng.uniform(0.05, 0.95, (count, 3))
    mirrored = [np.where(np.arange(3) == axis, 2 * side - seeds, seeds) for axis in range(3) for side in (0, 1)]
    diagram = Voronoi(np.concatenate((seeds, *mirrored)))
    cells = [[] for _ in range(count)]
    for (a, b), ridge in zip(diagram.ridge_points, diagram.ridge_vertices, strict=True):
        for cell in (a, b):
            if cell < count:
                cells[cell].append(list(ridge))
    return diagram.vertices, cells


@pytest.mark.parametrize("seed", range(4))
def test_convex_cells_are_filled_and_fit_together(seed):
    rng = np.random.default_rng(seed)
    points, cells = voronoi_cells(rng, 12)
    points[np.abs(points) < 1e-9] = 0
    numbers = rng.permutation(len(points))
    where = np.empty_like(points)
    where[numbers] = points
    cells = [shuffled(rng, [numbers[face].tolist() for face in cell]) for cell in cells]
    tets, parents, overlap = split(polyhedra(cells), where)
    assert (np.diff(parents) >= 0).all() and not overlap.any()
    mesh, _ = TetMesh(torch.from_numpy(where), tets).without_unused_vertices()
    assert mesh.is_conforming and float(mesh.volumes().sum()) == pytest.approx(1)
    boundary = mesh.vertices[mesh.topology.boundary_faces.long()]
    areas = torch.linalg.cross(boundary[:, 1] - boundary[:, 0], boundary[:, 2] - boundary[:, 0]).norm(dim=1) / 2
    assert float(areas.sum()) == pytest.approx(6)


def volume_of(points, tets):
    return np.abs(np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]])).sum() / 6


def test_a_dented_cell_is_the_fan_of_a_vertex_that_sees_it_all():
    """The smallest vertex lies at the edge of the dent and does not see its other side."""
    points = np.array(
        [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5] * 3]
    )
    points[8, 2] = 0.6
    dent = [[i, (i + 1) % 4, 8] for i in range(4)]
    faces = [*dent, [7, 6, 5, 4], *([i + 4, (i + 1) % 4 + 4, (i + 1) % 4, i] for i in range(4))]
    for turned in (faces, [face[:: 1 - 2 * (i % 2)] for i, face in enumerate(faces)]):
        tets, parents, overlap = split(polyhedra([turned, turned]), points)
        assert not overlap.any() and volume_of(points, tets) == pytest.approx(2 * (1 - 0.4 / 3))
        assert (np.diff(parents) >= 0).all() and 0 in tets


def test_a_cell_that_no_vertex_sees_all_of_is_told():
    star = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 2), (2, 2), (2, 1), (0, 1)]
    count = len(star)
    points = np.array([[x, y, z] for z in (0, 1) for x, y in star], float)
    sides = [[i, (i + 1) % count, (i + 1) % count + count, i + count] for i in range(count)]
    faces = [list(range(count))[::-1], list(range(count, 2 * count)), *sides]
    _, _, overlap = split(polyhedra([faces, faces]), points)
    assert (overlap > 0.01).all() and overlap[0] == overlap[1]


def test_a_hexahedron_beside_four_smaller_ones():
    """Its common side is four faces with nine vertices: what hangs on one side is a corner on the other."""
    places = [(4, y, z) for y in range(3) for z in range(3)] + [
        (x, y, z) for x in (0, 5) for y in (0, 1, 2) for z in (0, 1, 2)
    ]
    number = {place: i for i, place in enumerate(places)}

    def face(*corners):
        return [number[corner] for corner in corners]

    def box(y, z):
        near, far = ([(x, y, z), (x, y + 1, z), (x, y + 1, z + 1), (x, y, z + 1)] for x in (4, 5))
        return [face(*near), face(*far), *(face(near[i - 1], near[i], far[i], far[i - 1]) for i in range(4))]

    small = [box(y, z) for y in (0, 1) for z in (0, 1)]
    ring = [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1), (0, 0)]
    sides = [
        face((0, *ring[i]), *((4, *place) for place in ring[i : i + 3]), (0, *ring[i + 2])) for i in range(0, 8, 2)
    ]
    large = [face(*((0, *place) for place in ring[:8:2])), *(cell[0] for cell in small), *sides]
    cells, points = polyhedra([large, *small]), np.array(places, float)
    found, others = recognised(cells)
    assert others.tolist() == [0] and found["hexahedron"][0].tolist() == [1, 2, 3, 4]
    tets, _, overlap = split(cells, points)
    assert not overlap.any() and volume_of(points, tets) == pytest.approx(16 + 4)
