"""Kuhn grids and Delaunay meshes: conforming, complete, positive."""

import math

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as numbers
from scipy.spatial import ConvexHull

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.making.generators import grid_with_shell, shell_has_room, without_pinches


def lattice(n):
    return np.stack(np.meshgrid(*[np.arange(n)] * 3), -1).reshape(-1, 3).astype(float)


def rotation():
    q, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    return q


@examples(10)
@given(
    shape=st.tuples(*[st.integers(1, 5)] * 3),
    lower=st.tuples(*[st.floats(-10, 10)] * 3),
    size=st.tuples(*[st.floats(0.01, 10)] * 3),
)
def test_grid_is_a_conforming_partition_of_the_box(shape, lower, size):
    upper = [a + s for a, s in zip(lower, size)]
    mesh = TetMesh.grid(shape, lower, upper, dtype=torch.float64)
    nx, ny, nz = shape
    assert mesh.num_cells == 6 * nx * ny * nz
    assert mesh.num_vertices == (nx + 1) * (ny + 1) * (nz + 1)
    assert mesh.bounds().flatten().tolist() == pytest.approx([*lower, *upper])
    volumes = mesh.volumes()
    assert volumes.min().item() == pytest.approx(np.prod(size) / mesh.num_cells, rel=1e-6)
    assert volumes.max().item() == pytest.approx(np.prod(size) / mesh.num_cells, rel=1e-6)
    # Conforming: what is left unmatched is the surface of the box, two triangles a square, and nothing inside.
    assert len(mesh.topology.boundary_faces) == 4 * (nx * ny + ny * nz + nz * nx)
    checked = TetMesh(mesh.vertices, mesh.tets)
    assert torch.equal(checked.tets, mesh.tets)


def test_grid_order_is_documented():
    mesh = TetMesh.grid((2, 3, 4), (0, 0, 0), (2, 3, 4))
    i, j, k = 1, 2, 3
    assert mesh.vertices[i + 3 * (j + 4 * k)].tolist() == [i, j, k]
    cube = i + 2 * (j + 3 * k)
    corners = mesh.vertices[mesh.tets[6 * cube : 6 * cube + 6].long()]
    assert corners.amin((0, 1)).tolist() == [i, j, k]
    assert corners.amax((0, 1)).tolist() == [i + 1, j + 1, k + 1]
    assert mesh.tets.dtype == torch.int32
    assert mesh.vertices.dtype == torch.float32


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 1, 1),), "each at least 1"),
        (((1, 1),), "three numbers"),
        (((1.5, 1, 1),), "each at least 1"),
        (((1, 1, 1), (0, 0, 0), (1, 0, 1)), "along y"),
        (((1, 1, 1), (0, 0, 0), (1, 1, np.nan)), "along z"),
        (((10**4, 10**4, 10**4),), "fewer cubes"),
        (((1000, 1, 1), (1e8, 0, 0), (1e8 + 100, 1, 1)), "cannot tell apart"),
        (((1, 1, 1), (0, 0), (1, 1, 1)), "three coordinates"),
    ],
)
def test_grid_errors(arguments, message):
    with pytest.raises(MeshError, match=message):
        TetMesh.grid(*arguments)


def assert_conforming_hull(mesh, points):
    """Valid, fills the hull, and its boundary is one sphere, so that no face inside is left unmatched."""
    TetMesh(mesh.vertices, mesh.tets)
    assert (mesh.volumes() > 0).all()
    hull = ConvexHull(points.astype(float))
    assert mesh.volumes().double().sum().item() == pytest.approx(hull.volume, rel=1e-6)
    boundary = mesh.topology.boundary_faces
    edges = torch.unique(torch.cat((boundary[:, :2], boundary[:, 1:], boundary[:, ::2])).sort(1).values, dim=0)
    assert len(torch.unique(boundary)) - len(edges) + len(boundary) == 2
    assert 2 * len(edges) == 3 * len(boundary)


@examples(8)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(4, 200), dtype=st.sampled_from([np.float32, np.float64]))
def test_delaunay_of_random_points(seed, count, dtype):
    points = np.random.default_rng(seed).random((count, 3)).astype(dtype)
    mesh = TetMesh.delaunay(points)
    assert np.array_equal(mesh.vertices.numpy(), points)
    assert_conforming_hull(mesh, points)


def degenerate_point_sets():
    rng = np.random.default_rng(1)
    sphere = rng.normal(size=(200, 3))
    box = np.clip(rng.random((300, 3)) * 1.6 - 0.3, 0, 1)
    return {
        "cube": lattice(2),
        "lattice": lattice(5),
        "rotated lattice": lattice(5) @ rotation(),
        "rotated lattice in float32": (lattice(5) @ rotation()).astype(np.float32),
        "far lattice in float32": (lattice(5) @ rotation() + 1000).astype(np.float32),
        "body-centred lattice": np.concatenate([lattice(5), lattice(4) + 0.5]),
        "sphere": sphere / np.linalg.norm(sphere, axis=1, keepdims=True),
        "coplanar hull": box,
        "rotated coplanar hull in float32": (box @ rotation()).astype(np.float32),
    }


@pytest.mark.parametrize("name", degenerate_point_sets())
def test_delaunay_of_degenerate_points(name):
    points = degenerate_point_sets()[name]
    assert_conforming_hull(TetMesh.delaunay(points), points)


def test_delaunay_keeps_duplicates_unused_and_the_graph():
    points = torch.rand((30, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(2)).requires_grad_()
    assert TetMesh.delaunay(points).vertices is points
    twice = torch.cat((points, points))
    mesh = TetMesh.delaunay(twice)
    assert mesh.num_vertices == 60
    assert mesh.without_unused_vertices()[0].num_vertices == 30


def test_delaunay_circumspheres_are_empty():
    points = np.random.default_rng(7).random((60, 3))
    mesh = TetMesh.delaunay(points)
    corners = points[mesh.tets.numpy()]
    edges = corners[:, 1:] - corners[:, :1]
    centres = corners[:, 0] + np.linalg.solve(edges, (edges**2).sum(2, keepdims=True) / 2)[..., 0]
    radii = np.linalg.norm(corners[:, 0] - centres, axis=1)
    distances = np.linalg.norm(points[None] - centres[:, None], axis=2)
    assert (distances >= radii[:, None] * (1 - 1e-9)).all()


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((3, 3)), "3 points"),
        (np.zeros((9, 3)), "coincide"),
        (np.random.default_rng(0).random((9, 3)) * [1, 1, 0], "one plane"),
        (np.full((9, 3), np.nan), "Point 0 is at"),
        (np.zeros((9, 2)), r"shape \(9, 2\)"),
    ],
)
def test_delaunay_errors(points, message):
    with pytest.raises(MeshError, match=message):
        TetMesh.delaunay(points)


@examples(30)
@given(
    shape=st.tuples(*[st.integers(1, 8)] * 3),
    layers=st.integers(1, 4),
    growth=st.floats(1.01, 100.0),
    sides=st.tuples(*[st.floats(0.1, 10.0)] * 3),
)
def test_a_grid_with_a_shell_fills_the_outer_box_with_valid_cells(shape, layers, growth, sides):
    inner = torch.tensor([[-1.0, 2.0, 0.0]] * 2, dtype=torch.float64)
    inner[1] += torch.tensor(sides, dtype=torch.float64)
    if not shell_has_room(shape, layers, growth):
        with pytest.raises(MeshError, match=r"layers around .* are thinner than these"):
            grid_with_shell(shape, layers, inner.tolist(), growth)
        return
    vertices, tets = grid_with_shell(shape, layers, inner.tolist(), growth, torch.float64)
    mesh = TetMesh(vertices, tets)
    mesh.validate()
    assert mesh.num_cells == 6 * math.prod(n + 2 * layers for n in shape)
    middle, half = inner.mean(0), 0.5 * growth * (inner[1] - inner[0])
    outer = torch.stack((middle - half, middle + half))
    torch.testing.assert_close(mesh.volumes().sum(), (outer[1] - outer[0]).prod())
    torch.testing.assert_close(mesh.bounds(), outer)
    # The grid over the inner box is there as it would be alone.
    alone = TetMesh.grid(shape, *inner.tolist(), dtype=torch.float64).vertices
    distance = (alone[:, None] - vertices).abs().amax(2).amin(1)
    assert float(distance.max()) < 1e-9


def test_the_cubes_of_a_shell_grow():
    vertices, _ = grid_with_shell((4, 4, 4), 3, [[-1] * 3, [1] * 3], 8.0)
    on_axis = vertices[(vertices[:, 1:].abs() < 1e-6).all(1), 0].unique()
    assert on_axis.tolist() == pytest.approx([-8, -4, -2, -1, -0.5, 0, 0.5, 1, 2, 4, 8], abs=1e-5)


@examples(30)
@given(numbers.arrays(bool, numbers.array_shapes(min_dims=3, max_dims=3, max_side=6)))
def test_solids_without_pinches_have_manifold_boundaries(keep):
    filled = without_pinches(keep)
    assert (filled >= keep).all() and without_pinches(filled).tolist() == filled.tolist()
    assume(filled.any())
    grid = TetMesh.grid(keep.shape[::-1])
    tets = grid.tets[torch.from_numpy(filled.reshape(-1)).repeat_interleave(6)]
    mesh, _ = TetMesh(grid.vertices, tets).without_unused_vertices()
    faces = mesh.topology.boundary_faces.long()
    ends = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).sort(1).values
    assert (torch.unique(ends, dim=0, return_counts=True)[1] == 2).all()
    for vertex in faces.unique().tolist():
        # The boundary around a vertex is one fan: its faces hang together by the edges at the vertex.
        fan = faces[(faces == vertex).any(1)]
        rim = [set(face) - {vertex} for face in fan.tolist()]
        reached = rim.pop()
        while joined := [edge for edge in rim if edge & reached]:
            reached |= joined[0]
            rim.remove(joined[0])
        assert not rim


def test_a_pinch_is_filled_and_nothing_else():
    keep = np.zeros((4, 4, 4), dtype=bool)
    keep[1, 1, 1] = keep[1, 2, 2] = True
    filled = without_pinches(keep)
    assert filled[1, 1:3, 1:3].all() and filled.sum() <= 12
    solid = np.zeros((5, 5, 5), dtype=bool)
    solid[1:4, 1:4, 1:3] = True
    assert (without_pinches(solid) == solid).all()
