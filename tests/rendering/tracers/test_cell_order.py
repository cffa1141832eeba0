"""Front-to-back orders against rays that are clipped by every cell."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st

from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.topology.topology import LOCAL_FACES
from difftetvr.rendering import Camera
from difftetvr.rendering.preparation import ViewOptions, prepare_view
from difftetvr.rendering.search.memory_order import MemoryOrder
from difftetvr.rendering.tracers import cell_order
from difftetvr.rendering.tracers.cell_keys import DENTED, UNSETTLED
from difftetvr.rendering.tracers.cell_order import CellOrder
from difftetvr.rendering.upload import lay_out

seeds = st.integers(0, 2**32 - 1)
properties = examples(3)

SHORT = 1e-9
"""Crossings and overlaps of crossings below this count as none, in units of the mesh's extent."""


def keyed(mesh, vertices, rounds=None):
    """The cells of a mesh with vertices in camera space as kernels leave them, after so many rounds; and the view."""
    seen = mesh.with_vertices(vertices)
    field = Field(torch.zeros(len(vertices), 0).to(vertices), torch.zeros(len(vertices)).to(vertices))
    camera = Camera(torch.eye(4), 50.0, 50.0, 32.0, 32.0, 64, 64)
    view = prepare_view(seen, field, camera, ViewOptions(renderer="projected"))
    plan = view.task.plan(view.rays, None, None)
    if rounds is not None:
        plan = replace(plan, cells=replace(plan.cells, rounds=rounds))
    return lay_out(view.upload, view.rays, plan).found, view


def sorted_cells(found, view):
    """Their order, by the numbers of the mesh."""
    order = MemoryOrder.of(view.task.mesh)
    cells = found.sorted(view.task.backend, order.topology)
    return CellOrder(order.cells.long()[cells.order], cells.exact)


def as_if_convex(found):
    """So that what is said to be exact is what has no cycles."""
    return replace(found, is_closed=True, told=replace(found.told, flags=found.told.flags & ~DENTED))


def visibility_order(mesh, vertices, rounds=None):
    return sorted_cells(*keyed(mesh, vertices, rounds))


def crossings(vertices, tets, directions):
    """(R, T) where rays from the origin enter and leave each cell; nothing where they do not pass its inside."""
    corners = vertices.double().numpy()[tets.numpy()]
    enter = np.zeros((len(directions), len(tets)))
    leave = np.full_like(enter, np.inf)
    for local in LOCAL_FACES:
        a, b, c = (corners[:, i] for i in local)
        normals = np.cross(b - a, c - a)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        heights, slopes = (normals * a).sum(1)[None], directions @ normals.T
        parallel = np.abs(slopes) < 1e-13
        with np.errstate(divide="ignore", invalid="ignore"):
            hits = heights / slopes
        enter = np.where(~parallel & (slopes < 0), np.maximum(enter, hits), enter)
        leave = np.where(~parallel & (slopes > 0), np.minimum(leave, hits), leave)
        leave = np.where(parallel & (heights < 1e-13), -np.inf, leave)
    return enter, leave


def rays_through(vertices, tets, seed, count=80):
    """Random rays from the origin to points inside the mesh, and some along the axes."""
    rng = np.random.default_rng(seed)
    corners = vertices.double().numpy()[tets.numpy()[rng.integers(0, len(tets), count)]]
    targets = (rng.dirichlet([1] * 4, count)[:, :, None] * corners).sum(1)
    directions = np.concatenate((targets, np.eye(3), -np.eye(3)))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def misordered(mesh, vertices, order, seed=0):
    """How far, at most, a ray meets a cell before it has left those that come earlier in the order."""
    assert torch.equal(order.sort().values, torch.arange(mesh.num_cells))
    extent = float((vertices.amax(0) - vertices.amin(0)).max())
    enter, leave = crossings(vertices, mesh.tets, rays_through(vertices, mesh.tets, seed))
    enter, leave = enter[:, order.numpy()] / extent, leave[:, order.numpy()] / extent
    crossed = leave - enter > SHORT
    assert crossed.sum() > len(enter)
    left = np.maximum.accumulate(np.where(crossed, leave, 0.0), 1)
    return float(np.where(crossed[:, 1:], left[:, :-1] - enter[:, 1:], 0.0).max(initial=0.0))


def rotation(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return torch.from_numpy(q * np.sign(np.linalg.det(q)))


def seen_from(mesh, eye, turn=None):
    """The mesh's vertices in camera space, as a renderer gets them."""
    vertices = mesh.vertices.double() - torch.tensor(eye, dtype=torch.float64)
    return (vertices if turn is None else vertices @ turn.T).to(mesh.vertices.dtype)


def check(mesh, vertices, seed=0):
    found = visibility_order(mesh, vertices)
    assert found.exact
    assert misordered(mesh, vertices, found.order, seed) < SHORT


def eyes(seed):
    """Outside near and far, and inside, in units of the unit cube."""
    rng = np.random.default_rng(seed)
    outwards = rng.normal(size=3)
    outwards /= np.linalg.norm(outwards)
    return [0.5 + distance * outwards for distance in (0.0, 0.1, 0.9, 3.0, 100.0)]


@properties
@given(seed=seeds, dtype=st.sampled_from([np.float32, np.float64]))
def test_delaunay_meshes(seed, dtype):
    rng = np.random.default_rng(seed)
    clustered = rng.random((6, 1, 3)) + 10.0 ** -rng.uniform(0, 3, (6, 1, 1)) * rng.normal(size=(6, 40, 3))
    for points in (rng.random((250, 3)), clustered.reshape(-1, 3)):
        mesh = TetMesh.delaunay(points.astype(dtype))
        for eye in eyes(seed):
            check(mesh, seen_from(mesh, eye, rotation(seed)), seed)


@properties
@given(seed=seeds, dtype=st.sampled_from([torch.float32, torch.float64]))
def test_grids_from_any_side(seed, dtype):
    for upper in ((1.0, 1.0, 1.0), (1.0, 0.01, 1.0), (1.0, 1.0, 50.0)):
        mesh = TetMesh.grid((6, 5, 7), upper=upper, dtype=dtype)
        for eye in eyes(seed):
            check(mesh, seen_from(mesh, eye * np.array(upper), rotation(seed)), seed)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "eye",
    [
        (0.5, 0.5, -2.0),  # in two planes of the grid
        (0.5, 0.37, -2.0),
        (0.5, 0.5, 0.5),  # a vertex
        (0.625, 0.625, 0.625),  # the centre of a cube, where all its six cells meet
        (0.5, 0.5, 0.43),  # on an edge
        (0.5, 0.41, 0.43),  # in a face
        (0.0, 0.0, 0.0),
        (-1.0, -1.0, -1.0),  # on the line of all diagonals
        (3.0, 0.0, 0.0),
        (0.5, 1.0, 1.0),
        (0.31, 0.22, -5.0),
    ],
)
def test_grids_from_where_their_planes_are_edges_on(eye, dtype):
    mesh = TetMesh.grid((4, 4, 4), dtype=dtype)
    check(mesh, seen_from(mesh, eye))
    check(mesh, seen_from(mesh, eye, rotation(1)))


@properties
@given(seed=seeds)
def test_convex_meshes_that_are_not_delaunay(seed):
    rng = np.random.default_rng(seed)
    grid = TetMesh.grid((6, 6, 6), dtype=torch.float64)
    inner = ((grid.vertices > 0) & (grid.vertices < 1)).all(1, keepdim=True)
    moves = torch.from_numpy(rng.uniform(-0.25, 0.25, (grid.num_vertices, 3)))
    moved = grid.with_vertices(grid.vertices + torch.where(inner, moves * grid.vertex_altitudes()[:, None], 0.0))
    shear = torch.tensor([[1.0, 3.0, 2.0], [0.0, 1.0, 4.0], [0.0, 0.0, 1.0]]).double()
    squash = torch.diag(torch.tensor([1.0, 1.0, 0.02])).double()
    points = TetMesh.delaunay(rng.random((250, 3)))
    for mesh, matrix in ((moved, torch.eye(3).double()), (grid, shear), (points, squash)):
        changed = mesh.with_vertices(mesh.vertices @ matrix.T)
        for eye in eyes(seed):
            check(changed, seen_from(changed, matrix.numpy() @ eye, rotation(seed)), seed)


@properties
@given(seed=seeds)
def test_parts_of_delaunay_meshes_are_right_but_not_known_to_be(seed):
    rng = np.random.default_rng(seed)
    whole = TetMesh.delaunay(rng.random((250, 3)))
    not_flat = whole.quality().numpy() > 1e-3
    mesh = TetMesh(whole.vertices, whole.tets[not_flat & (rng.random(whole.num_cells) < 0.6)])
    for eye in eyes(seed):
        vertices = seen_from(mesh, eye)
        found = visibility_order(mesh, vertices)
        assert not found.exact
        assert misordered(mesh, vertices, found.order, seed) < SHORT


@properties
@given(seed=seeds)
def test_moving_cells_all_at_once_one_after_another_and_in_turn_gives_the_same(seed):
    grid = TetMesh.grid((4, 4, 4))
    points = TetMesh.delaunay(np.random.default_rng(seed).random((200, 3)))
    squashed = points.with_vertices(points.vertices * torch.tensor([1.0, 1.0, 0.05]))
    edge_on = [(0.5, 0.5, -2.0), (0.5, 0.5, 0.5)]
    anywhere = [(mesh, eyes(seed)[3]) for mesh in (grid, points, squashed)]
    for mesh, eye in (*anywhere, *((grid, eye) for eye in edge_on)):
        vertices = seen_from(mesh, eye)
        settled, view = keyed(mesh, vertices, 100)
        assert not settled.told.flags & UNSETTLED
        expected = sorted_cells(settled, view)
        for limit in (None, "_MAX_ROUNDS", "_MAX_MOVES"):
            with pytest.MonkeyPatch.context() as patch:
                if limit:
                    patch.setattr(cell_order, limit, 0)
                for rounds in (0, 1):
                    found = visibility_order(mesh, vertices, rounds)
                    assert found.exact
                    assert torch.equal(found.order, expected.order)


@pytest.mark.parametrize("unit", [1e-300, 1e-30, 1e30, 1e300])
def test_no_unit_of_length(unit):
    mesh = TetMesh.grid((3, 4, 5), dtype=torch.float64)
    for vertices in (seen_from(mesh, (3.0, 1.0, 2.0), rotation(0)), seen_from(mesh, (0.5, 0.5, 0.5))):
        scale = 2.0 ** round(np.log2(unit))
        scaled = mesh.with_vertices(mesh.vertices * scale)
        found = visibility_order(scaled, vertices * scale)
        assert found.exact
        assert torch.equal(found.order, visibility_order(mesh, vertices).order)


def ring(twist, count=12):
    """A ring around the z axis whose top is turned against its bottom: with enough twist each sector hides the next."""
    mesh = TetMesh.grid((count, 1, 1), dtype=torch.float64)
    x, y, z = mesh.vertices.unbind(1)
    angles = 2 * np.pi * x + twist * z
    vertices = torch.stack(((1 + y) * angles.cos(), (1 + y) * angles.sin(), z), 1)
    first = torch.isclose(x, torch.ones(()).double()).long() * count
    return TetMesh(vertices, (torch.arange(mesh.num_vertices) - first)[mesh.tets.long()])


def test_cycles_are_found():
    for twist, acyclic in ((0.0, True), (0.6, False), (-0.6, False)):
        mesh = ring(twist)
        keys, view = keyed(mesh, seen_from(mesh, (0.0, 0.0, 9.0)))
        found = sorted_cells(as_if_convex(keys), view)
        assert found.exact == acyclic
        assert torch.equal(found.order.sort().values, torch.arange(mesh.num_cells))


def test_what_is_not_convex_is_not_known_to_be_exact():
    assert not visibility_order(ring(0.0), seen_from(ring(0.0), (0.0, 0.0, 9.0))).exact


def test_cells_turned_inside_out_by_rounding_do_no_harm():
    """Positions so coarse that the thinnest cells turn over, and with them what their faces say."""
    coarse = 0.01
    for seed in range(10):
        mesh = TetMesh.delaunay(np.random.default_rng(seed).random((150, 3)))
        for eye in eyes(seed):
            vertices = seen_from(mesh.with_vertices(coarse * torch.round(mesh.vertices / coarse)), eye)
            keys, view = keyed(mesh, vertices)
            found = sorted_cells(as_if_convex(keys), view)
            assert found.exact
            kept = torch.nonzero(mesh.with_vertices(vertices).volumes() > 0).squeeze(1)
            assert len(kept) > 0.95 * mesh.num_cells
            renumbered = torch.full((mesh.num_cells,), -1).index_copy(0, kept, torch.arange(len(kept)))[found.order]
            upright = TetMesh(vertices, mesh.tets[kept], conforming=False)
            assert misordered(upright, vertices, renumbered[renumbered >= 0], seed) < 5 * coarse


def test_loose_cells_are_sorted_by_their_centroids():
    grid = TetMesh.grid((3, 3, 3))
    mesh = TetMesh(grid.vertices, torch.cat((grid.tets, grid.tets[:7])), conforming=False)
    vertices = seen_from(mesh, (2.0, -1.0, 3.0))
    found = visibility_order(mesh, vertices)
    assert not found.exact
    distances = vertices.double()[mesh.tets].mean(1).norm(dim=1)[found.order]
    assert (distances.diff() > -1e-12).all()


def test_positions_that_require_gradients_and_single_cells():
    mesh = TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    found = visibility_order(mesh, mesh.vertices.clone().requires_grad_())
    assert found.exact
    assert found.order.tolist() == [0]
    assert found.order.dtype == torch.int64


@pytest.mark.gpu
def test_on_a_gpu():
    mesh = TetMesh.grid((6, 5, 7))
    vertices = seen_from(mesh, (2.0, -1.0, 3.0), rotation(2))
    found = visibility_order(mesh.to("cuda"), vertices.cuda())
    assert found.exact
    assert misordered(mesh, vertices, found.order.cpu()) < SHORT
