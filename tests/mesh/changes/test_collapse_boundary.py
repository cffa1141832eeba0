"""Collapses of boundary vertices, held against exact integer arithmetic on lattices.

Meshes have integer positions, of which the code under test sees affine images, rounded to float32 or float64.
"""

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from mesh.changes.checks import SEEDS, boundary_area, check_change

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.boundary import keeps_surface
from difftetvr.mesh.changes.collapse import collapse_edges
from difftetvr.mesh.changes.removal import remove_cells
from difftetvr.mesh.topology.incidence import boundary_vertices, find_edges
from difftetvr.mesh.topology.link import link_condition


def cubes(*shape):
    """A grid of unit cubes at integer positions."""
    return TetMesh.grid(shape, upper=[float(n) for n in shape], dtype=torch.float64)


def two_parts(one, other, shift):
    """Two components in one mesh."""
    vertices = torch.cat((one.vertices, other.vertices + torch.tensor(shift, dtype=torch.float64)))
    return TetMesh(vertices, torch.cat((one.tets, other.tets + one.num_vertices)))


def delaunay_box(rng, side=16):
    """Integer points in a cube, on its faces, on its edges and at its corners."""
    points = rng.integers(0, side + 1, (int(rng.integers(30, 120)), 3))
    points[rng.random(points.shape) < 0.35] = 0
    points[rng.random(points.shape) < 0.2] = side
    corners = np.stack(np.meshgrid(*[[0, side]] * 3), -1).reshape(-1, 3)
    points = np.unique(np.concatenate((corners, points)), axis=0)
    return TetMesh.delaunay(torch.from_numpy(points).double())


def lattice_mesh(seed):
    """A box, one of several parts, one with holes, or one that touches itself in edges and vertices."""
    rng = np.random.default_rng(seed)
    mesh = delaunay_box(rng) if seed % 2 else cubes(*rng.integers(2, 6, 3))
    kind = seed // 2 % 4
    if kind == 1:
        mesh = two_parts(mesh, cubes(2, 1, 3), (40.0, 0.0, 3.0))
    if kind == 2:
        mesh = remove_cells(mesh, torch.from_numpy(rng.random(mesh.num_cells) < 0.1)).mesh
    if kind == 3:  # whole boxes at random places
        centroids = mesh.vertices[mesh.tets.long()].mean(1)
        boxes = (4 * centroids / mesh.vertices.amax(0)).floor().long()
        hollow = torch.from_numpy(rng.random((4, 4, 4)) < 0.3)
        removed = hollow[boxes.unbind(1)]
        removed[0] = False
        mesh = remove_cells(mesh, removed).mesh
    return mesh


def image(mesh, seed):
    """Turned, sheared, shifted and in another unit, in either precision."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    shear = np.eye(3) + np.triu(rng.uniform(-0.5, 0.5, (3, 3)))
    matrix = torch.from_numpy(turn * np.linalg.det(turn) @ shear * rng.choice([1e-6, 1.0, 1e6]))
    vertices = (mesh.vertices + torch.from_numpy(rng.uniform(-5, 5, 3))) @ matrix.T
    return mesh.with_vertices(vertices).to(dtype=torch.float32 if seed % 3 else torch.float64)


def surface(lattice, faces):
    """Oriented planes of a boundary, and of the area in each its moments up to the second: exact integers.

    Surfaces that differ in a set of some area differ in these, unless they do it on purpose.
    """
    a, b, c = lattice[faces.long()].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    area = np.gcd.reduce(normal.numpy(), axis=1)
    normal = normal // torch.from_numpy(area)[:, None]
    planes, plane = torch.unique(torch.cat((normal, (normal * a).sum(1, keepdim=True)), 1), dim=0, return_inverse=True)
    total = a + b + c
    squares = sum(p[:, :, None] * p[:, None, :] for p in (a, b, c, total))
    moments = torch.cat((torch.ones_like(a[:, :1]), total, squares.view(-1, 9)), 1) * torch.from_numpy(area)[:, None]
    return planes, torch.zeros((len(planes), 13), dtype=torch.int64).index_add_(0, plane, moments)


def assert_same_surface(points, mesh, change):
    kept = points[change.parents[:, 0].long()]
    before = surface(points, mesh.topology.boundary_faces)
    after = surface(kept, change.mesh.topology.boundary_faces)
    assert torch.equal(before[0], after[0]) and torch.equal(before[1], after[1])


def characteristic(topology):
    return topology.tets.unique().numel() - len(topology.edges) + len(topology.faces) - topology.num_cells


def determinants(lattice, tets):
    a, b, c, d = lattice[tets.long()].unbind(1)
    return (torch.linalg.cross(b - a, c - a) * (d - a)).sum(1)


def all_half_edges(mesh, seed):
    """Both directions of every edge at random cost."""
    count = len(mesh.topology.edges)
    cost = torch.rand(2 * count, generator=torch.Generator().manual_seed(seed % 2**32))
    return torch.arange(count).repeat(2), torch.arange(2).repeat_interleave(count), cost


def merged(mesh, change):
    """The collapses [v, u] of a change, read off its cells."""
    before = mesh.tets[change.cell_parents.long()]
    after = change.parents[:, 0][change.mesh.tets.long()]
    moved = before != after
    return torch.stack((before[moved], after[moved]), 1).unique(dim=0)


@examples(6)
@given(seed=SEEDS)
def test_the_boundary_stays_the_same_surface(seed):
    lattice = lattice_mesh(seed)
    mesh, points = image(lattice, seed // 8), lattice.vertices.long()
    rng = np.random.default_rng(seed)
    for k in range(3):
        limit = int(rng.integers(0, mesh.num_cells)) if rng.random() < 0.5 else None
        floor = float(rng.choice([0.01, 0.1, 1.0]))
        halves = all_half_edges(mesh, seed + k)
        change = collapse_edges(mesh, *halves, limit=limit, min_quality=floor, boundary="slide")
        check_change(mesh, change, keeps_cells=False)
        assert_same_surface(points, mesh, change)
        kept = points[change.parents[:, 0].long()]
        after = determinants(kept, change.mesh.tets)
        assert (after > 0).all() and after.sum() == determinants(points, mesh.tets).sum()
        assert characteristic(change.mesh.topology) == characteristic(mesh.topology)
        assert limit is None or mesh.num_cells - change.mesh.num_cells <= limit
        mesh, points = change.mesh, kept


def find_vertex(mesh, position):
    """The first vertex at a position."""
    return int((mesh.vertices == torch.tensor(position)).all(1).nonzero()[0])


def collapse_one(mesh, removed, kept, **options):
    """The mesh after one collapse, or None where it is refused."""
    edge = find_edges(mesh.topology, torch.tensor([[removed, kept]]))
    target = (mesh.topology.edges[edge, 1] == kept).long()
    change = collapse_edges(mesh, edge, target, torch.zeros(1), boundary="slide", **options)
    return change if change.mesh.num_cells < mesh.num_cells else None


def is_right(mesh, points, removed, kept):
    """Exactly: u lies in the planes of all boundary faces of v, and no remaining cell around v is flat or inverted."""
    faces = mesh.topology.boundary_faces.long()
    a, b, c = points[faces[(faces == removed).any(1)]].unbind(1)
    lies_in_planes = ((torch.linalg.cross(b - a, c - a) * (points[kept] - a)).sum(1) == 0).all()
    remaining = mesh.tets[(mesh.tets == removed).any(1) & ~(mesh.tets == kept).any(1)]
    moved = torch.where(remaining == removed, kept, remaining)
    return bool(lies_in_planes and (determinants(points, moved) > 0).all())


@examples(4)
@given(seed=SEEDS)
def test_a_boundary_vertex_goes_where_exact_arithmetic_lets_it(seed):
    mesh = lattice_mesh(seed)
    points, outer = mesh.vertices.long(), boundary_vertices(mesh.topology)
    candidates = mesh.topology.edges.long()
    candidates = torch.cat((candidates, candidates.flip(1)))
    candidates = candidates[outer[candidates].all(1)]
    order = torch.randperm(len(candidates), generator=torch.Generator().manual_seed(seed))
    for removed, kept in candidates[order[:50]].tolist():
        change = collapse_one(mesh, removed, kept, min_quality=0.0)
        assert (change is not None) == is_right(mesh, points, removed, kept)


@examples(3)
@given(seed=SEEDS)
def test_collapses_done_together_are_those_done_one_by_one(seed):
    lattice = lattice_mesh(seed)
    mesh = lattice
    together = collapse_edges(mesh, *all_half_edges(mesh, seed), boundary="slide")
    names = torch.arange(mesh.num_vertices)
    for pair in merged(mesh, together).tolist():
        removed, kept = (int((names == name).nonzero()) for name in pair)
        change = collapse_one(mesh, removed, kept)
        assert change is not None
        mesh, names = change.mesh, names[change.parents[:, 0].long()]
    assert torch.equal(mesh.tets, together.mesh.tets)
    assert torch.equal(names.int(), together.parents[:, 0])


@pytest.mark.parametrize("seed", [None, 1])
def test_most_of_a_box_is_not_needed(seed):
    """Linear data needs hardly more than the corners, however the box is turned, sheared and stored."""
    lattice = cubes(8, 8, 8)
    mesh, points = lattice if seed is None else image(lattice, seed), lattice.vertices.long()
    for k in range(4):
        change = collapse_edges(mesh, *all_half_edges(mesh, k), boundary="slide", min_quality=0.05)
        mesh, points = change.mesh, points[change.parents[:, 0].long()]
    on_planes = ((points == 0) | (points == 8)).sum(1)
    assert (on_planes == 3).sum() == 8
    assert (on_planes > 0).sum() < 386 / 2 and 0 < (on_planes == 2).sum() < 84 / 2
    fixed = collapse_edges(lattice, *all_half_edges(lattice, 0), boundary="fixed")
    assert boundary_vertices(fixed.mesh.topology).sum() == 386 and fixed.mesh.num_vertices < 729
    same = collapse_edges(lattice, *all_half_edges(lattice, 0))
    assert torch.equal(same.mesh.tets, fixed.mesh.tets)


def test_planes_creases_and_corners_of_a_box():
    mesh = cubes(4, 4, 4)
    edges = mesh.topology.edges.long()
    pairs = torch.cat((edges, edges.flip(1)))
    planes = torch.cat((mesh.vertices == 0, mesh.vertices == 4), 1)
    pairs = pairs[planes.any(1)[pairs].all(1)]
    kept_planes = (planes[pairs[:, 1]] | ~planes[pairs[:, 0]]).all(1)
    assert torch.equal(keeps_surface(mesh, pairs), kept_planes)
    assert torch.equal(keeps_surface(mesh, pairs.int()), kept_planes)
    assert keeps_surface(mesh, pairs[:0]).shape == (0,)


def disc(n, layers):
    """A cylinder whose side consists of 4 n plane facets."""
    mesh = TetMesh.grid((n, n, layers), lower=(-1.0, -1.0, 0.0), dtype=torch.float64)
    flat = mesh.vertices[:, :2]
    longest = flat.abs().amax(1, keepdim=True)
    rounded = flat * longest / torch.linalg.vector_norm(flat, dim=1, keepdim=True).clamp_min(1e-9)
    return TetMesh(torch.cat((rounded, mesh.vertices[:, 2:]), 1), mesh.tets)


def test_facets_of_a_cylinder_stay():
    """Vertices go along its straight creases and in its lids; its circles keep all their corners."""
    mesh = start = disc(6, 8)
    for k in range(4):
        mesh = collapse_edges(mesh, *all_half_edges(mesh, k), boundary="slide", min_quality=0.01).mesh
    radii = torch.linalg.vector_norm(mesh.vertices[:, :2], dim=1)
    on_circle, height = (radii - 1).abs() < 1e-9, mesh.vertices[:, 2]
    assert (on_circle & (height == 0)).sum() == (on_circle & (height == 1)).sum() == 24
    assert (on_circle & (height > 0) & (height < 1)).sum() < 24 * 7 / 2
    torch.testing.assert_close(mesh.volumes().sum(), start.volumes().sum(), rtol=1e-12, atol=0.0)
    torch.testing.assert_close(boundary_area(mesh), boundary_area(start), rtol=1e-12, atol=0.0)


def test_a_curved_surface_stays_as_it_is():
    grid = TetMesh.grid((6, 6, 6), lower=(-1.0, -1.0, -1.0), dtype=torch.float64)
    longest = grid.vertices.abs().amax(1, keepdim=True)
    lengths = torch.linalg.vector_norm(grid.vertices, dim=1, keepdim=True).clamp_min(1e-9)
    ball = TetMesh(grid.vertices * longest / lengths, grid.tets)
    outer = boundary_vertices(ball.topology)
    change = collapse_edges(ball, *all_half_edges(ball, 0), boundary="slide")
    assert change.mesh.num_vertices < ball.num_vertices
    assert torch.isin(outer.nonzero()[:, 0], change.parents[:, 0]).all()


@examples(3)
@given(seed=SEEDS)
def test_flat_cells_in_a_rounded_surface(seed):
    """Rounding takes points off their plane, and the hull gets cells as thin as that: none may turn over."""
    lattice = delaunay_box(np.random.default_rng(seed))
    mesh = start = TetMesh.delaunay(image(lattice, 6 * (seed // 6) + 1).vertices)
    for k in range(3):
        change = collapse_edges(mesh, *all_half_edges(mesh, seed + k), boundary="slide", min_quality=1e-10)
        check_change(mesh, change, keeps_cells=False)
        mesh = change.mesh
    assert mesh.num_vertices < start.num_vertices


def test_the_rim_of_a_wedge_without_width_stays():
    """Its two sides count as one plane, in which the rim must not be cut."""
    angles = torch.arange(8) * (torch.pi / 4)
    rim = torch.stack((angles.cos(), angles.sin(), torch.zeros(8)), 1)
    vertices = torch.cat((rim, torch.tensor([[0.0, 0.0, -1e-5], [0.0, 0.0, 1e-5]]))).double()
    lens = TetMesh(vertices, [[8, 9, i, (i + 1) % 8] for i in range(8)])
    change = collapse_edges(lens, *all_half_edges(lens, 0), boundary="slide", min_quality=1e-9)
    assert torch.equal(change.mesh.tets, lens.tets)


def box_with(*points):
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=torch.float64)] * 3)
    return TetMesh.delaunay(torch.cat((corners, torch.tensor(points, dtype=torch.float64))))


def test_corners_stay_however_close_the_next_vertex_is():
    """Without the last corner (1, 1, 1) hardly any volume or area would be missing."""
    mesh = box_with((1.0, 1.0, 1.0 - 1e-6), (0.5, 0.5, 0.5))
    assert collapse_one(mesh, 7, 8, min_quality=1e-11) is None
    assert collapse_one(mesh, 8, 7, min_quality=1e-11) is not None


def test_inner_vertices_just_below_the_surface_stay_there():
    for depth in (1e-6, 0.0):
        mesh = box_with((0.5, 0.5, 1.0), (0.7, 0.6, 1.0 - depth), (0.5, 0.5, 0.5))
        assert (collapse_one(mesh, 8, 9, min_quality=1e-11) is None) == (depth > 0)


def slit(half_width):
    """A block with a slit inside: above it, cells have vertices of their own."""
    mesh = cubes(6, 6, 4)
    doubled = ((mesh.vertices[:, :2] - 3).abs() <= half_width).all(1) & (mesh.vertices[:, 2] == 2)
    doubles = doubled.nonzero()[:, 0]
    other = torch.arange(mesh.num_vertices)
    other[doubles] = mesh.num_vertices + torch.arange(len(doubles))
    tets = mesh.tets.long()
    above = mesh.vertices[tets][:, :, 2].mean(1) > 2
    tets[above] = other[tets[above]]
    return TetMesh(torch.cat((mesh.vertices, mesh.vertices[doubles])), tets)


def test_the_rim_of_a_slit_stays():
    mesh = slit(half_width=1)
    points, edges = mesh.vertices.long(), mesh.topology.edges.long()
    inside = ((points > 0) & (points < torch.tensor([6, 6, 4]))).all(1)
    at_slit = inside & boundary_vertices(mesh.topology)
    pairs = torch.cat((edges, edges.flip(1)))
    changes = [collapse_one(mesh, *pair) for pair in pairs[at_slit[pairs].all(1)][::2].tolist()]
    done = [change for change in changes if change is not None]
    for change in done:
        assert_same_surface(points, mesh, change)
    assert 5 < len(done) < len(changes)


@examples(3)
@given(seed=SEEDS)
def test_a_slit_does_not_close(seed):
    """Both its sides may lose their vertices, but not such that their faces become the same."""
    mesh = slit(half_width=seed % 2)
    points = mesh.vertices.long()
    for k in range(2):
        change = collapse_edges(mesh, *all_half_edges(mesh, seed + k), boundary="slide")
        assert_same_surface(points, mesh, change)
        mesh, points = change.mesh, points[change.parents[:, 0].long()]


def test_of_two_collapses_that_would_close_a_slit_the_cheaper_one_is_done():
    mesh = slit(half_width=0)
    below, above = find_vertex(mesh, (3, 3, 2)), mesh.num_vertices - 1
    rim = find_vertex(mesh, (4, 3, 2))
    edges = find_edges(mesh.topology, torch.tensor([[below, rim], [above, rim]]))
    target = (mesh.topology.edges[edges, 1] == rim).long()
    for cost, gone in (((1.0, 2.0), below), ((2.0, 1.0), above)):
        change = collapse_edges(mesh, edges, target, torch.tensor(cost), boundary="slide")
        assert set(range(mesh.num_vertices)) - set(change.parents[:, 0].tolist()) == {gone}
    after = collapse_one(mesh, below, rim)
    assert collapse_one(after.mesh, after.mesh.num_vertices - 1, find_vertex(after.mesh, (4, 3, 2))) is None


def test_what_would_close_a_hole_or_pinch_is_no_collapse():
    plate = cubes(3, 3, 1)
    centroids = plate.vertices[plate.tets.long()].mean(1)
    middle = (centroids[:, :2].floor() == 1).all(1)
    hole = remove_cells(plate, middle & (centroids[:, 0] > centroids[:, 1]))
    ends = [[(1, 1, 1), (2, 1, 1)], [(2, 1, 1), (2, 2, 1)], [(1, 1, 1), (2, 2, 1)], [(0, 1, 0), (1, 2, 1)]]
    pairs = torch.tensor([[find_vertex(plate, position) for position in pair] for pair in ends])
    assert (find_edges(hole.mesh.topology, pairs) >= 0).all()
    assert link_condition(plate.topology, pairs).tolist() == [True, True, True, False]
    assert not link_condition(hole.mesh.topology, pairs).any()

    void = remove_cells(cubes(3, 3, 3), torch.arange(162) == 80).mesh
    corners = cubes(3, 3, 3).tets[80].long()
    assert not link_condition(void.topology, torch.combinations(corners)).any()


@pytest.mark.parametrize("options", [{"boundary": "free"}, {"coplanarity": 1.0}, {"coplanarity": float("nan")}])
def test_what_is_refused(options):
    mesh = cubes(1, 1, 1)
    with pytest.raises(MeshError, match="pass 'fixed' or 'slide'"):
        collapse_edges(mesh, *all_half_edges(mesh, 0), **options)
