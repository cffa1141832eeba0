import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st

from difftetvr import TetMesh
from difftetvr.errors import MeshError
from difftetvr.mesh.boundary import BoundaryConstraint
from difftetvr.mesh.limits import MotionLimits
from difftetvr.mesh.motion import cap_move, guard_move
from difftetvr.mesh.quality import quality, volumes
from difftetvr.mesh.shapes import measure_vertices

DTYPES = (torch.float32, torch.float64)
properties = examples(30)
seeds = st.integers(0, 2**32 - 1)


def random_mesh(seed, dtype=torch.float32):
    """A Delaunay mesh, slivers included, or a jittered grid; anywhere, of any size."""
    rng = np.random.default_rng(seed)
    if seed % 2:
        points = torch.from_numpy(rng.random((40, 3)))
        mesh = TetMesh.delaunay(points.to(dtype))
    else:
        mesh = TetMesh.grid((3, 2, 2), dtype=dtype)
        vertices = mesh.vertices + torch.from_numpy(rng.uniform(-0.05, 0.05, mesh.vertices.shape)).to(dtype)
        mesh = TetMesh(vertices, mesh.tets)
    unit = 10.0 ** rng.integers(-6, 7)
    return TetMesh(mesh.vertices * unit, mesh.tets)


def adversarial_move(mesh, rng, kind, cells):
    """Moves of about so many cell sizes, of kinds that are bad in different ways."""
    size = float(mesh.volumes().double().mean()) ** (1 / 3)
    positions = mesh.vertices.double()
    if kind == "random":
        move = torch.from_numpy(rng.normal(size=positions.shape))
    elif kind == "collapse":  # everything to one point
        move = positions.mean(0) - positions
    elif kind == "mirror":  # everything inside out
        move = (positions.mean(0) - positions) * torch.tensor([2.0, 0.0, 0.0])
    elif kind == "one":  # a single vertex flies away
        move = torch.zeros_like(positions)
        move[rng.integers(len(move))] = torch.from_numpy(rng.normal(size=3))
    else:  # every vertex onto another one
        move = positions[torch.from_numpy(rng.permutation(len(positions)))] - positions
    return move / move.abs().max() * size * cells


moves = st.sampled_from(["random", "collapse", "mirror", "one", "swap"])
sizes = st.floats(-3, 2).map(lambda exponent: 10.0**exponent)


def assert_above_floors(mesh, vertices, limits):
    old, new = mesh.vertices.double(), vertices.double()
    before, after = volumes(old, mesh.tets), volumes(new, mesh.tets)
    q_before, q_after = quality(old, mesh.tets), quality(new, mesh.tets)
    touched = (vertices != mesh.vertices).any(1)[mesh.tets].any(1)
    rounding = 1 - 1e-9
    assert (after[touched] >= rounding * limits.volume_ratio * before[touched]).all()
    assert ((q_after >= rounding * limits.quality) | (q_after >= rounding * q_before))[touched].all()


@properties
@given(seed=seeds, dtype=st.sampled_from(DTYPES), kind=moves, cells=sizes)
def test_no_cell_falls_under_its_floors(seed, dtype, kind, cells):
    mesh = random_mesh(seed, dtype)
    move = adversarial_move(mesh, np.random.default_rng(seed), kind, cells)
    limits = MotionLimits()
    result = guard_move(mesh, move, limits)
    mesh.with_vertices(result.vertices).validate()  # exact signs
    assert_above_floors(mesh, result.vertices, limits)

    allowed = (mesh.vertices.double() + result.fraction[:, None] * move).to(dtype)
    assert torch.equal(result.vertices, torch.where(result.fraction[:, None] > 0, allowed, mesh.vertices))
    halvings = -torch.log2(result.fraction)
    assert set(halvings.unique().tolist()) <= {*range(limits.halvings + 1), np.inf}
    assert result.refused == (result.fraction == 0).sum()
    assert result.halved == ((result.fraction > 0) & (result.fraction < 1)).sum()


@examples(5)
@given(seed=seeds, dtype=st.sampled_from(DTYPES))
def test_many_bad_steps_in_a_row(seed, dtype):
    """Floors are relative to the last step, so volumes may shrink, but shapes never fall under theirs."""
    mesh = start = random_mesh(seed, dtype)
    rng = np.random.default_rng(seed)
    for kind in ("random", "mirror", "swap") * 5:
        move = adversarial_move(mesh, rng, kind, 10.0 ** rng.uniform(-2, 2))
        mesh = mesh.with_vertices(guard_move(mesh, move).vertices)
        mesh.validate()
    lowest = torch.minimum(start.quality(), torch.tensor(MotionLimits().quality))
    assert (mesh.quality() >= lowest * (1 - 1e-6)).all()


@properties
@given(seed=seeds, exponent=st.integers(-30, 30))
def test_scaling_everything_changes_nothing(seed, exponent):
    mesh = random_mesh(seed)
    move = adversarial_move(mesh, np.random.default_rng(seed), "random", 0.3).float()
    scale = 2.0**exponent
    plain = guard_move(mesh, move)
    scaled = guard_move(mesh.with_vertices(mesh.vertices * scale), move * scale)
    assert torch.equal(scaled.fraction, plain.fraction)
    assert torch.equal(scaled.vertices, plain.vertices * scale)


def test_harmless_moves_pass_whole():
    mesh = TetMesh.grid((3, 3, 3))
    move = 0.1 * mesh.vertex_altitudes()[:, None] * torch.ones(3) / 3**0.5
    result = guard_move(mesh, move)
    assert torch.equal(result.vertices, (mesh.vertices.double() + move.double()).float())
    assert (result.fraction == 1).all()
    assert result.halved == result.refused == 0


def test_only_offenders_are_held_back():
    """One vertex of a large grid runs far into its neighbours; vertices that share no cell with it are left alone."""
    mesh = TetMesh.grid((6, 6, 6))
    rng = np.random.default_rng(0)
    move = 0.05 * mesh.vertex_altitudes()[:, None] * torch.from_numpy(rng.uniform(-1, 1, mesh.vertices.shape)).float()
    culprit = 171  # the centre, 3 + 7 * (3 + 7 * 3)
    move[culprit] = torch.tensor([0.9, 0.8, 0.7])
    result = guard_move(mesh, move)
    neighbours = torch.unique(mesh.tets[(mesh.tets == culprit).any(1)]).long()
    far = torch.ones(mesh.num_vertices, dtype=torch.bool)
    far[neighbours] = False
    assert result.fraction[culprit] < 1
    assert (result.fraction[far] == 1).all()


def test_refused_moves_keep_every_bit():
    """A sliver that may only get worse holds its vertices; nothing else is there to move."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 0.01]])
    mesh = TetMesh(vertices, [[0, 1, 2, 3]])
    move = torch.zeros(4, 3)
    move[3, 2] = -0.001
    result = guard_move(mesh, move)
    assert torch.equal(result.vertices, vertices)
    assert result.refused == 1
    better = guard_move(mesh, -move)
    assert better.fraction[3] == 1


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1e300])
def test_moves_to_nowhere_are_refused(value):
    mesh = TetMesh.grid((2, 2, 2))
    move = torch.zeros(mesh.num_vertices, 3, dtype=torch.float64)
    move[13] = value  # the one inner vertex
    move[0, 0] = -0.01
    result = guard_move(mesh, move)
    assert result.fraction[13] == 0
    assert torch.equal(result.vertices[13], mesh.vertices[13])
    assert result.vertices[0, 0] == -0.01


def test_cells_too_thin_for_float64_hold_their_vertices():
    """Valid in exact arithmetic, but no float64 product can tell: such a cell must not be moved blindly."""
    tiny = 2.0**-60
    vertices = torch.tensor([[0.0, 0, 0], [1, 1 / 3, 1 / 7], [1 / 3, 1, 1 / 9], [4 / 3, 4 / 3, 0]], dtype=torch.float64)
    vertices[3, 2] = vertices[1, 2] + vertices[2, 2] + tiny
    mesh = TetMesh(vertices, [[0, 1, 2, 3]])
    rng = np.random.default_rng(0)
    for _ in range(50):
        move = torch.from_numpy(rng.normal(size=(4, 3))) * 10.0 ** rng.uniform(-17, 1)
        mesh.with_vertices(guard_move(mesh, move).vertices).validate()


@pytest.mark.parametrize("limit", [{"volume_ratio": 0.0}, {"volume_ratio": 1.0}, {"quality": 1.0}, {"halvings": -1}])
def test_refuses_limits_out_of_range(limit):
    with pytest.raises(MeshError, match="out of range"):
        MotionLimits(**limit)


def test_unused_vertices_move_freely():
    mesh = TetMesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 5, 5]], [[0, 1, 2, 3]])
    move = torch.zeros(5, 3)
    move[4] = 100.0
    assert guard_move(mesh, move).vertices[4].tolist() == [105.0] * 3
    assert measure_vertices(mesh).altitudes[4] == 0


@properties
@given(seed=seeds, fraction=st.floats(0.01, 0.24), magnitude=st.integers(-300, 300))
def test_cap_bounds_moves_and_keeps_their_direction(seed, fraction, magnitude):
    mesh = random_mesh(seed, torch.float64)
    rng = np.random.default_rng(seed)
    altitudes = mesh.vertex_altitudes()
    move = torch.from_numpy(rng.normal(size=mesh.vertices.shape)) * altitudes[:, None] * 10.0**magnitude
    capped, count = cap_move(move, altitudes, fraction)
    length, longest = torch.linalg.vector_norm(capped, dim=1), fraction * altitudes
    assert (length <= longest * (1 + 1e-12)).all()
    unit = move / move.abs().amax(1, keepdim=True)
    assert torch.linalg.cross(unit, capped / altitudes[:, None]).abs().max() < 1e-12
    assert (unit * capped).sum(1).min() >= 0
    assert count == (capped != move).any(1).sum()
    # What the documentation promises of caps below 1/4.
    assert (volumes(mesh.vertices + capped, mesh.tets) >= 0).all()


def test_zero_moves_stay_zero():
    move, count = cap_move(torch.zeros(2, 3), torch.tensor([0.0, 1.0]), 0.1)
    assert not move.any() and count == 0
    move, count = cap_move(torch.ones(1, 3), torch.zeros(1), 0.1)
    assert not move.any() and count == 1


def test_the_barrier_can_weigh_cells_by_their_quality():
    """With weight Q, the gradient of -Q log Q' at Q' = Q is that of -Q."""
    mesh = random_mesh(4, torch.float64)
    vertices = mesh.vertices.clone().requires_grad_()
    (-mesh.with_vertices(vertices).quality().sum()).backward()
    gradient = measure_vertices(mesh, lambda quality: quality).barrier_gradient
    torch.testing.assert_close(gradient, vertices.grad)


@properties
@given(seed=seeds)
def test_measures_are_those_of_the_differentiable_twin(seed):
    mesh = random_mesh(seed, torch.float64)
    vertices = mesh.vertices.clone().requires_grad_()
    mesh = mesh.with_vertices(vertices)
    (-mesh.quality().log().sum()).backward()
    shapes = measure_vertices(mesh)
    altitudes, gradient = mesh.vertex_altitudes().detach(), shapes.barrier_gradient
    torch.testing.assert_close(shapes.altitudes, altitudes, rtol=1e-9, atol=0.0)
    error = torch.linalg.vector_norm(gradient - vertices.grad, dim=1) * altitudes
    assert error.max() < 1e-8
    torch.testing.assert_close(shapes.cells.qualities, mesh.quality().detach(), rtol=1e-9, atol=1e-12)
    determinants = 6 * mesh.volumes().detach() * shapes.cells.scale**3
    torch.testing.assert_close(shapes.cells.determinants, determinants, rtol=1e-9, atol=1e-15)


def rotation(seed):
    matrix, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return torch.from_numpy(matrix * np.linalg.det(matrix))


@pytest.mark.parametrize("turn", [None, 3])
def test_sliding_follows_planes_and_creases(turn):
    """On a box: 1 plane at faces, 2 at edges, 3 at corners; also when the box is oblique and stored in float32."""
    n = 4
    mesh = TetMesh.grid((n, n, n), dtype=torch.float64)
    on_planes = ((mesh.vertices == 0) | (mesh.vertices == 1)).sum(1)
    matrix = torch.eye(3, dtype=torch.float64) if turn is None else rotation(turn)
    turned = TetMesh((mesh.vertices @ matrix.T).float(), mesh.tets)
    constraint = BoundaryConstraint.sliding(turned)
    assert torch.equal(constraint.vertices, torch.nonzero(on_planes)[:, 0])
    ranks = torch.linalg.matrix_rank(constraint.tangents, tol=0.5)
    assert torch.equal(ranks, 3 - on_planes[constraint.vertices])

    move = 0.1 * torch.randn(mesh.vertices.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    kept = constraint.apply(turned.vertices, move)
    inner = on_planes == 0
    assert torch.equal(kept[inner], move[inner])
    back = kept @ matrix
    blocked = (mesh.vertices == 0) | (mesh.vertices == 1)
    expected = torch.where(blocked, 0.0, move @ matrix)
    torch.testing.assert_close(back, expected, rtol=0, atol=1e-6 if turn else 0.0)


def test_curved_boundaries_and_shallow_angles_stay():
    """A face that rises by more than the tolerance is no plane to slide in; one that rises by less is."""
    for angle, free in ((1e-2, 0), (1e-3, 0), (1e-6, 2)):
        mesh = TetMesh.grid((2, 2, 1), dtype=torch.float64)
        vertices = mesh.vertices.clone()
        centre = 9 + 4
        vertices[centre, 2] += 0.5 * angle
        constraint = BoundaryConstraint.sliding(TetMesh(vertices, mesh.tets))
        row = constraint.vertices.tolist().index(centre)
        assert torch.linalg.matrix_rank(constraint.tangents[row], tol=0.5) == free


def test_sliding_vertices_do_not_drift_off_their_plane():
    """Rounding to float32 takes a vertex off an oblique plane at every step; it must not add up."""
    matrix = rotation(5)
    box = TetMesh.grid((3, 3, 3), dtype=torch.float64)
    mesh = TetMesh((box.vertices @ matrix.T).float(), box.tets)
    constraint = BoundaryConstraint.sliding(mesh)
    rng = torch.Generator().manual_seed(1)
    on_plane = (box.vertices == 0) | (box.vertices == 1)
    for _ in range(200):
        move = 0.02 * torch.randn(mesh.vertices.shape, generator=rng, dtype=torch.float64)
        move = constraint.apply(mesh.vertices, move)
        mesh = mesh.with_vertices(guard_move(mesh, move).vertices)
    off = (mesh.vertices.double() @ matrix - box.vertices).abs()[on_plane]
    assert off.max() < 5e-7
    assert float(mesh.volumes().double().sum()) == pytest.approx(1.0, rel=1e-6)


def test_fixed_boundary_stays_to_the_bit():
    mesh = random_mesh(2)
    constraint = BoundaryConstraint.fixed(mesh)
    move = constraint.apply(mesh.vertices, torch.ones(mesh.num_vertices, 3, dtype=torch.float64))
    on_boundary = torch.unique(mesh.topology.boundary_faces).long()
    assert not move[on_boundary].any()
    assert torch.equal(constraint.vertices, on_boundary)
